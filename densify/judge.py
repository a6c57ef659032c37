"""What `lightdepth evaluate` judges: predictions, dense runs, maps or trajectories against a sequence with truth.

The answer is an Evaluation: figures for metrics.json, and what its pictures are drawn from. Units, alignment and mask
are in it. Frames are taken by their number: their order on disk changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from densify.dense_map import DenseMapFiles, Surface, map_folders, read_dense_map, run_record
from densify.evaluation import (
    CUBE_MM,
    SurfaceErrors,
    TrueSurface,
    compare_depth,
    depth_triangles,
    pooled,
    surface_errors,
    surface_gap,
    true_cloud,
    true_depth,
)
from densify.similarity import Similarity
from densify.trajectory import (
    AlignedTrajectory,
    Trajectory,
    align_trajectory,
    in_order,
    keyframe_trajectory,
    read_trajectories,
    span,
    trajectory_files,
    trajectory_summary,
)
from lightdepth.calibration import read_json
from lightdepth.datasets import FrameSequence
from lightdepth.datasets.sequence import numbered_files
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.prediction import read_prediction
from lightdepth.run import git_revision, plain, versions
from lightdepth.sparse_map import SparseMap, check_rigid

EDGES_MM = np.geomspace(0.05, 200, 145)
"""Where the cumulative error curves are taken."""
THRESHOLDS_MM = (1.0, 2.0, 5.0)
COVERAGE_MESH = "coverage_mesh.obj"
"""C3VD's true surface, in the frame of reference of its poses."""
_CLOUDS = ("sparse", "sparse_inliers", "dense")
_LEAST_AGREEMENT = 0.5
_MESH_FRAMES, _MESH_TRIANGLES = 50, 2_000_000


@dataclass(frozen=True)
class ErrorMesh:
    """A surface in the true world [mm] with the distance (n,) [mm] of each vertex from the true cloud."""

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    distance: np.ndarray


@dataclass(frozen=True)
class Evaluation:
    """Figures as JSON knows them; shares of the errors within EDGES_MM by name; surfaces to be coloured."""

    result: dict[str, Any]
    curves: Mapping[str, np.ndarray] = field(default_factory=dict)
    meshes: Sequence[ErrorMesh] = ()


@dataclass(frozen=True, eq=False)
class Model:
    """One submap as it is judged: its trajectory, point clouds (n, 3) in map units by name ("sparse", "sparse_inliers",
    "dense"), and triangles over the dense ones."""

    trajectory: Trajectory
    clouds: Mapping[str, np.ndarray] = field(default_factory=dict)
    triangles: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Truth:
    """What a sequence knows: true poses (4, 4) [mm] by frame number, all its frames' numbers, seconds between frames,
    and the wall, or why there is none."""

    source: str
    poses: Mapping[int, np.ndarray]
    numbers: Sequence[int]
    period: float | None
    surface: TrueSurface | None
    no_surface: str = ""


def with_versions(result: Mapping[str, Any]) -> dict[str, Any]:
    """The figures with what they were computed by. No time: the same work gives the same file."""
    return plain({**result, "versions": versions(), "revision": git_revision()})


# Predictions


