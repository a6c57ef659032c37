"""Means and medians inside a mask, image by image."""

from __future__ import annotations

import torch
from torch import Tensor


def mean_over_images(values: Tensor, mask: Tensor) -> Tensor:
    """One number: the mean over images of the mean inside each one's mask. Values outside it may be anything, NaN
    included; an image with an empty mask counts as 0."""
    kept = torch.where(mask, values, torch.zeros_like(values))
    return (kept.sum((1, 2, 3)) / mask.expand_as(values).sum((1, 2, 3)).clamp(min=1)).mean()


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """Lower median inside the mask of each image, (B, 1, 1, 1); 0 where the mask is empty."""
    ordered = torch.where(mask, values, torch.full_like(values, torch.inf)).flatten(1).sort(1).values
    count = mask.flatten(1).sum(1, keepdim=True)
    median = ordered.gather(1, ((count - 1) // 2).clamp(min=0))
    return torch.where(count > 0, median, torch.zeros_like(median)).reshape(-1, 1, 1, 1)


def masked_std(values: Tensor, mask: Tensor) -> Tensor:
    """Standard deviation inside the mask of each image, (B, 1, 1, 1); 0 where the mask is empty."""
    count = mask.sum((1, 2, 3), keepdim=True).clamp(min=1)
    kept = torch.where(mask, values, torch.zeros_like(values))
    mean = kept.sum((1, 2, 3), keepdim=True) / count
    return (torch.where(mask, values - mean, 0.0).square().sum((1, 2, 3), keepdim=True) / count).sqrt()
