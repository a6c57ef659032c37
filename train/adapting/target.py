"""What is adapted to: frames of another endoscope or organ, their light, and the map that teaches and judges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from lightdepth.calibration import write_camera, write_light
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.datasets.with_map import open_with_map
from lightdepth.detective import PairingConfig, check_pairing
from lightdepth.detective.clock import by_the_images
from lightdepth.errors import InputError
from lightdepth.frame import readable
from lightdepth.light.fit_on_map import fit_assumed_light
from lightdepth.light.views import with_light
from lightdepth.losses import LossConfig
from lightdepth.models import NetworkModel
from lightdepth.photometry import PhotometricCalibration
from lightdepth.reporting.run import Run
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.made import made_sparse
from lightdepth.sparse_map import SparseMap

from ..datamodule import FrameData, FrameDataModule
from .card import source_colons
from .config import AdaptConfig
from .costs import adapting_steps, learned_from
from .exposure import check_exposed
from .judging import parted
from .map_teacher import MapTeacher
from .module import Adaptation
from .wall_judge import WallJudge


@dataclass(frozen=True, eq=False)
class Target:
    """The sequence that a network is adapted to."""

    source: SequenceSource
    """where its frames are, with the camera and the light that were found for them"""
    frames: FrameSequence
    """all of its frames"""
    training: FrameSequence
    """the frames to learn from"""
    held: FrameSequence
    """the frames at its end, which judge and are never learned from"""
    sparse_map: SparseMap | None
    """a map of it, where one was given or made"""
    unjudged: str
    """why nothing but the loss judges, where that is so; else nothing"""

    @property
    def light(self) -> PhotometricCalibration:
        return self.frames.first().light


def read_target(
    run: Run,
    source: SequenceSource,
    map: Path | None,
    fit_light: bool,
    config: AdaptConfig,
    start: NetworkModel,
    sfm: SfmConfig,
    pairing: PairingConfig = PairingConfig(),
    more: Sequence[Path] = (),
) -> Target:
    """The frames and their map, given or made. Where nobody gave a light, the map's points may tell it; what was used
    is written. A dry run ends here, when the `more` sequences are opened too."""
    unjudged = ""
    sparse_map, frames = (None, source.open()) if map is None else open_with_map(source, map, pairing)
    training, held = parted(frames, config.held_out)
    check_exposed((training, held))
    if sparse_map is not None:
        sparse_map = by_the_images(sparse_map, frames)
        check_shared_frames(sparse_map, frames)
        check_pairing(sparse_map, frames, pairing, run, frames.first().camera if source.camera is not None else None)
    run.begins(
        learned_from(training, held, sparse_map), partial(adapting_steps, source, more, training, held, config, start)
    )
    if sparse_map is not None:
        write_camera(frames.first().camera, run.folder / "camera.json")
        # The map's camera, where the folder has none: for all sequences.
        source = replace(source, camera=run.folder / "camera.json")
    else:
        sparse_map, unjudged = _made(run, frames, held, config, sfm)
    if sparse_map is not None and source.light is None and fit_light:
        fitted = fit_assumed_light(run, training, sparse_map, start)
        if fitted is not None:
            frames, training, held = (with_light(part, fitted) for part in (frames, training, held))
            source = replace(source, light=str(run.folder / "light.json"))
    write_light(frames.first().light, run.folder / "light.json")
    run.log(f"light of {source.data}: {light_text(frames.first().light)}")
    return Target(source, frames, training, held, sparse_map, unjudged)


def _made(
    run: Run, frames: FrameSequence, held: FrameSequence, config: AdaptConfig, sfm: SfmConfig
) -> tuple[SparseMap | None, str]:
    """A map made to judge or to teach, where one is needed, and why nothing judges, where that is so."""
    read = readable(held, range(len(held)))
    has_truth = any(frame.true_distance is not None and (frame.true_distance > 0).any() for frame in read)
    if has_truth and not config.taught:
        return None, ""
    if config.judge == "none":
        return None, "" if has_truth else "there is neither truth nor a map, and --judge none makes no map"
    try:
        return made_sparse(run, frames, sfm), ""
    except InputError as error:
        if config.taught:
            raise
        run.log(f"no map could be made to judge by: {error}")
        return None, "there is no truth, and no map could be made of the frames"


def light_text(light: PhotometricCalibration) -> str:
    """A light in a few words."""
    return f"gamma {light.gamma:.3g}, mu {light.mu:.3g}, reflectance {light.reflectance:.3g} ({light.source})"


def frame_data(
    run: Run, target: Target, more: Sequence[Path], config: AdaptConfig, size: tuple[int, int], start: NetworkModel
) -> FrameDataModule:
    """Frames of the target and of other sequences like it, with the colons that are replayed."""
    source = target.source
    data = FrameDataModule(
        FrameData(
            [str(path) for path in (source.data, *more)],
            format=source.format,
            camera=None if source.camera is None else str(source.camera),
            light=source.light,
            mask=None if source.mask is None else str(source.mask),
            bit_depth=source.bit_depth,
            held_out=config.held_out,
            tube=source_colons(start.card, config.replay),
            halves=config.replay > 0,
            size=size,
            batch_size=config.batch_size,
            seed=config.seed,
        )
    )
    data.setup()
    replayed = replayed_frames(data)
    colons = f"; {replayed} frames of {config.replay} synthetic colons in half of each batch" if config.replay else ""
    learned = data.counts["train"] - replayed
    run.log(f"{counted(learned, 'frame')} to learn from, {data.counts['val']} held out, {size[0]}x{size[1]}{colons}")
    return data


def replayed_frames(data: FrameDataModule) -> int:
    """How many of the frames to learn from are of replayed colons."""
    return data.tube.scenes * data.tube.frames


def adaptation(
    run: Run,
    target: Target,
    start: NetworkModel,
    loss: LossConfig,
    wall: WallJudge | None,
    by_truth: bool,
    config: AdaptConfig,
    size: tuple[int, int],
) -> Adaptation:
    """The start, as a module that goes on learning from the target; true distance or the blocks of `wall` judge."""
    weights = {"points": config.taught_by(target.sparse_map is not None), "overlap": config.overlap}
    teacher = None
    if target.sparse_map is not None and wall is not None and wall.taught:
        try:
            teacher = _teacher(run, target, target.sparse_map, wall, size, config.seed)
        except InputError as error:
            if config.taught:
                raise
            run.log(f"the map teaches nothing: {error}")
    anchor = config.held_on(0.0 if target.unjudged else weights["points"], by_truth)
    if target.unjudged:
        run.log(f"nothing but the loss can judge, {target.unjudged}: held to {start.name} by an anchor of {anchor:g}")
    return Adaptation(
        start,
        loss,
        config.learning_rate,
        size[1],
        anchor,
        config.replay > 0,
        config.what,
        config.rank,
        torch.Generator().manual_seed(config.seed),
        teacher,
        weights,
    )


def _teacher(
    run: Run, target: Target, sparse_map: SparseMap, wall: WallJudge, size: tuple[int, int], seed: int
) -> MapTeacher:
    """The map as a teacher that keeps quiet about what judges."""
    teacher = MapTeacher(target.training, sparse_map, size, target.held.numbers, seed, wall.hidden())
    known = sum(len(k.distances) for k in teacher.keyframes)
    paired = sum(bool(k.partners) for k in teacher.keyframes)
    run.log(f"the map teaches: {len(teacher.keyframes)} keyframes, {known} observed points, {paired} with partners")
    return teacher