def judge_depth(folder: Path, truth: FrameSequence, max_depth_mm: float = 100.0, common: bool = False) -> Evaluation:
    """Depth errors of a predictions folder: per frame and their mean, under every alignment.

    Predictions of frames that the truth has not are refused, with the frames that match, unless only the `common` ones
    are wanted. Frames without true depth are skipped, and named.
    """
    from lightdepth.metrics import ALIGNMENTS  # brings torchmetrics, which takes seconds to import

    files = numbered_files(folder, r".*?(\d+)\D*\.npz")
    numbers = shared_frames(files, truth.numbers, "predictions", truth.source, common)
    rows: dict[str, dict[str, float]] = {}
    skipped: dict[str, str] = {}
    within: dict[str, list[np.ndarray]] = {name: [] for name in ALIGNMENTS}
    units = set()
    for number in numbers:
        prediction, frame = read_prediction(files[number]), truth.by_number(number)
        assert frame is not None
        reason = _no_depth(frame, max_depth_mm)
        if reason:
            skipped[prediction.name] = reason
            continue
        found = compare_depth(prediction, frame, max_depth_mm)
        shares = {"share_of_image": found.share_of_image, "share_of_truth": found.share_of_truth}
        rows[prediction.name] = {**found.errors(ALIGNMENTS), "pixels": int(found.valid.sum()), **shares}
        for alignment, curves in within.items():
            curves.append(found.within(EDGES_MM, alignment))
        units.add(prediction.unit)
    if not rows:
        raise InputError(f"{truth.source}: no frame has valid true depth; the first: {next(iter(skipped.values()))}")
    mean = {key: float(np.mean([row[key] for row in rows.values()])) for key in next(iter(rows.values()))}
    result = {
        "kind": "depth",
        "unit": "mm, but abs_rel, rmse_log (natural logarithm) and the shares delta1, delta2, delta3",
        "predicted_unit": ", ".join(sorted(units)),
        "alignment": dict(ALIGNMENTS),
        "mask": "inside the frame's mask (the image without its border) and the lens's field, true depth known (in "
        f"C3VD neither 0 nor 65535), 0 < true depth < {max_depth_mm:g} mm, prediction valid and positive; predictions "
        "are not clipped",
        "max_depth_mm": max_depth_mm,
        "averaged": "over the pixels of a frame, then over frames",
        "frames_of_truth": len(truth),
        "frames_predicted": len(files),
        "frames_judged": len(rows),
        "mean": mean,
        "frames": rows,
        "skipped": skipped,
    }
    return Evaluation(with_versions(result), {name: np.mean(curves, 0) for name, curves in within.items()})


def _no_depth(frame: Frame, max_depth_mm: float) -> str:
    """Why a frame has no depth to judge by; empty where it has."""
    if frame.true_distance is None:
        return f"{frame.name}: no true depth"
    if not true_depth(frame, max_depth_mm)[1].any():
        return f"{frame.name}: the true depth is invalid everywhere (0, or at least {max_depth_mm:g} mm)"
    return ""


def shared_frames(
    ours: Mapping[int, Any] | Sequence[int], theirs: Sequence[int], what: str, source: str, common: bool
) -> list[int]:
    """Frame numbers of both, in order. Raises InputError, saying which match, when there is none, or when ours has
    others too and they are not to be left out (`common`)."""
    mine, known = sorted(ours), set(theirs)
    both = [n for n in mine if n in known]
    if not both:
        raise InputError(
            f"{source}: none of its frames is among the {what}: it has {span(theirs)}, they are for {span(mine)}; do "
            "both count from the same frame? (frame_offset in densify_map.json shifts a map's)"
        )
    if len(both) < len(mine) and not common:
        alone = [n for n in mine if n not in known]
        raise InputError(
            f"{source}: it has {span(theirs)}, the {what} are for {span(mine)}: {len(both)} match ({span(both)}), "
            f"{len(alone)} do not ({_listed(alone)}). Give the truth of the same frames, or --common to judge those "
            "that match"
        )
    return both


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:5])) + (f" and {len(numbers) - 5} more" if len(numbers) > 5 else "")


# Maps


def read_run(folder: Path) -> list[DenseMapFiles]:
    """The dense maps of a densify run, or of one of its map folders. Raises InputError when there are none."""
    maps = [read_dense_map(f) for f in map_folders(folder)]
    if not maps:
        raise InputError(f"{folder}: neither map_* folders (a densify run) nor .npz files (predictions)")
    return maps


def dense_models(maps: Sequence[DenseMapFiles]) -> list[Model]:
    """Dense maps, with their keyframes as trajectories."""
    return [
        Model(
            in_order(m.id, m.numbers.tolist(), m.map_from_cam[:, :3, 3]),
            {"sparse": m.sparse, "sparse_inliers": m.sparse[m.sparse_inlier], "dense": m.vertices},
            m.triangles,
        )
        for m in maps
    ]


