"""A synthetic sequence and its simulated SLAM export as folders on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lightdepth.datasets import write_c3vd, write_endomapper, write_folder
from lightdepth.datasets.c3vd_surface import COVERAGE_MESH, write_coverage_mesh, write_seen_surface
from lightdepth.frame import Frame
from lightdepth.maps import write_multimap
from lightdepth.reporting.run import plain
from lightdepth.tube.seen_surface import SurfaceSeen
from lightdepth.tube.shape import TubeShape
from lightdepth.tube.slam import SimulatedSlam


def write_synthetic(
    frames: Sequence[Frame],
    export: SimulatedSlam,
    folder: Path,
    layout: str = "frames",
    moved: Mapping[int, np.ndarray] | None = None,
    wall: TubeShape | None = None,
) -> None:
    """The sequence (with truth) at `folder`, the SLAM export in slam/, what only the simulation knows in
    truth/slam.json, among it the ids of points `moved` by errors that come together, by submap id. A c3vd tree has the
    truth of the `wall` too, where that is given (it is at rest)."""
    if layout == "c3vd":
        write_c3vd(frames, folder / "sequence")
        if wall is not None:
            _write_wall(frames, wall, folder / "sequence")
    elif layout == "endomapper":
        write_endomapper(frames, folder / "sequence")
        write_folder(frames, folder / "truth" / "sequence")
    else:
        write_folder(frames, folder)
    write_multimap(export.map, folder / "slam")
    known = {
        str(i): {
            "map_from_world": {"scale": s, "rotation": r.tolist(), "translation": t.tolist()},
            "spurious_point_ids": export.spurious_ids[i].tolist(),
            **({} if moved is None else {"moved_point_ids": moved[i].tolist()}),
        }
        for i, (s, r, t) in export.map_from_world.items()
    }
    (folder / "truth").mkdir(exist_ok=True)
    (folder / "truth" / "slam.json").write_text(json.dumps(plain(known)) + "\n", encoding="utf-8")


def _write_wall(frames: Sequence[Frame], wall: TubeShape, folder: Path) -> None:
    """What C3VD knows of the wall: normals, flow and occlusion of each frame, and the mesh with what was seen."""
    seen = SurfaceSeen(wall)
    for before, frame in zip([None, *frames[:-1]], frames, strict=True):
        write_seen_surface(seen.of(frame, before), folder, f"{frame.number:04d}")
    write_coverage_mesh(folder / COVERAGE_MESH, seen.vertices, seen.faces, seen.seen)
