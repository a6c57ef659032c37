"""A dense map of a run folder with all that other programs ask for: colours, normals, keyframes, what these observed,
and what they see of the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from densify.dense_map import (
    DenseMapFiles,
    Surface,
    map_folders,
    read_dense_map,
    read_keyframes,
    run_record,
    surface_folders,
)
from densify.inputs import fitted_to_frames
from densify.scale_file import scale_of
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.below import given
from lightdepth.files.meshes import load_mesh
from lightdepth.files.reading import reading
from lightdepth.geometry import depth_from_distance
from lightdepth.maps import read_map
from lightdepth.maps.endocartoscope import TrajectoryPose, read_trajectory, trajectory_path
from lightdepth.sparse_map import Keyframe, Submap


@dataclass(frozen=True, eq=False)
class Exportable:
    """One dense map, all of it in the surface's unit ("mm" or "map units").

    colors (n, 3) uint8 and normals (n, 3) of the vertices; the submap's points are those of sparse.ply. `tracked` is
    whether its keyframes have their observations: they do where the map that the run was made of was found. `localised`
    are all frames that the SLAM has a pose of, where its tree says so.
    """

    name: str
    dense: DenseMapFiles
    colors: np.ndarray
    normals: np.ndarray
    submap: Submap
    tracked: bool
    unit: str
    localised: tuple[TrajectoryPose, ...] = ()

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.dense.vertices, self.dense.triangles)

    def thinned(self, count: int) -> np.ndarray:
        """Rows of at most so many vertices, evenly spaced in the order of the file."""
        total = len(self.dense.vertices)
        return np.arange(total)[:: max(1, -(-total // count))] if count else np.zeros(0, int)

    def seen_from(self, keyframe: Keyframe, camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:
        """Depth (H, W) float32 along the axis, 0 where the surface is not seen, and its normals (H, W, 3) in camera
        axes, towards the camera; by a camera in the keyframe's place."""
        rays, valid = camera.rays()
        map_from_cam = np.linalg.inv(keyframe.cam_from_map)
        distance, triangle = self.surface.meet(map_from_cam[:3, 3], rays[valid] @ map_from_cam[:3, :3].T)
        hit = triangle >= 0
        depth, normals = np.zeros(valid.shape, np.float32), np.zeros((*valid.shape, 3), np.float32)
        depth[valid] = np.where(hit, depth_from_distance(np.where(hit, distance, 0), rays[valid][:, 2]), 0)
        a, b, c = (self.dense.vertices[self.dense.triangles[triangle[hit], k]] for k in range(3))
        normal = np.cross(b - a, c - a) @ keyframe.cam_from_map[:3, :3].T
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        away = (normal * rays[valid][hit]).sum(1) > 0
        seen = np.zeros((len(hit), 3), np.float32)
        seen[hit] = np.where(away[:, None], -normal, normal)
        normals[valid] = seen
        return depth, normals


def read_exportables(run: Path, sparse: Path | None = None) -> list[Exportable]:
    """The dense maps of a densify run with its joined ones, or of one map folder.

    What keyframes observed is read from `sparse`, else from the map that the run itself names, where it is still there.
    Raises InputError where there is no dense map, or where `sparse` is not the map that the run was made of.
    """
    folders = surface_folders(run)
    if not map_folders(run):
        raise InputError(run, "no map_* folders in it", "expected a densify run, or one of its map folders")
    record = run_record(run)
    path = sparse or _map_of(folders[0].parent, record)
    submaps = {} if path is None else _submaps(path, folders[0], record)
    return [_exportable(folder, record, submaps, path, given=sparse) for folder in folders]


