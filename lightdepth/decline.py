"""Depth in closed form from the decline of the light: no training, the baseline that every network must beat.

With the albedo's value at 1 and the light at the camera, V = max(R, G, B) obeys
V^gamma = g exp(-mu (1 - cos psi)) cos / d². Taking the unknown cosine as 1 and solving for the distance:

    d = sqrt( g exp(-mu (1 - cos psi)) / V^gamma )
"""

from __future__ import annotations

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from lightdepth.photometry import LightTerms, brightness, spread

V_FLOOR = 0.02
BLUR = 0.018
"""Width of the blur of log V, as a share of the image height (measured best on real C3VD frames)."""


def masked_blur(values: Tensor, mask: Tensor, sigma: float) -> Tensor:
    """Gaussian blur [px] normalised inside the mask: what lies outside never leaks in. (B, 1, H, W)"""
    if sigma <= 0:
        return values
    size = 2 * int(3 * sigma + 0.5) + 1
    kernel = min(size, 2 * min(values.shape[-2:]) - 1)  # kornia pads by reflection: the kernel must fit
    weight = mask.to(values.dtype)
    both = gaussian_blur2d(torch.cat([torch.where(mask, values, 0.0), weight], 1), (kernel, kernel), (sigma, sigma))
    return torch.where(mask, both[:, :1] / both[:, 1:].clamp(min=1e-6), values)


def log_closed_form(image: Tensor, mask: Tensor, rays: Tensor, light: LightTerms, blur: float = BLUR) -> Tensor:
    """log d (B, 1, H, W) of encoded images (B, 3, H, W); `blur` as a share of the image height.

    The light is taken as co-located: its offset has a length, and this distance has only a scale.
    """
    light = light.co_located()
    log_v = brightness(image).clamp(min=V_FLOOR).log()
    log_v = masked_blur(log_v, mask, blur * image.shape[-2])
    return 0.5 * (light.gain.log() + spread(rays, light).log() - light.gamma * log_v)


def most_spread(image: Tensor, light: LightTerms) -> Tensor:
    """What no standard deviation of `log_closed_form` inside the mask exceeds, (B, 1, 1, 1): half of how far brightness
    and the light's spread reach. Images (B, 3, H, W)."""
    brightest = image.flatten(1).amax(1).clamp(min=1).reshape(-1, 1, 1, 1)
    return 0.25 * light.gamma * (brightest / V_FLOOR).log() + 0.5 * light.mu


def informative(image: Tensor, mask: Tensor) -> Tensor:
    """Pixels whose brightness says something about distance: inside the mask and not black. (B, 1, H, W) bool"""
    return mask & (brightness(image) > V_FLOOR)
