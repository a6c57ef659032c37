"""Depth errors. The alignment is part of every metric's name.

p prediction, q truth, both depth along the axis [mm], over the stated mask of one frame, n pixels:

    abs_rel   mean |p - q| / q          rmse_mm   sqrt(mean (p - q)²)        mae_mm    mean |p - q|
    sq_rel_mm mean (p - q)² / q         rmse_log  sqrt(mean (ln p - ln q)²)  medae_mm  median |p - q|
    delta1, delta2, delta3              share with max(p/q, q/p) < 1.25, 1.25², 1.25³

Means are over frames, or over sequences (the mean of each sequence's mean). Medians are the lower one of two.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torchmetrics import Metric

from lightdepth.decline import informative
from lightdepth.frame import FrameBatch, flipped
from lightdepth.losses import masked_median, mean_over_images
from lightdepth.photometry import brightness, decode, encode
from lightdepth.robust import lmeds_scale

NAMES = ("abs_rel", "sq_rel_mm", "rmse_mm", "mae_mm", "medae_mm", "rmse_log", "delta1", "delta2", "delta3")
ALIGNMENTS = {
    "none": "as predicted",
    "median": "times the median of q / p",
    "lmeds": "times the scale with the least median of |q - s p| (over at most 50 000 evenly spaced pixels)",
    "scale_shift": "s p + t by least squares, s at least 0; no nearer than 0.001 mm",
}
"""What is done to the predictions of a frame before they are compared, by name."""
_LMEDS_PIXELS = 50_000  # its time grows faster than their number; more would change the scale by less than its noise
_NEAREST_MM = 1e-3  # a shift can put depth behind the camera, where there is no logarithm


def aligned(predicted: Tensor, truth: Tensor, alignment: str) -> Tensor:
    """Predictions (n,) brought to the scale of the truth (n,), both positive float64, n at least 1; see ALIGNMENTS.

    One pixel is its own scale: from fewer than two, lmeds and scale_shift are what median is.
    """
    if alignment == "none":
        return predicted
    if alignment not in ALIGNMENTS:
        raise ValueError(f"alignment {alignment!r}; expected one of {', '.join(ALIGNMENTS)}")
    if alignment == "median" or len(predicted) < 2:
        return predicted * (truth / predicted.clamp(min=1e-12)).median()
    if alignment == "lmeds":
        step = -(-len(predicted) // _LMEDS_PIXELS)
        return predicted * lmeds_scale(truth[::step].cpu().numpy(), predicted[::step].cpu().numpy()).scale
    p, q = predicted - predicted.mean(), truth - truth.mean()
    scale = ((p * q).sum() / p.square().sum().clamp(min=1e-300)).clamp(min=0)
    return (scale * p + truth.mean()).clamp(min=_NEAREST_MM)


def depth_errors(
    predicted: Tensor, truth: Tensor, valid: Tensor, alignment: str = "median"
) -> dict[str, Tensor] | None:
    """The errors of one frame, or None when no pixel is valid. All three (H, W); valid bool."""
    p, q = compared(predicted, truth, valid)
    if not len(q):
        return None
    p = aligned(p, q, alignment)
    error = (p - q).abs()
    ratio = torch.maximum(p / q, q / p)
    values = (
        (error / q).mean(),
        (error.square() / q).mean(),
        error.square().mean().sqrt(),
        error.mean(),
        error.median(),
        (p / q).log().square().mean().sqrt(),
        *((ratio < 1.25**power).double().mean() for power in (1, 2, 3)),
    )
    return dict(zip(NAMES, values, strict=True))


def compared(predicted: Tensor, truth: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Prediction and truth (n,) float64 at the valid pixels (H, W) where both are positive and finite."""
    for depth in (predicted, truth):
        valid = valid & torch.isfinite(depth) & (depth > 0)
    return predicted[valid].double(), truth[valid].double()


class DepthErrors(Metric):
    """Mean over frames of `depth_errors`, as a torchmetrics Metric; NaN over none.

    Update with (B, 1, H, W) depth, truth and validity. Where `sequences` says how many there are, update with the index
    of each frame's sequence (B,) too, and `NAME_ALIGNMENT_over_sequences` are the means over the sequences seen.
    """

    full_state_update = False
    total: Tensor
    frames: Tensor

    def __init__(self, alignment: str = "median", sequences: int = 1) -> None:
        super().__init__()
        self.alignment = alignment
        self.add_state("total", torch.zeros(sequences, len(NAMES), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("frames", torch.zeros(sequences, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, predicted: Tensor, truth: Tensor, valid: Tensor, sequence: Tensor | None = None) -> None:
        rows = [0] * len(predicted) if sequence is None else sequence.tolist()
        for p, q, v, row in zip(predicted, truth, valid, rows, strict=True):
            errors = depth_errors(p[0], q[0], v[0], self.alignment)
            if errors is not None:
                self.total[row] += torch.stack([errors[name] for name in NAMES])
                self.frames[row] += 1

    def compute(self) -> dict[str, Tensor]:
        mean = self.total.sum(0) / self.frames.sum()
        found = {f"{name}_{self.alignment}": value for name, value in zip(NAMES, mean, strict=True)}
        if len(self.frames) > 1:
            seen = self.frames > 0
            mean = (self.total[seen] / self.frames[seen, None]).mean(0)
            found |= {f"{name}_{self.alignment}_over_sequences": v for name, v in zip(NAMES, mean, strict=True)}
        return found


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
    return mean_over_images((difference - masked_median(difference, usable)).abs(), usable)