def _exportable(
    folder: Path, record: Mapping[str, object], submaps: Mapping[int, Submap], path: Path | None, given: Path | None
) -> Exportable:
    dense = read_dense_map(folder)
    if not len(dense.triangles):
        raise InputError(folder, "its surface is empty", "export the others one by one")
    submap = submaps.get(dense.id) if not folder.name.startswith("joined_") else None
    asked = _argument(record, "mm_per_unit")
    scale = float(asked) if isinstance(asked, (int, float)) and asked else 1.0
    if asked == "light" and record.get("unit") == "mm":
        known = scale_of(folder, dense.id)
        scale = known.mm_per_unit or 1.0 if known is not None else 1.0
    if submap is not None:
        submap = in_unit(submap, scale)
    if submap is not None and not _is_of(submap, dense):
        if given is not None:
            raise InputError(given, f"not the map that {folder.name} was made of", "give that map, or leave it out")
        submap = None
    unit = record.get("unit")
    if dense.colors is None:
        raise InputError(folder / "mesh.ply", "no colours of its vertices", "expected one each")
    return Exportable(
        name=folder.name,
        dense=dense,
        colors=dense.colors,
        normals=_normals(folder / "mesh.ply"),
        submap=submap or _without_observations(folder, dense),
        tracked=submap is not None,
        unit=unit if isinstance(unit, str) else "map units",
        localised=_localised(path, submap.id, scale) if submap is not None and path is not None else (),
    )


def in_unit(submap: Submap, scale: float) -> Submap:
    """The submap with its lengths multiplied."""

    def moved(keyframe: Keyframe) -> Keyframe:
        pose = keyframe.cam_from_map.copy()
        pose[:3, 3] *= scale
        return replace(keyframe, cam_from_map=pose)

    return replace(submap, points=submap.points * scale, keyframes=tuple(map(moved, submap.keyframes)))


def _argument(record: Mapping[str, object], name: str) -> object:
    arguments = record.get("arguments")
    return arguments.get(name) if isinstance(arguments, Mapping) else None


def _map_of(run: Path, record: Mapping[str, object]) -> Path | None:
    """The map that a run was made of, where it is still there."""
    if (run / "sparse").is_dir():  # made by the run, or made anew
        return run / "sparse"
    named = _argument(record, "map")
    if isinstance(named, str) and Path(named).exists():
        return Path(named)
    inside = run / "data" / "slam"  # where `demo` has it
    return inside if inside.is_dir() else None


def _submaps(path: Path, folder: Path, record: Mapping[str, object]) -> dict[int, Submap]:
    """The submaps of a map by id, at the size of the frames that the run's map folder is of."""
    camera = read_dense_map(folder).camera
    given = camera if _argument(record, "camera") else None
    fitted = fitted_to_frames(read_map(path), camera.width, camera.height, given)
    return {submap.id: submap for submap in fitted.submaps}


def _localised(path: Path, map_id: int, scale: float) -> tuple[TrajectoryPose, ...]:
    """All localised frames of a map in the tree of EndoCartoScope or CLiMB, in the surface's unit; none elsewhere."""
    name = trajectory_path(path, map_id).name
    files = given(sorted(path.rglob(name)), path) if path.is_dir() else []

    def moved(pose: TrajectoryPose) -> TrajectoryPose:
        cam_from_map = pose.cam_from_map.copy()
        cam_from_map[:3, 3] *= scale
        return replace(pose, cam_from_map=cam_from_map)

    return tuple(map(moved, read_trajectory(files[0]))) if len(files) == 1 else ()


def _is_of(submap: Submap, dense: DenseMapFiles) -> bool:
    """Whether points and keyframes are those of the run, up to the single precision of its files."""
    if [k.number for k in submap.keyframes] != dense.numbers.tolist() or submap.points.shape != dense.sparse.shape:
        return False
    near = np.abs(submap.points - dense.sparse).max() <= 1e-5 * max(1.0, float(np.abs(dense.sparse).max()))
    centers = np.stack([k.center for k in submap.keyframes])
    return bool(near) and bool(np.allclose(centers, dense.map_from_cam[:, :3, 3], rtol=1e-5, atol=1e-6))


def _without_observations(folder: Path, dense: DenseMapFiles) -> Submap:
    """Keyframes as the run's files have them: names, camera, poses. Where their table is gone, numbers are names."""
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    keyframes = tuple(
        Keyframe(row.name, dense.camera, np.linalg.inv(pose), *none)
        for row, pose in zip(read_keyframes(folder, dense.numbers.tolist()), dense.map_from_cam, strict=True)
    )
    return Submap(dense.id, keyframes, np.arange(1, len(dense.sparse) + 1), dense.sparse)


def _normals(path: Path) -> np.ndarray:
    """Unit normals (n, 3) of a mesh file's vertices."""
    mesh: Any = load_mesh(path)
    with reading(path, "a mesh with normals"):
        return np.asarray(mesh.vertex_normals, float)