def sparse_models(sparse_map: SparseMap) -> list[Model]:
    """Sparse maps, with their keyframes as trajectories."""
    return [Model(keyframe_trajectory(s), {"sparse": s.points}) for s in sparse_map.submaps]


def with_trajectories(models: Sequence[Model], trajectories: Sequence[Trajectory]) -> list[Model]:
    """Models with the poses of all localised frames in place of their keyframes', by map id. Raises InputError where a
    map has none."""
    by_id = {t.id: t for t in trajectories}
    missing = [m.trajectory.id for m in models if m.trajectory.id not in by_id]
    if missing:
        raise InputError(f"map {missing[0]} has no trajectory; there are those of {sorted(by_id)}")
    return [Model(by_id[m.trajectory.id], m.clouds, m.triangles) for m in models]


def read_models(path: Path, trajectory: Path | None = None) -> list[Model]:
    """Whatever has poses at a path: a densify run, a map, or trajectories. `trajectory` replaces the keyframes' poses;
    a multi-map tree brings its own. Raises InputError saying what was found and what would be right."""
    if map_folders(path):
        models = dense_models(read_run(path))
    elif path.is_file() and trajectory_files(path):
        return [Model(t) for t in read_trajectories(path)]
    else:
        try:
            models = sparse_models(read_map(path))
        except InputError as error:
            if path.is_dir() and trajectory_files(path):
                return [Model(t) for t in read_trajectories(path)]
            raise InputError(
                f"{path}: neither map_* folders (a densify run) nor .npz files (predictions) nor a trajectory, and no "
                f"map: {error}"
            ) from error
        trajectory = trajectory or (path if trajectory_files(path) else None)
    return models if trajectory is None else with_trajectories(models, read_trajectories(trajectory))


