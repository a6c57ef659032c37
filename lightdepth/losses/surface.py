"""Terms that say what surfaces are like, whatever the image: seen from the front, smooth, of slowly changing colour."""

from __future__ import annotations

import torch
from torch import Tensor

from lightdepth.decline import masked_blur
from lightdepth.losses.masked import mean_over_images
from lightdepth.photometry import hue_saturation_albedo

ROWS = 112
"""Image height at which the smoothness weights were measured."""


def facing_loss(normals: Tensor, rays: Tensor, mask: Tensor, floor: float) -> Tensor:
    """max(floor - cos, 0): surfaces that are seen are not edge-on."""
    return mean_over_images((floor + (normals * rays).sum(1, keepdim=True)).clamp(min=0), mask)


def smoothness_guide(log_seen: Tensor, mask: Tensor) -> Tensor:
    """Blurred log V, whose edges may be edges of the distance. (B, 1, H, W)"""
    return masked_blur(log_seen, mask, log_seen.shape[-2] * 0.009)


def smoothness_loss(log_distance: Tensor, guide: Tensor, mask: Tensor) -> Tensor:
    """Mean over both axes of |second difference of log t| · exp(-5 |difference of the guide|).

    Differences are rescaled to an image of 112 rows, so that a weight holds at every resolution: a first difference
    shrinks with the pixel's size, a second difference with its square.
    """
    rows = log_distance.shape[-2] / ROWS
    total = log_distance.new_zeros(())
    for axis in (-1, -2):
        length = log_distance.shape[axis]
        if length < 3:
            continue

        def part(values: Tensor, start: int, axis: int = axis, length: int = length) -> Tensor:
            return values.narrow(axis, start, length - 2)

        second = part(log_distance, 0) - 2 * part(log_distance, 1) + part(log_distance, 2)
        edge = (part(guide, 2) - part(guide, 0)).abs() / 2
        inside = part(mask, 0) & part(mask, 1) & part(mask, 2)
        total = total + mean_over_images(second.abs() * rows**2 * torch.exp(-5 * rows * edge), inside)
    return total / 2


def albedo_loss(albedo_hs: Tensor, mask: Tensor) -> Tensor:
    """Mean over both axes of |first difference of rho| at 112 rows' spacing: colour changes slowly."""
    albedo = hue_saturation_albedo(albedo_hs)
    total = albedo.new_zeros(())
    for axis in (-1, -2):
        total = total + steps(albedo, mask, axis)
    return total / 2


def steps(values: Tensor, mask: Tensor, axis: int) -> Tensor:
    """Mean |first difference| along an axis, between pixels both inside the mask, at 112 rows' spacing."""
    length = values.shape[axis] - 1
    if length < 1:
        return values.new_zeros(())
    step = values.narrow(axis, 1, length) - values.narrow(axis, 0, length)
    both = mask.narrow(axis, 1, length) & mask.narrow(axis, 0, length)
    return mean_over_images(step.abs(), both) * (values.shape[-2] / ROWS)
