"""Synthetic colons to train on: what they are drawn from, their seeds, and their frames as batches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import torch

from lightdepth.frame import FrameBatch, to_batch
from lightdepth.ranges import BELOW_ONE, COUNT, Range, at_least, checked, ends_of
from lightdepth.tube.path import Lens
from lightdepth.tube.scene import TubeConfig

Family = Literal["plain", "realistic", "mixed", "wide"]


@dataclass(frozen=True)
@checked
class TubeData:
    """Synthetic colons for training, drawn from the data's seed; validation scenes are others."""

    scenes: Annotated[int, at_least(0, up_to=1_000_000)] = 0
    """Number of synthetic colons to train on, each with its own shape, texture and endoscope; 0 for none. More show the
    network more variety, and take longer to render."""
    val_scenes: Annotated[int, at_least(0, up_to=1_000_000)] = 0
    """Number of synthetic colons to validate on, others than those to train on; 0 for none. More judge more surely and
    take longer."""
    frames: Annotated[int, COUNT] = 8
    """Number of frames rendered of each colon, to train and to validate on. More show more of each colon and take
    longer to render."""
    travel: Annotated[float, at_least(0, up_to=10_000)] = 60.0
    """Length of the endoscope's way through each colon, mm, over which its frames are spread evenly. A longer one makes
    neighbouring frames less alike."""
    lenses: tuple[Lens, ...] = ("c3vd", "fisheye", "pinhole")
    """Lenses that the colons get in turn, a list: pinhole (90 degrees wide, no distortion), telescope (70 degrees, no
    distortion), fisheye (136 degrees), c3vd (that of the data set C3VD). Each lens that is left out is one that the
    network never sees."""
    mu: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (0.0, 3.5)
    """Range [low, high] from which each colon's exponent mu is drawn: light falls off by exp(-mu (1 - cos a)) at the
    angle a from its axis, and at 0 not at all. A larger one makes a narrower light, with darker borders of the
    image."""
    gamma: Annotated[tuple[float, float], ends_of(Range(0.1, 10))] = (1.8, 2.6)
    """Range [low, high] from which each colon's exponent gamma is drawn: the camera writes the light v as v^(1/gamma),
    and 1 is linear. A larger one brightens dark parts more."""
    reflectance: Annotated[tuple[float, float], ends_of(BELOW_ONE)] = (0.0, 0.7)
    """Range [low, high] from which each colon's reflectance is drawn, the share of light, in [0, 1), that its wall
    reflects onto other wall. A larger one makes more indirect light."""
    family: Family = "plain"
    """Kind of colons: plain, tubes with folds under the endoscope's light; realistic, with polyps, mucus, motion blur
    and whatever else real images have; mixed, as realistic, but one scene of five is a hollow, a cavity of any shape,
    instead, and each has a round or eight-sided field of view of its own; wide, as mixed, over wider ranges of shape,
    paint and exposure, with the light between walls computed in a way that changes from colon to colon."""
    val_family: Family | Literal["variant"] | None = None
    """Kind of colons to validate on, and to scale the uncertainty by: one of the families, or variant, which is made in
    another way than all of them. Left out, the kind that is trained on."""
    scene: TubeConfig | None = None
    """Ranges that the colons are drawn from, in place of those of the family: a mapping in a --config file, or
    --data.tube.scene.shape.length 150 and the like, named as below --scene in `lightdepth synth --help-all`. mu, gamma
    and reflectance above hold all the same. Left out, the family's."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where colons are rendered: cpu; cuda, the GPU, which needs the extra gpu; auto, the GPU where there are both,
    else the CPU. It changes the time, not the colons (up to rounding)."""


_MAX_REFLECTANCE = 0.95


_VAL_SEEDS = 1_000_000  # validation colons are drawn from here on, so that more scenes never run into them


_SEEDS_APART = 10_000


_FIELD = 17  # tells the draw of the field of view from the colon's own


_HOLLOWS = (2,)  # of five; lenses, in turn, meet both families


_MIXED = ("mixed", "wide")


_STRENGTHS: tuple[Literal["weak", "strong"], ...] = ("weak", "strong")


def colon_seeds(tube: TubeData, seed: int) -> tuple[range, range]:
    """The colons that data of a seed train and validate on."""
    first = seed * _SEEDS_APART
    return range(first, first + tube.scenes), range(first + _VAL_SEEDS, first + _VAL_SEEDS + tube.val_scenes)


SceneMaker = Callable[[TubeData, int, int, tuple[int, int]], list[FrameBatch]]
"""The frames of one colon as batches of one, from a seed, the colon's place in the run, and width and height."""


def with_reflectance(batch: FrameBatch, reflectance: torch.Tensor) -> FrameBatch:
    """The batch with another reflectance (B, 1, 1, 1) of the wall, kept where light from wall to wall converges."""
    return batch._replace(light=batch.light._replace(reflectance=reflectance.clamp(0, _MAX_REFLECTANCE)))


def tube_scene(tube: TubeData, seed: int, index: int, size: tuple[int, int]) -> list[FrameBatch]:
    """The frames of one synthetic colon, as batches of one."""
    from lightdepth.tube import any_field, lens, tube_frames

    camera, config = lens(tube.lenses[index % len(tube.lenses)], *size), tube_config(tube, index)
    mask = any_field(camera, np.random.default_rng([seed, _FIELD])) if tube.family in _MIXED else None
    frames = tube_frames(seed, tube.frames, camera, tube.travel, config, mask=mask, device=tube.device)
    return [to_batch(frame, size) for frame in frames]


def val_scene(tube: TubeData, seed: int, index: int, size: tuple[int, int]) -> list[FrameBatch]:
    """The frames of one synthetic colon to validate on."""
    if tube.val_family == "variant":
        from lightdepth.tube import lens
        from lightdepth.tube.variant import variant_frames

        camera, strength = lens(tube.lenses[index % len(tube.lenses)], *size), _STRENGTHS[index % 2]
        frames = variant_frames(seed, tube.frames, camera, strength, tube.travel)
        return [to_batch(frame, size) for frame in frames]
    return tube_scene(replace(tube, family=tube.val_family or tube.family), seed, index, size)


def tube_config(tube: TubeData, index: int = 0) -> TubeConfig:
    """What the index-th colon and its endoscope are drawn from."""
    from lightdepth.tube import cavity, realistic, wide_colon, wide_hollow

    colon, hollow = {
        "plain": (TubeConfig, TubeConfig),
        "realistic": (realistic, realistic),
        "mixed": (realistic, cavity),
        "wide": (wide_colon, wide_hollow),
    }[tube.family]
    config = tube.scene or (hollow if index % 5 in _HOLLOWS else colon)()
    return replace(config, sensor=replace(config.sensor, mu=tube.mu, gamma=tube.gamma, reflectance=tube.reflectance))
