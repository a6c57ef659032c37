"""Terms that compare the light an image shows with the light that distance and albedo would give.

Notation: t distance along the unit ray r, n normal, cos = -n · r; V = max(R, G, B), fall = exp(-mu (1 - cos psi)), E
indirect light (lightdepth.radiosity), gamma the response, rho albedo of value 1, g gain. Rendered:

    log V' = log(fall · max(cos, floor)^q / t² + E + A) / gamma,        I' = V' · rho^(1/gamma)

A is ambient light: a share of the image's mean of the rest. V is seen with the tone curve's shoulder straightened.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from kornia.metrics import ssim
from torch import Tensor

from lightdepth.losses.config import LossConfig
from lightdepth.losses.masked import masked_median, mean_over_images
from lightdepth.photometry import LightTerms, brightness, decode, encode, hue_saturation_albedo, irradiance
from lightdepth.radiosity import indirect_irradiance

_CHROMA_V = 0.1
"""Below this brightness, colour is noise."""

_SSIM_WINDOW = 5

_POOL_ROWS = 128
"""Height of the images up to which an element of the indirect light is `pool` pixels wide; wider in larger ones."""


def indirect_light(distance: Tensor, rays: Tensor, mask: Tensor, light: LightTerms, config: LossConfig) -> Tensor:
    """E (B, 1, H, W) under the configuration's reflectance, or each image's own. No gradient flows through it."""
    if config.reflectance is not None:
        light = light._replace(reflectance=torch.full_like(light.reflectance, config.reflectance))
    if not bool((light.reflectance > 0).any()):
        return torch.zeros_like(distance)
    # The number of pairs of elements would grow with the fourth power of the image's size, and tell nothing new.
    pool = max(config.pool, round(config.pool * distance.shape[-2] / _POOL_ROWS))
    return indirect_irradiance(distance.detach(), rays, mask, light.co_located(), config.bounces, pool)


def rendered_log_brightness(
    distance: Tensor,
    normals: Tensor,
    rays: Tensor,
    mask: Tensor,
    light: LightTerms,
    indirect: Tensor,
    config: LossConfig,
) -> Tensor:
    """log(fall · max(cos, floor)^q / t² + E + A) / gamma, the log brightness of a wall of value 1. (B, 1, H, W)

    The mean that A is a share of is over the mask (B, 1, H, W).
    """
    light = light.co_located()
    lit = irradiance(distance, normals, rays, light, config.cosine_exponent, config.cosine_floor) + indirect
    if config.ambient > 0:
        inside = torch.where(mask, lit, 0.0).sum((2, 3), keepdim=True) / mask.sum((2, 3), keepdim=True).clamp(min=1)
        lit = lit + config.ambient * inside
    return lit.clamp(min=1e-12).log() / light.gamma


def brightness_residual(log_seen: Tensor, log_rendered: Tensor, usable: Tensor) -> Tensor:
    """log V - log V' minus its median over the usable pixels: free of gain and exposure. (B, 1, H, W)"""
    residual = log_seen - log_rendered
    return residual - masked_median(residual, usable).detach()


def rendered_rgb(log_rendered: Tensor, albedo_hs: Tensor, gamma: Tensor) -> Tensor:
    """I' = V' rho^(1/gamma), encoded and not clipped. (B, 3, H, W)"""
    return log_rendered.exp() * encode(hue_saturation_albedo(albedo_hs), gamma)


def rgb_residual(image: Tensor, rendered: Tensor, gamma: Tensor, space: str) -> Tensor:
    """I - I' as encoded, or I^gamma - I'^gamma in "linear" space. (B, 3, H, W)"""
    return decode(image, gamma) - decode(rendered, gamma) if space == "linear" else image - rendered


def photometric_loss(residual: Tensor, usable: Tensor, huber: float) -> Tensor:
    """Huber(residual) / huber over the usable pixels: valid, not black, not saturated. L1 with huber 0."""
    return mean_over_images(
        F.smooth_l1_loss(residual, torch.zeros_like(residual), reduction="none", beta=huber), usable
    )


def ssim_loss(image: Tensor, rendered: Tensor, usable: Tensor) -> Tensor:
    """(1 - SSIM(I, I')) / 2 over windows of 5x5 usable pixels (Wang et al. 2004), RGB as encoded."""
    shown = torch.where(usable, rendered.clamp(0, 1), image)
    whole = -F.max_pool2d(-usable.to(image.dtype), _SSIM_WINDOW, 1, _SSIM_WINDOW // 2) > 0.5
    return mean_over_images((1 - ssim(image, shown, _SSIM_WINDOW)) / 2, whole)


def saturated_loss(residual: Tensor, saturated: Tensor, usable: Tensor, huber: float) -> Tensor:
    """Huber(max(residual, 0)) / huber on saturated pixels: the rendered may be brighter than white, not darker.

    An image with no usable pixel has no gain to compare with, and counts 0.
    """
    darker = residual.clamp(min=0)
    known = saturated & usable.flatten(1).any(1).reshape(-1, 1, 1, 1)
    return mean_over_images(F.smooth_l1_loss(darker, torch.zeros_like(darker), reduction="none", beta=huber), known)


def specular_loss(normals: Tensor, rays: Tensor, highlights: Tensor) -> Tensor:
    """1 - cos on highlights: light and eye coincide, so that a mirror shows the light where it faces it."""
    return mean_over_images(1 + (normals * rays).sum(1, keepdim=True), highlights)


def chroma_loss(albedo_hs: Tensor, image: Tensor, light: LightTerms, mask: Tensor) -> Tensor:
    """|(I / V)^gamma - rho|: with value 1 the albedo's colour is the image's, whatever the distance."""
    v = brightness(image)
    seen = decode((image / v.clamp(min=_CHROMA_V)).clamp(max=1), light.gamma)
    return mean_over_images((seen - hue_saturation_albedo(albedo_hs)).abs(), mask & (v > _CHROMA_V))
