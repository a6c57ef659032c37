"""Terms that compare with true distance. Every one is free of scale."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lightdepth.losses.masked import masked_median, mean_over_images
from lightdepth.losses.surface import steps


def supervised_loss(distance: Tensor, true_distance: Tensor, true_valid: Tensor) -> dict[str, Tensor]:
    """With e = log t - log t_true: 3 |e - mean e|, and 3 |differences of e| at 112 rows' spacing."""
    error = distance.clamp(min=1e-6).log() - true_distance.clamp(min=1e-6).log()
    error = torch.where(true_valid, error, torch.zeros_like(error))
    mean = error.sum((1, 2, 3), keepdim=True) / true_valid.sum((1, 2, 3), keepdim=True).clamp(min=1)
    gradient = steps(error, true_valid, -1) + steps(error, true_valid, -2)
    return {"supervised": 3 * mean_over_images((error - mean).abs(), true_valid), "supervised_gradient": 3 * gradient}


def log_error(distance: Tensor, true_distance: Tensor, true_valid: Tensor) -> Tensor:
    """e = log t - log t_true minus its median over the frame's valid pixels; 0 elsewhere. (B, 1, H, W)"""
    error = distance.clamp(min=1e-6).log() - true_distance.clamp(min=1e-6).log()
    return torch.where(true_valid, error - masked_median(error, true_valid), torch.zeros_like(error))


def uncertainty_loss(log_sigma: Tensor, error: Tensor, valid: Tensor) -> Tensor:
    """sqrt(2) |e| / sigma + log sigma: minus the log likelihood of a Laplace density of standard deviation sigma."""
    return mean_over_images(math.sqrt(2) * error.detach().abs() * torch.exp(-log_sigma) + log_sigma, valid)
