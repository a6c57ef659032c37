"""What a verb works on: the frames, their sparse map or one made of them, and the light that the map tells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.errors import InputError
from lightdepth.frame import check_image_size
from lightdepth.light.fit_on_map import fit_assumed_light, with_light
from lightdepth.maps import read_map
from lightdepth.models import ConstantModel, DepthModel
from lightdepth.reporting.run import Run
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.made import made_sparse
from lightdepth.sparse_map import Keyframe, SparseMap


def map_and_frames(
    run: Run, source: SequenceSource, map: Path | None, sfm: SfmConfig
) -> tuple[SparseMap, FrameSequence]:
    """The map at `map`, or one made of the frames, and the frames, under the map's camera where they have none. A map
    made at another image size is rescaled to theirs. Raises InputError where no frame is of the map."""
    if map is None:
        frames = source.open()
        return made_sparse(run, frames, sfm), frames
    sparse_map = read_map(map)
    map_camera = sparse_map.submaps[0].keyframes[0].camera
    frames = source.open(map_camera)
    check_shared_frames(sparse_map, frames)
    width, height = frames.image_size()
    given = frames[0].camera if source.camera is not None else None
    if (map_camera.width, map_camera.height) != (width, height):
        run.log(f"map made at {map_camera.width}x{map_camera.height}, rescaled to the frames' {width}x{height}")
    return fitted_to_frames(sparse_map, width, height, given), frames


def check_unit(mm_per_unit: float | None) -> None:
    """Raises InputError for millimetres per map unit that cannot be."""
    if mm_per_unit is not None and not mm_per_unit > 0:
        raise InputError("--mm-per-unit", f"{mm_per_unit}", "expected a positive number of millimetres")


def fitted_light(
    run: Run, source: SequenceSource, frames: FrameSequence, sparse_map: SparseMap, model: DepthModel, wanted: bool
) -> FrameSequence:
    """The frames under the light that the map tells, where theirs is only assumed and the model does better with it.

    They stay as they are where no fit is wanted, where the user gave a light, and for the constant model, which looks
    at none."""
    if not wanted or source.light is not None or isinstance(model, ConstantModel):
        return frames
    light = fit_assumed_light(run, frames, sparse_map, model)
    return frames if light is None else with_light(frames, light)


def fitted_to_frames(sparse_map: SparseMap, width: int, height: int, camera: CameraModel | None = None) -> SparseMap:
    """The map with cameras and keypoints at the size of the frames, which a SLAM often halves; `camera` replaces the
    map's own. Raises InputError when sizes differ by more than a rescaling."""

    def fitted(keyframe: Keyframe) -> Keyframe:
        own = keyframe.camera
        sx, sy = width / own.width, height / own.height
        if abs(sx / sy - 1) > 0.01:
            check_image_size(f"{sparse_map.source}: keyframe {keyframe.name}", width, height, own)
        resized = own if (sx, sy) == (1, 1) else own.resized(width, height)
        return replace(keyframe, camera=camera or resized, pixels=keyframe.pixels * (sx, sy))

    submaps = (replace(s, keyframes=tuple(map(fitted, s.keyframes))) for s in sparse_map.submaps)
    return replace(sparse_map, submaps=tuple(submaps))
