"""How training images are changed at random, the same whether one process shows a batch or several show its parts."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lightdepth.frame import FrameBatch, flipped
from lightdepth.losses import LossConfig
from lightdepth.photometry import brightness, decode, encode
from train.order import ALONE, Place

_WHITE = LossConfig().white


def augmented(batch: FrameBatch, generator: torch.Generator, place: Place = ALONE) -> FrameBatch:
    """Flips along both axes, each with probability 1/2, and linear exposure times exp(0.1 N), clipped at white.

    What was saturated stays so: how bright it was, nobody knows, and darkened it would pass for a measurement. Several
    processes draw what one would draw for the batches of all, and each takes its own.
    """
    count, device = len(batch.image), batch.image.device
    for axis in (0, 1):
        batch = flipped(batch, (drawn_for(torch.rand, count, generator, place) < 0.5).to(device), axis)
    exposure = torch.exp(0.1 * drawn_for(torch.randn, count, generator, place)).reshape(-1, 1, 1, 1).to(device)
    gamma = batch.light.gamma
    exposed = encode(exposure * decode(batch.image, gamma), gamma).clamp(max=1)
    return batch._replace(image=torch.where(brightness(batch.image) >= _WHITE, batch.image, exposed))


def drawn_for(draw: Callable[..., Tensor], count: int, generator: torch.Generator, place: Place) -> Tensor:
    """A number (count,) for each frame of this process's batch, out of those of all processes together."""
    return draw(count * place.world, generator=generator)[place.rank :: place.world]
