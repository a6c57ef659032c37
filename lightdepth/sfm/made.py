"""A sparse map as a verb makes it: by pycolmap, in its run folder, with what came of it in log and record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lightdepth.calibration import write_camera
from lightdepth.counting import counted
from lightdepth.frame import Frame, readable
from lightdepth.reporting.kept import kept
from lightdepth.reporting.progress import Stages
from lightdepth.reporting.report import number
from lightdepth.reporting.run import Run, plain
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.costs import mapping_steps
from lightdepth.sfm.keeping import KeptDatabase
from lightdepth.sfm.reconstruction import SOURCES, SfmMap, sparse_map_from_frames
from lightdepth.sfm.unmapped import summary
from lightdepth.sparse_map import SparseMap, with_provenance


def made_sparse(
    run: Run,
    frames: Sequence[Frame],
    config: SfmConfig,
    poses: Mapping[int, np.ndarray] | None = None,
    files: Mapping[int, str] | None = None,
) -> SparseMap:
    """A map by pycolmap, written to sparse/ in the run folder; `poses` (4, 4) by frame number, where they are known,
    and `files`, the names of the frames' own.
    Of a camera that nobody calibrated, camera.json beside it says so."""
    run.begins(f"{counted(len(frames), 'frame')} would be mapped by pycolmap", partial(mapping_steps, frames, config))
    folder, database = run.folder / "sparse", KeptDatabase(run)
    with Stages("sparse map") as told:
        make = partial(sparse_map_from_frames, frames, folder, config, told, poses, database, files)
        found = kept(run, "sparse map", SfmMap, make, folder=folder)
    for submap in found.submaps:
        errors = number(float(np.median(submap.reprojection_errors())))
        points = counted(len(submap.points), "point")
        run.log(f"sparse map {submap.id}: {len(submap.keyframes)} keyframes, {points}, {errors} px")
    if files and any(files.get(k.number) != k.name for submap in found.submaps for k in submap.keyframes):
        run.log(f"sparse map: its images are named by number; {SOURCES} in each folder has the names of the files")
    if found.poses is not None:
        run.log(f"known poses: {found.poses}")
        run.record["known_poses"] = plain(found.poses)
    if found.failed:
        reasons = summary(list(found.failed.values()))
        run.log(f"{len(found.failed)} of {len(frames)} frames got no pose: {reasons}")
        for name, reason in found.failed.items():
            run.log(f"  {name}: {reason}")
    run.record["unregistered"] = found.failed
    camera = next(readable(frames, range(len(frames)))).camera
    if camera.provenance is None:
        return found
    write_camera(camera, run.folder / "camera.json")
    return replace(found, submaps=tuple(with_provenance(s, camera.provenance) for s in found.submaps))
