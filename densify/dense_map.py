"""DenseMap: one submap's surface and what it rests on; its files."""

from __future__ import annotations

import csv
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from densify.alignment import Alignment
from densify.fusion.chosen import Volume
from lightdepth import native
from lightdepth.brief import Brief
from lightdepth.calibration import read_camera, write_camera
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.meshes import load_mesh, vertex_columns
from lightdepth.files.named_inputs import with_real_inputs
from lightdepth.files.reading import reading
from lightdepth.files.schema import read_json
from lightdepth.files.tum import read_tum, write_tum
from lightdepth.foreign_text import for_table, from_table
from lightdepth.sparse_map import Keyframe, Submap

GREEN, RED, GREY = (0, 170, 60), (220, 30, 30), (150, 150, 150)
DOUBTED = 0.03
"""Expected error of a vertex, as a share of the distance of a typical inlier, at which its confidence is one half."""


_NUMBER = re.compile(r"(?:map_|joined_)?([0-9]+)")
_FAR = 16  # times its size, twice the distance from the origin: from there on it is taken about its own middle


class Surface:
    """A mesh that rays can be cast at: vertices (n, 3), triangles (m, 3). In single precision, about its own middle
    where it is far from the origin. `diagonal` is that of the box around it, 0 where it is empty."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        self._core = native.open3d().core
        self._scene = native.open3d().t.geometry.RaycastingScene() if len(triangles) else None
        self._middle, self.diagonal = np.zeros(3), 0.0
        if self._scene is not None:
            low, high = vertices.min(0), vertices.max(0)
            self.diagonal = float(np.linalg.norm(high - low))
            if np.abs(low + high).max() > _FAR * np.ptp(vertices, axis=0).max():
                self._middle = (low + high) / 2
            faces = self._core.Tensor(triangles.astype(np.uint32))
            self._scene.add_triangles(self._core.Tensor((vertices - self._middle).astype(np.float32)), faces)

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance (n,) along unit rays (n, 3) from origins (n, 3) or (3,) to the surface; infinite where there is
        none."""
        return self.meet(origins, directions)[0]

    def meet(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances as of `cast`, and the triangle (n,) that each ray meets, -1 where there is none."""
        if self._scene is None or not len(directions):
            return np.full(len(directions), np.inf), np.full(len(directions), -1)
        starts = np.broadcast_to(origins - self._middle, directions.shape)
        rays = np.concatenate([starts, directions], -1).astype(np.float32)
        found = self._scene.cast_rays(self._core.Tensor(rays))
        distance = found["t_hit"].numpy().astype(np.float64)
        return distance, np.where(np.isfinite(distance), found["primitive_ids"].numpy().astype(int), -1)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) from points (n, 3) to the closest of the surface, in single precision; infinite without any."""
        if self._scene is None or not len(points):
            return np.full(len(points), np.inf)
        found = self._scene.compute_distance(self._core.Tensor((points - self._middle).astype(np.float32)))
        result: np.ndarray = found.numpy().astype(np.float64)
        return result

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points (n, 3) of the surface that are closest to points (n, 3), and their triangles (n,)."""
        assert self._scene is not None, "a surface without triangles has no points"
        found = self._scene.compute_closest_points(self._core.Tensor((points - self._middle).astype(np.float32)))
        return found["points"].numpy().astype(np.float64) + self._middle, found["primitive_ids"].numpy().astype(int)


@dataclass(frozen=True)
class Contribution:
    """What a keyframe gave to the surface: the share of its valid pixels that were fused, and their mean weight in
    [0, 1]. And what it looks at: mean confidence and mean number of views of that part of the surface, NaN where it
    sees none."""

    fused_share: float
    fused_weight: float
    confidence: float = np.nan
    views: float = np.nan


@dataclass(frozen=True, repr=False)
class DenseMap(Brief):
    """vertices (n, 3) and triangles (m, 3) in `unit` ("map units" or "mm"), colors (n, 3) in [0, 1]; the alignments,
    one for each keyframe of the submap, in order. `voxel` is the size of the fusion's voxels in the same unit.

    Where the fusion told them, weights (n,) of all views of a vertex together (1 is one view that nothing speaks
    against), and the number of views (n,); the distance (n,) within which two in three vertices like it are expected
    to lie from the true wall (densify.trust); and what each keyframe contributed, by name.
    """

    submap: Submap
    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    alignments: tuple[Alignment, ...]
    voxel: float
    unit: str = "map units"
    weights: np.ndarray | None = None
    views: np.ndarray | None = None
    contributions: Mapping[str, Contribution] = field(default_factory=dict)
    expected_error: np.ndarray | None = None
    unsure_share: float | None = None
    """share of the valid pixels of the aligned keyframes that were left out because they are expected to err by more
    than fusion.max_error; None where nothing was left out by that"""

    @classmethod
    def of(cls, volume: Volume, submap: Submap, alignments: tuple[Alignment, ...]) -> DenseMap:
        """The surface in a volume, as it is now."""
        m = volume.extract_mesh()
        surface = (m.vertices, m.triangles, m.colors)
        return cls(submap, *surface, alignments, volume.voxel, weights=m.weights, views=m.views)

    @classmethod
    def empty(cls, submap: Submap, reason: str) -> DenseMap:
        """No surface, and the reason with every keyframe."""
        alignments = tuple(Alignment(k.name, reason=reason) for k in submap.keyframes)
        return cls(submap, np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)), alignments, 0.0)

    @property
    def confidence(self) -> np.ndarray | None:
        """In [0, 1): 1 / (1 + e²), e being a vertex's expected error in units of what is doubted, so that one half is
        where doubt begins. Where no error is expected for want of a map, w / (1 + w) of its weight w."""
        if self.expected_error is not None and self.aligned:
            return 1 / (1 + (self.expected_error / (DOUBTED * self.inlier_distance)) ** 2)
        return None if self.weights is None else self.weights / (1 + self.weights)

    @cached_property
    def inlier_distance(self) -> float:
        """A typical distance from aligned keyframes to their inliers: the median of their medians, which wrong points
        do not change; 0 without any."""
        medians = []
        for keyframe, alignment in zip(self.submap.keyframes, self.alignments, strict=True):
            rows, held = self.submap.rows_of(alignment.inlier_ids)
            if alignment.ok and held.any():
                medians.append(np.median(np.linalg.norm(keyframe.in_camera(self.submap.points[rows[held]]), axis=1)))
        return float(np.median(medians)) if medians else 0.0

    @property
    def aligned(self) -> list[Alignment]:
        return [a for a in self.alignments if a.ok]

    @property
    def aligned_keyframes(self) -> list[Keyframe]:
        return [k for k, a in zip(self.submap.keyframes, self.alignments, strict=True) if a.ok]

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.vertices, self.triangles)

    def judged_points(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) bool each, over the submap's points: judged by any aligned keyframe, and inlier in most of those."""
        good = np.concatenate([a.inlier_ids for a in self.aligned] or [np.zeros(0, int)])
        bad = np.concatenate([a.outlier_ids for a in self.aligned] or [np.zeros(0, int)])
        votes = np.zeros((2, len(self.submap.points)), int)
        for side, ids in enumerate((good, bad)):
            np.add.at(votes[side], self.submap.rows_of(ids)[0], 1)
        return votes.sum(0) > 0, votes[0] > votes[1]

    def write(
        self,
        folder: str | Path,
        formats: tuple[str, ...] = ("ply",),
        mm_per_unit: float | None = None,
        seen: np.ndarray | None = None,
    ) -> None:
        """mesh.*, cloud.ply, sparse.ply, keyframes.csv, trajectory.tum, camera.json; trajectory times are frame
        numbers. With mm_per_unit, lengths are written in mm. `seen` (n,) is how well each vertex was seen
        (densify.scene.seen_kinds). Of a map that lies far from its origin, origin.json has what all coordinates lack.
        `folder` is made; raises InputError where it is there."""
        import trimesh

        folder = Path(folder)
        if folder.exists():
            raise InputError(folder, "already there", "choose another folder")
        folder.mkdir(parents=True)
        scale = mm_per_unit or 1.0
        rgba = np.concatenate([np.rint(self.colors * 255), np.full((len(self.colors), 1), 255)], 1).astype(np.uint8)
        colors = rgba if len(rgba) else None  # trimesh cannot write the colours of no vertices
        mesh = trimesh.Trimesh(self.vertices * scale, self.triangles, vertex_colors=colors, process=False)
        for suffix in sorted(formats):  # ply last: glTF has no whole numbers, and would refuse `views`
            if suffix == "ply" and self.confidence is not None and self.views is not None and len(self.vertices):
                mesh.vertex_attributes["confidence"] = self.confidence.astype(np.float32)
                mesh.vertex_attributes["views"] = self.views.astype(np.int32)
                if seen is not None:
                    mesh.vertex_attributes["seen"] = seen.astype(np.int32)
                if self.expected_error is not None and self.aligned:
                    mesh.vertex_attributes["expected_error"] = (self.expected_error * scale).astype(np.float32)
            mesh.export(folder / f"mesh.{suffix}")
        normals = mesh.vertex_normals if len(self.vertices) else np.zeros((0, 3))
        write_cloud(folder / "cloud.ply", self.vertices * scale, rgba[:, :3], normals)
        judged, inlier = self.judged_points()
        color = np.where(inlier[:, None], GREEN, np.where(judged[:, None], RED, GREY))
        write_cloud(folder / "sparse.ply", self.submap.points * scale, color)
        self._write_keyframes(folder / "keyframes.csv", scale)
        poses = []
        for keyframe in self.submap.keyframes:
            pose = np.linalg.inv(keyframe.cam_from_map)
            pose[:3, 3] *= scale
            poses.append(pose)
        write_camera(self.submap.keyframes[0].camera, folder / "camera.json")
        if any(self.submap.origin):
            write_origin(folder, self.submap, scale)
        write_tum(folder / "trajectory.tum", [float(k.number) for k in self.submap.keyframes], poses)

    def _write_keyframes(self, path: Path, scale: float) -> None:
        with path.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file:
            table = csv.writer(file)
            columns = ["keyframe", "frame", "ok", "scale", "sigma", "points", "inliers", "inlier_share"]
            table.writerow([*columns, *Contribution.__dataclass_fields__, "reason"])
            for keyframe, a in zip(self.submap.keyframes, self.alignments, strict=True):
                row = [
                    for_table(a.keyframe),
                    keyframe.number,
                    int(a.ok),
                    f"{a.scale * scale:.9g}",
                    f"{a.sigma * scale:.6g}",
                ]
                row += [a.points, len(a.inlier_ids), f"{a.inlier_share:.4f}"]
                found = self.contributions.get(a.keyframe)
                row += [f"{value:.4f}" for value in astuple(found)] if found else [""] * len(fields(Contribution))
                table.writerow([*row, for_table(a.reason)])


def write_origin(folder: Path, submap: Submap, scale: float) -> None:
    """origin.json: what is to be added to the coordinates of the other files for those of the map that was read, in
    their unit. Single precision, which meshes are written in, could not hold both."""
    added = [float(value * scale) for value in submap.origin]
    (folder / "origin.json").write_text(json.dumps({"add_to_all_coordinates": added}) + "\n", encoding="utf-8")


def write_cloud(path: Path, points: np.ndarray, colors: np.ndarray, normals: np.ndarray | None = None) -> None:
    """A binary PLY of points (n, 3) with colors (n, 3) uint8 and, where given, normals (n, 3)."""
    columns = [(name, "<f4") for name in ("x", "y", "z")]
    data = [points.astype("<f4")]
    if normals is not None:
        columns += [(name, "<f4") for name in ("nx", "ny", "nz")]
        data.append(normals.astype("<f4"))
    columns += [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.zeros(len(points), np.dtype(columns))
    for (name, _), values in zip(
        columns, np.concatenate([*(d.T for d in data), colors.T.astype(np.float32)]), strict=True
    ):
        rows[name] = values
    types = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {types[kind]} {name}" for name, kind in columns] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


@dataclass(frozen=True, repr=False)
class DenseMapFiles(Brief):
    """A dense map read back from its folder: the surface, the sparse points, which of them were used and which were
    found wrong, the keyframes' frame numbers and poses map_from_cam (n, 4, 4), and the map's camera; confidence, views,
    expected error, colour (n, 3) uint8 and how well it was seen (densify.scene.seen_kinds) of each vertex, where the
    file has them."""

    id: int
    vertices: np.ndarray
    triangles: np.ndarray
    sparse: np.ndarray
    sparse_inlier: np.ndarray
    numbers: np.ndarray
    map_from_cam: np.ndarray
    camera: CameraModel
    confidence: np.ndarray | None = None
    views: np.ndarray | None = None
    expected_error: np.ndarray | None = None
    colors: np.ndarray | None = None
    sparse_wrong: np.ndarray | None = None
    seen: np.ndarray | None = None


@dataclass(frozen=True)
class KeyframeRow:
    """A keyframe as keyframes.csv has it: its name, whether it is in the surface, and the reason where it is not."""

    name: str
    used: bool = True
    reason: str = ""


def read_keyframes(folder: Path, numbers: Sequence[int]) -> list[KeyframeRow]:
    """The rows of keyframes.csv for frames of these numbers. Where the table is gone, numbers are names. Raises
    InputError where one has no row."""
    path = folder / "keyframes.csv"
    if not path.is_file():
        return [KeyframeRow(f"{int(n):06d}") for n in numbers]
    with reading(path, "a table of keyframes"), path.open(encoding="utf-8", newline="") as file:
        found = {
            int(row["frame"]): KeyframeRow(
                from_table(row["keyframe"]), row.get("ok", "1") == "1", from_table(row.get("reason") or "")
            )
            for row in csv.DictReader(file)
        }
    if missing := [n for n in numbers if n not in found]:
        cure = "copy it again from the run, or leave it out: then numbers are names"
        raise InputError(path, f"no row for frame {missing[0]}, which is in the trajectory beside it", cure)
    return [found[int(n)] for n in numbers]


def map_folders(path: Path) -> list[Path]:
    """The map folders of a densify run, or the folder itself where it is one (map_000, joined_000); else none. What has
    no number in its name (map_notes) is not of the run."""
    if (path / "mesh.ply").is_file() and (path / "trajectory.tum").is_file():
        return [path]
    return _numbered(path, "map_*")


def surface_folders(path: Path) -> list[Path]:
    """The map folders of a densify run, then those of its joined surfaces; or the folder itself where it is one."""
    found = map_folders(path)
    return found if found == [path] else found + _numbered(path, "joined_*")


def _numbered(path: Path, names: str) -> list[Path]:
    return sorted(p for p in path.glob(names) if p.is_dir() and _NUMBER.fullmatch(p.name))


def run_record(path: Path) -> Mapping[str, object]:
    """run.json of a run folder, or of the one that a map folder is in, with the paths of its inputs; empty where there
    is none."""
    folder = path.parent if map_folders(path) == [path] else path
    if not (folder / "run.json").is_file():
        return {}
    found = read_json(folder / "run.json")
    if not isinstance(found, dict):
        raise InputError(folder / "run.json", f"holds {type(found).__name__}", "expected what a verb wrote there")
    return with_real_inputs(found, folder)


def read_dense_map(folder: str | Path) -> DenseMapFiles:
    """What DenseMap.write wrote. Raises InputError when it is not all there."""
    folder = Path(folder)
    for name in ("mesh.ply", "sparse.ply", "trajectory.tum", "camera.json"):
        if not (folder / name).is_file():
            raise InputError(folder, f"{name} missing", "expected a map folder of a `lightdepth densify` run")
    map_id = _NUMBER.fullmatch(folder.name)
    if map_id is None:
        raise InputError(folder, "no number of a map in its name", "expected a name such as map_000 or joined_000")
    with reading(folder, "a readable map folder"):
        found = _dense_map(folder, int(map_id[1]))
    known = found.camera.provenance
    if known is not None and known.doubt:
        warnings.warn(known.doubt, stacklevel=2)
    return found


def _dense_map(folder: Path, map_id: int) -> DenseMapFiles:
    mesh, cloud = _read_ply(folder / "mesh.ply"), _read_ply(folder / "sparse.ply")
    triangles = np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), int)
    vertices = np.asarray(getattr(mesh, "vertices", np.zeros((0, 3))), float)  # an empty mesh is read as a scene
    if not (np.isfinite(vertices).all() and ((triangles >= 0) & (triangles < len(vertices))).all()):
        found = "a vertex is at no place, or a triangle has one that is not there"
        raise InputError(folder / "mesh.ply", found, "copy it again from the run")
    numbers, poses = read_tum(folder / "trajectory.tum")
    own = vertex_columns(mesh, ("confidence", "views", "expected_error", "seen")) if len(triangles) else {}
    return DenseMapFiles(
        id=map_id,
        vertices=vertices,
        triangles=triangles,
        sparse=np.asarray(cloud.vertices, float),
        sparse_inlier=(np.asarray(cloud.colors)[:, :3] == GREEN).all(1),
        sparse_wrong=(np.asarray(cloud.colors)[:, :3] == RED).all(1),
        numbers=numbers.round().astype(int),
        map_from_cam=poses,
        camera=read_camera(folder / "camera.json"),
        colors=_colors(mesh, len(triangles)),
        **own,
    )


def _colors(mesh: Any, triangles: int) -> np.ndarray | None:
    found = getattr(mesh.visual, "vertex_colors", None) if triangles else None  # one with a texture has none
    return None if found is None or len(found) != len(mesh.vertices) else np.asarray(found)[:, :3].astype(np.uint8)


def _read_ply(path: Path) -> Any:
    return load_mesh(path, "a PLY file, or it is damaged", "copy it again")
