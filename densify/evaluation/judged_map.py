"""The maps that are judged, of every kind that there is: dense runs, sparse maps, trajectories alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from densify.dense_map import DenseMapFiles, map_folders, read_dense_map, run_record
from densify.evaluation.depth_files import other_depth
from densify.evaluation.trajectory import (
    Trajectory,
    in_order,
    keyframe_trajectory,
    read_trajectories,
    trajectory_files,
)
from lightdepth.errors import InputError
from lightdepth.maps import read_map
from lightdepth.maps.convention import Reader
from lightdepth.sparse_map import SparseMap


@dataclass(frozen=True, eq=False)
class JudgedMap:
    """One submap as it is judged: its trajectory, point clouds (n, 3) in map units by name ("sparse", "sparse_inliers",
    "dense"), and triangles over the dense ones."""

    trajectory: Trajectory
    clouds: Mapping[str, np.ndarray] = field(default_factory=dict)
    triangles: np.ndarray | None = None


def read_run(folder: Path) -> list[DenseMapFiles]:
    """The dense maps of a densify run, or of one of its map folders. Raises InputError when there are none."""
    maps = [read_dense_map(f) for f in map_folders(folder)]
    if not maps:
        if not folder.exists():
            raise InputError(folder, "does not exist", "expected the run folder of `lightdepth densify`")
        raise InputError(folder, "neither map_* folders nor .npz files in it", "expected a densify run, or predictions")
    return maps


def dense_models(maps: Sequence[DenseMapFiles]) -> list[JudgedMap]:
    """Dense maps, with their keyframes as trajectories."""
    return [
        JudgedMap(
            in_order(m.id, m.numbers.tolist(), m.map_from_cam[:, :3, 3]),
            {"sparse": m.sparse, "sparse_inliers": m.sparse[m.sparse_inlier], "dense": m.vertices},
            m.triangles,
        )
        for m in maps
    ]


def sparse_models(sparse_map: SparseMap) -> list[JudgedMap]:
    """Sparse maps, with their keyframes as trajectories."""
    return [JudgedMap(keyframe_trajectory(s), {"sparse": s.points}) for s in sparse_map.submaps]


def with_trajectories(models: Sequence[JudgedMap], trajectories: Sequence[Trajectory]) -> list[JudgedMap]:
    """Maps with the poses of all localised frames in place of their keyframes', by map id. Raises InputError where a
    map has none."""
    by_id = {t.id: t for t in trajectories}
    missing = [m.trajectory.id for m in models if m.trajectory.id not in by_id]
    if missing:
        raise InputError(
            f"map {missing[0]}", "it has no trajectory", f"expected one of each map; there are those of {sorted(by_id)}"
        )
    return [JudgedMap(by_id[m.trajectory.id], m.clouds, m.triangles) for m in models]


def read_models(path: Path, trajectory: Path | None = None, reader: Reader = Reader()) -> list[JudgedMap]:
    """Whatever has poses at a path: a densify run, a map, or trajectories. `trajectory` replaces the keyframes' poses;
    a multi-map tree brings its own. Raises InputError saying what was found and what would be right."""
    if map_folders(path):
        models = dense_models(read_run(path))
    elif path.is_file() and trajectory_files(path):
        return [JudgedMap(t) for t in read_trajectories(path, reader)]
    else:
        try:
            models = sparse_models(read_map(path, reader))
        except InputError as error:
            if path.is_dir() and trajectory_files(path):
                return [JudgedMap(t) for t in read_trajectories(path, reader)]
            if other_depth(path):
                found = "depth files that do not say what their numbers are"
                cure = "say --depth-kind distance, depth or disparity (depth, of what `lightdepth export` wrote)"
                raise InputError(path, found, cure) from error
            raise InputError(
                path,
                "neither map_* folders (a densify run) nor .npz files (predictions) nor a trajectory, and no map: "
                f"{error.found}",
                error.cure,
            ) from error
        trajectory = trajectory or (path if trajectory_files(path) else None)
    return models if trajectory is None else with_trajectories(models, read_trajectories(trajectory, reader))


def is_made_by_us(path: Path) -> bool:
    """Whether a folder holds predictions or a densify run, so that metrics may be written into it."""
    return path.is_dir() and (any(path.glob("*.npz")) or bool(map_folders(path)))


def in_mm(folder: Path) -> bool:
    """Whether a densify run, or the one that a map folder is of, says that its maps are in mm."""
    return run_record(folder).get("unit") == "mm"
