"""Depth errors. The alignment is part of every metric's name.

p prediction, q truth, both depth along the axis [mm], over the stated mask of one frame:
AbsRel mean(|p - q| / q), RMSE sqrt(mean (p - q)²), MedAE median |p - q|, delta1 share with max(p/q, q/p) < 1.25.
Means are over frames.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torchmetrics import Metric

from lightdepth.decline import informative
from lightdepth.frame import FrameBatch, flipped
from lightdepth.losses import masked_mean, masked_median
from lightdepth.photometry import brightness, decode, encode

NAMES = ("abs_rel", "rmse_mm", "medae_mm", "delta1")


def aligned(predicted: Tensor, truth: Tensor, alignment: str) -> Tensor:
    """Predictions (n,) brought to the scale of the truth (n,): "none", or "median" = median of the ratios."""
    if alignment == "none":
        return predicted
    if alignment == "median":
        return predicted * (truth / predicted.clamp(min=1e-12)).median()
    raise ValueError(f"alignment {alignment!r}; expected 'none' or 'median'")


def depth_errors(
    predicted: Tensor, truth: Tensor, valid: Tensor, alignment: str = "median"
) -> dict[str, Tensor] | None:
    """The errors of one frame, or None when no pixel is valid. All three (H, W); valid bool."""
    valid = valid & (truth > 0) & torch.isfinite(truth) & torch.isfinite(predicted) & (predicted > 0)
    if not valid.any():
        return None
    q = truth[valid].double()
    p = aligned(predicted[valid].double(), q, alignment)
    error = (p - q).abs()
    values = (
        (error / q).mean(),
        error.square().mean().sqrt(),
        error.median(),
        (torch.maximum(p / q, q / p) < 1.25).double().mean(),
    )
    return dict(zip(NAMES, values, strict=True))


class DepthErrors(Metric):
    """Mean over frames of `depth_errors`, as a torchmetrics Metric; NaN over none.

    Update with (B, 1, H, W) depth, truth and validity.
    """

    full_state_update = False
    total: Tensor
    frames: Tensor

    def __init__(self, alignment: str = "median") -> None:
        super().__init__()
        self.alignment = alignment
        self.add_state("total", torch.zeros(len(NAMES), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("frames", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, predicted: Tensor, truth: Tensor, valid: Tensor) -> None:
        for p, q, v in zip(predicted, truth, valid, strict=True):
            errors = depth_errors(p[0], q[0], v[0], self.alignment)
            if errors is not None:
                self.total += torch.stack([errors[name] for name in NAMES])
                self.frames += 1

    def compute(self) -> dict[str, Tensor]:
        mean = self.total / self.frames
        return {f"{name}_{self.alignment}": value for name, value in zip(NAMES, mean, strict=True)}


_EXPOSURE = 0.8


@torch.no_grad()
def inconsistency(model: Callable[[FrameBatch], tuple[Tensor, Tensor]], batch: FrameBatch, distance: Tensor) -> Tensor:
    """Mean |difference of log t| between `distance` and that of the mirrored, darker batch, free of scale.

    Needs no truth. A model whose answer hangs on exposure or on left and right cannot be right about both.
    """
    gamma = batch.light.gamma
    darker = batch._replace(image=encode(_EXPOSURE * decode(batch.image, gamma), gamma))
    everyone = torch.ones(len(batch.image), dtype=torch.bool, device=batch.image.device)
    mirrored = model(flipped(darker, everyone, axis=0))[0].flip(-1)
    difference = mirrored.log() - distance.log()
    usable = informative(darker.image, batch.mask) & (brightness(batch.image) < 1)
    return masked_mean((difference - masked_median(difference, usable)).abs(), usable)
