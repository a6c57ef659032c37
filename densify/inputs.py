"""What a verb works on: the frames, their sparse map or one made of them, and the light that the map tells."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from densify.pipeline import fitted_to_frames
from densify.sfm import SfmConfig, sparse_map_from_frames
from densify.unmapped import summary
from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.light_fit import fit_assumed_light, with_light
from lightdepth.maps import read_map
from lightdepth.maps.checks import check_shared_frames
from lightdepth.predict import DepthModel
from lightdepth.report import number
from lightdepth.run import Run
from lightdepth.sparse_map import SparseMap


def map_and_frames(
    run: Run,
    data: Path,
    map: Path | None,
    format: str | None,
    camera: Path | None,
    light: str | None,
    mask: Path | None,
    sfm: SfmConfig,
) -> tuple[SparseMap, FrameSequence]:
    """The map at `map`, or one made of the frames, and the frames, under the map's camera where they have none. A map
    made at another image size is rescaled to theirs. Raises InputError where no frame is of the map."""
    if map is None:
        frames = open_sequence(data, format, camera, light, mask)
        return made_sparse(run, frames, sfm), frames
    sparse_map = read_map(map)
    map_camera = sparse_map.submaps[0].keyframes[0].camera
    frames = open_sequence(data, format, camera, light, mask, map_camera)
    check_shared_frames(sparse_map, frames)
    width, height = frames.image_size()
    given = frames[0].camera if camera is not None else None
    if (map_camera.width, map_camera.height) != (width, height):
        run.log(f"map made at {map_camera.width}x{map_camera.height}, rescaled to the frames' {width}x{height}")
    return fitted_to_frames(sparse_map, width, height, given), frames


def made_sparse(
    run: Run, frames: FrameSequence, config: SfmConfig, poses: Mapping[int, np.ndarray] | None = None
) -> SparseMap:
    """A map by pycolmap, written to sparse/ in the run folder; `poses` (4, 4) by frame number, where they are known."""
    stages: list[str] = []

    def show(stage: str, done: int, count: int) -> None:
        if stage not in stages:
            stages.append(stage)
            run.log(f"sparse map: {stage}")

    found = sparse_map_from_frames(frames, run.folder / "sparse", config, show, poses)
    for submap in found.submaps:
        errors = number(float(np.median(submap.reprojection_errors())))
        run.log(f"sparse map {submap.id}: {len(submap.keyframes)} keyframes, {len(submap.points)} points, {errors} px")
    if found.failed:
        reasons = summary(list(found.failed.values()))
        run.log(f"{len(found.failed)} of {len(frames)} frames found no place: {reasons}")
        for name, reason in found.failed.items():
            run.log(f"  {name}: {reason}")
    run.record["unregistered"] = found.failed
    return found


def fitted_light(run: Run, frames: FrameSequence, sparse_map: SparseMap, model: DepthModel) -> FrameSequence:
    """The frames under the light that the map tells, where theirs is only assumed and the model does better with it."""
    light = fit_assumed_light(run, frames, sparse_map, model)
    return frames if light is None else with_light(frames, light)