def read_truth(frames: FrameSequence, mesh: Path | None = None, with_surface: bool = True) -> Truth:
    """Poses of every frame and, where there is true depth, the wall. Frames are read once, one at a time.

    The true mesh is the one given; else C3VD's own, beside its frames; else the triangulated true depth of some frames.
    Raises InputError when no frame has a pose.
    """
    poses: dict[int, np.ndarray] = {}
    times: list[float] = []
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    order = np.argsort(frames.numbers, kind="stable")
    if mesh is None and (Path(frames.source) / COVERAGE_MESH).is_file():
        mesh = Path(frames.source) / COVERAGE_MESH
    chosen = set() if mesh else set(order[:: -(-len(order) // _MESH_FRAMES)].tolist())
    any_depth = False

    def watched() -> Iterator[Frame]:
        nonlocal any_depth
        for i in order.tolist():
            frame = frames[i]
            if frame.true_world_from_cam is not None:
                poses[frame.number] = frame.true_world_from_cam
            if frame.time is not None:
                times.append(frame.time)
            any_depth |= frame.true_distance is not None and frame.true_world_from_cam is not None
            if with_surface:
                if i in chosen:
                    step = np.sqrt(2 * len(chosen) * frame.camera.width * frame.camera.height / _MESH_TRIANGLES)
                    parts.append(depth_triangles(frame, max(1, int(np.ceil(step)))))
                yield frame

    cloud = None
    try:
        cloud = true_cloud(watched())
    except InputError:
        if any_depth and with_surface:
            raise
    if not poses:
        raise InputError(f"{frames.source}: no frame has a true pose; a trajectory or a surface needs them")
    period = float(np.median(np.diff(times))) if len(times) > 1 else None
    common = (frames.source, poses, sorted(frames.numbers), period)
    if cloud is None:
        return Truth(*common, None, "the sequence has true poses but no true depth" if with_surface else "")
    sampling = (
        f"{len(cloud)} points: every second pixel of {len(frames)} frames unprojected at true poses, one point kept in "
        f"each cube of {CUBE_MM:g} mm"
    )
    if mesh is not None:
        vertices, triangles = read_mesh(mesh)
        source = f"{mesh.name}, {len(triangles)} triangles"
    else:
        counts = np.cumsum([0, *(len(v) for v, _ in parts)])
        vertices = np.concatenate([v for v, _ in parts])
        triangles = np.concatenate([t + n for (_, t), n in zip(parts, counts, strict=False)])
        source = f"true depth of {len(parts)} frames triangulated, {len(triangles)} triangles"
    surface = Surface(vertices, triangles) if len(triangles) else None
    if mesh is not None and surface is not None:
        off = float(np.median(surface.distance(cloud[:: max(1, len(cloud) // 5000)])))
        if off > 2:
            raise InputError(
                f"{mesh}: the true depth is {off:.3g} mm from it (median); expected the surface that the sequence "
                "shows, in mm, in the frame of reference of its poses"
            )
    return Truth(*common, TrueSurface(cloud, sampling, surface, source))


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of a PLY, OBJ, STL or GLB. Raises InputError when it is none."""
    import trimesh

    if not path.is_file():
        raise InputError(f"{path}: no such mesh")
    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh", skip_materials=True)
        vertices, triangles = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, int)
    except Exception as error:  # whatever a broken file makes the reader stumble over
        raise InputError(f"{path}: not a mesh that can be read ({type(error).__name__}: {error})") from error
    if not len(triangles):
        raise InputError(f"{path}: no triangles in it")
    return vertices, triangles


def judge_maps(
    models: Sequence[Model],
    truth: Truth,
    mm_per_unit: float | None = None,
    thresholds_mm: Sequence[float] = THRESHOLDS_MM,
    common: bool = False,
) -> Evaluation:
    """Trajectory and surface errors of every submap, each after its own Sim(3), and of all together.

    A map that cannot be aligned says why, and the others are judged; when none can, InputError is raised. Keyframes
    that the truth has not are refused as predictions are. A surface whose turn about the line of travel is anybody's
    guess gets no figures.
    """
    for m in models:
        try:
            shared_frames(m.trajectory.numbers.tolist(), truth.numbers, "poses", truth.source, common)
        except InputError as error:
            raise InputError(f"map {m.trajectory.id}: {error}") from error
    rows: list[dict[str, Any]] = []
    aligned: list[AlignedTrajectory] = []
    errors: dict[str, list[SurfaceErrors]] = {name: [] for name in _CLOUDS}
    meshes = []
    for m in models:
        row: dict[str, Any] = {"map": m.trajectory.id, "keyframes": int(m.trajectory.keyframe.sum())}
        rows.append(row)
        try:
            found = align_trajectory(m.trajectory, truth.poses, mm_per_unit)
        except InputError as error:
            row["error"] = str(error)
            continue
        aligned.append(found)
        row |= found.summary()
        if truth.surface is None or not m.clouds:
            continue
        if found.sideways < _LEAST_AGREEMENT:
            row["surface_error"] = (
                f"the sideways motion of the map's cameras and of the true ones agrees by {found.sideways:.2f} only (1 "
                f"would be fully; at least {_LEAST_AGREEMENT:g}): the map may be turned about its line of travel, and "
                "its surface cannot be compared"
            )
            continue
        for name, cloud in m.clouds.items():
            if not len(cloud):
                row[name] = None
                continue
            points = found.true_from_map.apply(cloud)
            errors[name].append(surface_errors(points, truth.surface))
            row[name] = errors[name][-1].summary(thresholds_mm)
            if name == "dense" and m.triangles is not None:
                distance = errors[name][-1].accuracy
                meshes.append(ErrorMesh(f"map_{m.trajectory.id:03d}", points, m.triangles, distance))
    if not aligned:
        raise InputError(f"no map could be evaluated; map {rows[0]['map']}: {rows[0]['error']}")
    refused = [row for row in rows if "surface_error" in row]
    if refused and len(refused) == len(aligned) and truth.surface is not None:
        raise InputError(f"no map could be evaluated; map {refused[0]['map']}: {refused[0]['surface_error']}")
    made = {name: pooled(found) for name, found in errors.items() if found}
    trajectory = trajectory_summary(aligned, [m.trajectory for m in models], truth.numbers)
    result = {
        "kind": "surface" if made else "trajectory",
        "unit": "mm; shares of 1",
        "alignment": "Sim(3) of each submap's trajectory to the true one (least ATE); SE(3) where the map is in mm",
        "mask": "true points inside the frames' mask (the image without its border) and the lens's field, true depth "
        "known (in C3VD neither 0 nor 65535); no cap; every model point counts",
        "truth": _described(truth),
        "thresholds_mm": list(thresholds_mm),
        "trajectory": {**trajectory, "ms_per_keyframe": _ms_per_keyframe(truth, trajectory["keyframes"])},
        "all": {name: found.summary(thresholds_mm) for name, found in made.items()},
        "maps": rows,
    }
    curves = {
        name: np.searchsorted(np.sort(found.accuracy), EDGES_MM, "right") / len(found.accuracy)
        for name, found in made.items()
    }
    return Evaluation(with_versions(result), curves, meshes)


def _described(truth: Truth) -> dict[str, Any]:
    surface = truth.surface
    return {
        "frames": len(truth.numbers),
        "poses": len(truth.poses),
        "cloud": truth.no_surface if surface is None else surface.sampling,
        "cloud_points": None if surface is None else len(surface.cloud),
        "cloud_spacing_mm": None if surface is None else surface.spacing_mm,
        "mesh": None if surface is None or surface.mesh is None else surface.mesh_source,
    }


def _ms_per_keyframe(truth: Truth, keyframes: int) -> float | None:
    """Time that the recording leaves for each keyframe."""
    if truth.period is None or not truth.period > 0 or not keyframes:
        return None
    return 1000 * truth.period * len(truth.numbers) / keyframes


def is_made_by_us(path: Path) -> bool:
    """Whether a folder holds predictions or a densify run, so that metrics may be written into it."""
    return path.is_dir() and (any(path.glob("*.npz")) or bool(map_folders(path)))


def in_mm(folder: Path) -> bool:
    """Whether a densify run, or the one that a map folder is of, says that its maps are in mm."""
    return run_record(folder).get("unit") == "mm"


def withheld_errors(folder: Path) -> list[dict[str, Any]]:
    """What a densify run says of the points that it withheld, with the constant distance's for comparison: the judge
    where there is no truth. Empty where nothing was withheld."""
    if not (folder / "run.json").is_file():
        return []
    maps = read_json(folder / "run.json").get("maps", [])
    names = ("withheld", "withheld_constant")
    return [
        {"map": m["map"], **{name: m.get(name) for name in names}}
        for m in maps
        if isinstance(m, dict) and m.get("withheld")
    ]


def judge_gap(maps: Sequence[DenseMapFiles], join: Path) -> dict[str, Any]:
    """The gap between two maps of a run brought together by a Sim(3) file:
    {"first": 0, "second": 1, "scale": s, "rotation": 3x3 or [axis-angle vector, rad], "translation": [3]}, second = s R
    first + t.
    """
    from scipy.spatial.transform import Rotation

    data = read_json(join)
    try:
        given = np.asarray(data["rotation"], float)
        rotation = Rotation.from_rotvec(given).as_matrix() if given.shape == (3,) else given.reshape(3, 3)
        sim = Similarity(float(data["scale"]), rotation, np.asarray(data["translation"], float).reshape(3))
        first, second = int(data["first"]), int(data["second"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{join}: expected first, second, scale, rotation, translation ({error!r})") from error
    if not (np.isfinite(sim.scale) and sim.scale > 0):
        raise InputError(f"{join}: scale {sim.scale}; expected a positive number")
    check_rigid(np.vstack([np.column_stack([sim.rotation, sim.translation]), [0, 0, 0, 1]]), f"{join}: rotation")
    by_id = {m.id: m for m in maps}
    missing = [i for i in (first, second) if i not in by_id]
    if missing:
        raise InputError(f"{join}: map {missing[0]} is not in the run, which has {sorted(by_id)}")
    gap = surface_gap(by_id[first], by_id[second], sim)
    return {"first": first, "second": second, "unit": "share of the distance to the camera", **plain(gap)}
