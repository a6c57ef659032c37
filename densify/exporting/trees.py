"""Dense maps as trajectories alone, and as the tree that CLiMB's evaluation reads."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from densify.exporting.exported import Exportable
from lightdepth.files.tum import write_tum
from lightdepth.frame import frame_number
from lightdepth.maps import write_multimap
from lightdepth.maps.convention import SIDECAR
from lightdepth.sparse_map import Keyframe, SparseMap, Submap

RUNTIME = "runtime.txt"


def write_trajectory(exported: Exportable, path: Path, times: Mapping[int, float]) -> None:
    """TUM: `t tx ty tz qx qy qz qw` of each keyframe, camera to map; t in seconds where `times` has it of every frame,
    else the frame's number."""
    numbers = [k.number for k in exported.submap.keyframes]
    known = all(n in times for n in numbers)
    poses = [np.linalg.inv(k.cam_from_map) for k in exported.submap.keyframes]
    write_tum(path, [times[n] if known else float(n) for n in numbers], poses)


def write_climb(
    maps: Sequence[Exportable],
    folder: Path,
    times: Mapping[int, float],
    offset: int,
    points: int,
    seconds: tuple[float, float],
) -> None:
    """3D_maps/<id>, camera_trajectory/ and runtime.txt; `folder` is there.

    CLiMB counts frames from 1: `offset` is added to our numbers. All frames that the SLAM localised are in it, where
    its tree has them, else the keyframes. points3D.txt has the map's points and, of the surface, at most so many
    `points`. `seconds` are those of the start and of the work. A sidecar tells our own reader the offset.
    """

    def counted(keyframe: Keyframe) -> Keyframe:
        return replace(keyframe, name=f"{keyframe.number + offset:06d}.png")

    submaps, trajectories = [], {}
    named = {f"{number + offset:06d}.png": time for number, time in times.items()}
    for exported in maps:
        own, rows = exported.submap, exported.thinned(points)
        first = int(own.point_ids.max()) + 1
        ids = np.concatenate([own.point_ids, np.arange(first, first + len(rows))])
        keyframes = tuple(counted(k) for k in own.keyframes)
        submaps.append(Submap(own.id, keyframes, ids, np.concatenate([own.points, exported.dense.vertices[rows]])))
        frames = {f"{frame_number(p.name) + offset:06d}.png": p for p in exported.localised}
        trajectories[own.id] = {name: pose.cam_from_map for name, pose in frames.items()}
        named = {name: pose.time for name, pose in frames.items()} | named
    write_multimap(SparseMap(tuple(submaps), "dense maps"), folder, trajectories, named)
    text = f"init_seconds={seconds[0]:.3f}\nprocessing_seconds={seconds[1]:.3f}\n"
    (folder / RUNTIME).write_text(text, encoding="utf-8")
    if offset:
        (folder / SIDECAR).write_text(json.dumps({"frame_offset": -offset}) + "\n", encoding="utf-8")
