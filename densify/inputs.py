"""What a verb works on: the frames, their sparse map or one made of them, and the light that the map tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from densify.config import MethodConfig
from densify.placing import Placing
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.detective import PairingConfig, check_pairing
from lightdepth.errors import InputError
from lightdepth.frame import Frame, check_image_size
from lightdepth.light.fit_on_map import fit_assumed_light
from lightdepth.light.views import with_light
from lightdepth.maps import read_map
from lightdepth.models import ConstantModel, DepthModel
from lightdepth.reporting.run import Run, plain
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.made import made_sparse
from lightdepth.sfm.repair import repaired_submap
from lightdepth.sparse_map import Keyframe, SparseMap
from lightdepth.uncalibrated import open_frames


@dataclass(frozen=True)
class MapSource(PairingConfig):
    """A sparse map, and what is asked of it."""

    map: Path | None = None
    """Sparse map of the frames (poses and points of a SLAM): COLMAP model(s) or a multi-map tree; left out, pycolmap
    makes one from the frames."""
    repair_map: bool = False
    """Make the map anew before it is used, by matching the images of its keyframes, beginning at its poses and keeping
    its frame and scale; written to sparse/ in the run folder. Switched off, it is used as it is."""


def map_and_frames(
    run: Run, source: SequenceSource, mapped: MapSource, sfm: SfmConfig
) -> tuple[SparseMap, FrameSequence]:
    """The map that was given, or one made of the frames, and the frames, under the map's camera where they have none.
    A map made at another image size is rescaled to theirs. Raises InputError where no frame is of the map, or where
    the images say that they are not its."""
    if mapped.map is None:
        frames = open_frames(source, run, None, sfm).without_truth()
        return made_sparse(run, frames, sfm), frames
    sparse_map = read_map(mapped.map)
    map_camera = sparse_map.submaps[0].keyframes[0].camera
    frames = open_frames(source, run, map_camera).without_truth()
    check_shared_frames(sparse_map, frames)
    width, height = frames.image_size()
    given = frames[0].camera if source.camera is not None else None
    if (map_camera.width, map_camera.height) != (width, height):
        run.log(f"map made at {map_camera.width}x{map_camera.height}, rescaled to the frames' {width}x{height}")
    fitted = fitted_to_frames(sparse_map, width, height, given)  # first: a cropped image is refused by its size
    check_pairing(sparse_map, frames, mapped, run, given)
    return (repaired(run, fitted, frames, sfm) if mapped.repair_map else fitted), frames


def repaired(run: Run, sparse_map: SparseMap, frames: FrameSequence, config: SfmConfig) -> SparseMap:
    """The map made anew from the images of its keyframes, submap by submap, written to sparse/ in the run folder."""
    submaps, told = [], []
    for submap in sparse_map.submaps:
        seen = [k for k in submap.keyframes if k.number in frames.numbers]
        images = FrameSequence([k.name for k in seen], _ImagesOf(frames, seen), frames.source) if seen else []
        run.log(f"repair of map {submap.id}: {len(seen)} keyframes are matched")
        new, repair = repaired_submap(submap, images, run.folder / "sparse" / str(submap.id), config)
        worse = repair.left or len(new.keyframes) < len(seen)
        (run.warn if worse else run.log)(f"repair: {repair}")
        submaps.append(new)
        told.append(repair)
    run.record["repair"] = plain(told)
    return replace(sparse_map, submaps=tuple(submaps))


@dataclass(frozen=True)
class _ImagesOf:
    """Loads the images of keyframes, under the map's camera."""

    frames: FrameSequence
    keyframes: Sequence[Keyframe]

    def __call__(self, i: int) -> Frame:
        return self.frames.of_keyframe(self.keyframes[i])


def check_unit(mm_per_unit: float | None) -> None:
    """Raises InputError for millimetres per map unit that cannot be."""
    if mm_per_unit is not None and not mm_per_unit > 0:
        raise InputError("--mm-per-unit", f"{mm_per_unit}", "expected a positive number of millimetres")


def fitted_light(
    run: Run, frames: FrameSequence, sparse_map: SparseMap, model: DepthModel, config: MethodConfig, wanted: bool
) -> FrameSequence:
    """The frames under the light that the map tells, where nobody gave theirs and what the model delivers with it, by
    these settings, is better.

    They stay as they are where no fit is wanted, and for the constant model, which looks at no light."""
    if not wanted or isinstance(model, ConstantModel):
        return frames
    light = fit_assumed_light(run, frames, sparse_map, model, Placing(config))
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
