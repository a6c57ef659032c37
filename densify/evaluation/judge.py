"""What `lightdepth evaluate` says of maps: their errors against a sequence with truth, and the gap between two of them.

Units, alignment and mask are in the answer. Frames are taken by their number: their order on disk changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from densify.dense_map import DenseMapFiles
from densify.evaluation.errors import SurfaceErrors, pooled, surface_errors, surface_gap
from densify.evaluation.judged_map import JudgedMap
from densify.evaluation.records import (
    EDGES_MM,
    ErrorMesh,
    Evaluation,
    MapFigures,
    MapGap,
    MapsJudged,
    SurfaceFigures,
    TruthFigures,
)
from densify.evaluation.trajectory import AlignedTrajectory, align_trajectory, trajectory_summary
from densify.evaluation.truth import Truth, shared_frames
from densify.similarity import Similarity
from lightdepth.errors import InputError
from lightdepth.files.schema import read_json
from lightdepth.reporting.progress import counted_through
from lightdepth.sparse_map import check_rigid

THRESHOLDS_MM = (1.0, 2.0, 5.0)
_CLOUDS = ("sparse", "sparse_inliers", "dense")
_LEAST_AGREEMENT = 0.5


def judge_maps(
    models: Sequence[JudgedMap],
    truth: Truth,
    mm_per_unit: float | None = None,
    thresholds_mm: Sequence[float] = THRESHOLDS_MM,
    common: bool = False,
) -> Evaluation[MapsJudged]:
    """Trajectory and surface errors of every submap, each after its own Sim(3), and of all together.

    A map that cannot be aligned says why, and the others are judged; when none can, InputError is raised. Keyframes
    that the truth has not are refused as predictions are. A surface whose turn about the line of travel is anybody's
    guess gets no figures.
    """
    for m in models:
        try:
            shared_frames(m.trajectory.numbers.tolist(), truth.numbers, "poses", truth.source, common)
        except InputError as error:
            raise error.within(f"map {m.trajectory.id}") from error
    maps: list[MapFigures] = []
    aligned: list[AlignedTrajectory] = []
    errors: dict[str, list[SurfaceErrors]] = {name: [] for name in _CLOUDS}
    meshes = []
    for m in counted_through(models, "Judging maps"):
        alone = MapFigures(m.trajectory.id, int(m.trajectory.keyframe.sum()))
        try:
            found = align_trajectory(m.trajectory, truth.poses, mm_per_unit)
        except InputError as error:
            maps.append(replace(alone, error=str(error)))
            continue
        aligned.append(found)
        alone = replace(alone, aligned=found.summary())
        if truth.surface is None or not m.clouds:
            maps.append(alone)
            continue
        if found.sideways < _LEAST_AGREEMENT:
            reason = (
                f"the sideways motion of the map's cameras and of the true ones agrees by {found.sideways:.2f} only (1 "
                f"would be fully; at least {_LEAST_AGREEMENT:g}): the map may be turned about its line of travel, and "
                "its surface cannot be compared"
            )
            maps.append(replace(alone, surface_error=reason))
            continue
        clouds: dict[str, SurfaceFigures | None] = {}
        for name, cloud in m.clouds.items():
            if not len(cloud):
                clouds[name] = None
                continue
            points = found.true_from_map.apply(cloud)
            distances = surface_errors(points, truth.surface, m.triangles if name == "dense" else None)
            errors[name].append(distances)
            clouds[name] = distances.summary(thresholds_mm)
            if name == "dense" and m.triangles is not None:
                meshes.append(ErrorMesh(f"map_{m.trajectory.id:03d}", points, m.triangles, distances.accuracy))
        maps.append(replace(alone, clouds=clouds))
    if not aligned:
        raise InputError("the maps", "none could be evaluated", f"map {maps[0].map_id}: {maps[0].error}")
    refused = [m for m in maps if m.surface_error]
    if refused and len(refused) == len(aligned) and truth.surface is not None:
        raise InputError("the maps", "none could be evaluated", f"map {refused[0].map_id}: {refused[0].surface_error}")
    made = {name: pooled(found) for name, found in errors.items() if found}
    trajectory = trajectory_summary(aligned, [m.trajectory for m in models], truth.numbers)
    judged = MapsJudged(
        _described(truth),
        tuple(thresholds_mm),
        replace(trajectory, ms_per_keyframe=_ms_per_keyframe(truth, trajectory.keyframes)),
        {name: found.summary(thresholds_mm) for name, found in made.items()},
        maps,
    )
    curves = {
        name: np.searchsorted(np.sort(found.accuracy), EDGES_MM, "right") / len(found.accuracy)
        for name, found in made.items()
    }
    return Evaluation(judged, curves, meshes)


def _described(truth: Truth) -> TruthFigures:
    surface, counts = truth.surface, (len(truth.numbers), len(truth.poses))
    if surface is None:
        return TruthFigures(*counts, truth.no_surface, None, None, None)
    spacing = surface.spacing_mm if np.isfinite(surface.spacing_mm) else None  # a single point has no neighbour
    mesh = None if surface.mesh is None else surface.mesh_source
    return TruthFigures(*counts, surface.sampling, len(surface.cloud), spacing, mesh, surface.edges.share)


def _ms_per_keyframe(truth: Truth, keyframes: int) -> float | None:
    """Time that the recording leaves for each keyframe."""
    if truth.period is None or not truth.period > 0 or not keyframes:
        return None
    return 1000 * truth.period * len(truth.numbers) / keyframes


def judge_gap(maps: Sequence[DenseMapFiles], join: Path) -> MapGap:
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
        raise InputError(
            join,
            f"a field is missing or of another kind ({error!r})",
            "expected first, second, scale, rotation, translation",
        ) from error
    if not (np.isfinite(sim.scale) and sim.scale > 0):
        raise InputError(join, f"scale {sim.scale}", "expected a positive number")
    check_rigid(np.vstack([np.column_stack([sim.rotation, sim.translation]), [0, 0, 0, 1]]), f"{join}: rotation")
    by_id = {m.id: m for m in maps}
    missing = [i for i in (first, second) if i not in by_id]
    if missing:
        raise InputError(join, f"map {missing[0]} is not in the run", f"expected one of {sorted(by_id)}")
    return MapGap(first, second, surface_gap(by_id[first], by_id[second], sim))
