"""Synthetic colons to train on: what they are drawn from, their seeds, and their frames as batches."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from lightdepth.frame import FrameBatch, to_batch
from lightdepth.tube.path import Lens
from lightdepth.tube.scene import TubeConfig


@dataclass(frozen=True)
class TubeData:
    """Synthetic colons for training, drawn from the data's seed; validation scenes are others."""

    scenes: int = 0
    """Number of colons to train on, each with its own shape, texture and endoscope; 0 for none. More make a network
    that knows more, and take longer to render."""
    val_scenes: int = 0
    """Number of colons to validate on, others than those of the training. More judge more surely and take longer."""
    frames: int = 8
    """Number of frames of each colon. More take longer to render."""
    travel: float = 60.0
    """Length of colon over which the frames are spread, mm. A longer one makes neighbouring frames less alike."""
    lenses: tuple[Lens, ...] = ("c3vd", "fisheye", "pinhole")
    """Lenses that the colons have in turn: c3vd, fisheye, pinhole or telescope."""
    mu: tuple[float, float] = (0.0, 3.5)
    """Ends of the range of the exponent mu of the light's spread. A larger one makes a narrower light."""
    gamma: tuple[float, float] = (1.8, 2.6)
    """Ends of the range of the exponent gamma of the camera's response. A larger one brightens dark parts more."""
    reflectance: tuple[float, float] = (0.0, 0.7)
    """Ends of the range of the share of light that the wall throws back on other wall. A larger one makes more
    indirect light."""
    family: Literal["plain", "realistic", "mixed"] = "plain"
    """Kind of colons: plain; realistic, with polyps, mucus, motion blur and all else (lightdepth.tube.realistic); or
    mixed, where one scene of five is no colon but a hollow looked at from anywhere (lightdepth.tube.cavity), and
    every scene has a field of view of its own."""
    scene: TubeConfig | None = None
    """Ranges of one's own instead of the family's; mu, gamma and reflectance above hold in any case."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where colons are rendered: cpu, cuda, or auto, the GPU where there is one and the extra gpu is installed. The
    colons are the same on any, up to rounding."""


_MAX_REFLECTANCE = 0.95


_VAL_SEEDS = 1_000_000  # validation colons are drawn from here on, so that more scenes never run into them


_SEEDS_APART = 10_000


_FIELD = 17  # tells the draw of the field of view from the colon's own


_HOLLOWS = (2,)  # of five; lenses, in turn, meet both families


def colon_seeds(tube: TubeData, seed: int) -> tuple[range, range]:
    """The colons that data of a seed train and validate on."""
    first = seed * _SEEDS_APART
    return range(first, first + tube.scenes), range(first + _VAL_SEEDS, first + _VAL_SEEDS + tube.val_scenes)


def with_reflectance(batch: FrameBatch, reflectance: torch.Tensor) -> FrameBatch:
    """The batch with another reflectance (B, 1, 1, 1) of the wall, kept where light from wall to wall converges."""
    return batch._replace(light=batch.light._replace(reflectance=reflectance.clamp(0, _MAX_REFLECTANCE)))


def tube_scene(tube: TubeData, seed: int, index: int, size: tuple[int, int]) -> list[FrameBatch]:
    """The frames of one synthetic colon, as batches of one."""
    from lightdepth.tube import any_field, lens, tube_frames

    camera, config = lens(tube.lenses[index % len(tube.lenses)], *size), tube_config(tube, index)
    mask = any_field(camera, np.random.default_rng([seed, _FIELD])) if tube.family == "mixed" else None
    frames = tube_frames(seed, tube.frames, camera, tube.travel, config, mask=mask, device=tube.device)
    return [to_batch(frame, size) for frame in frames]


def tube_config(tube: TubeData, index: int = 0) -> TubeConfig:
    """What the index-th colon and its endoscope are drawn from."""
    from lightdepth.tube import cavity, realistic

    family = TubeConfig()
    if tube.family != "plain":
        family = cavity() if tube.family == "mixed" and index % 5 in _HOLLOWS else realistic()
    config = tube.scene or family
    return replace(config, sensor=replace(config.sensor, mu=tube.mu, gamma=tube.gamma, reflectance=tube.reflectance))
