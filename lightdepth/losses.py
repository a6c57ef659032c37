"""What a depth network is trained on: one function per term, and their weighted sums.

Notation: t distance along the unit ray r, n normal of the surface t·r, cos = -n · r; V = max(R, G, B), fall =
exp(-mu (1 - cos psi)), E indirect light (lightdepth.radiosity), gamma the response; rho albedo of value 1. Everything
is (B, C, H, W); a term is the mean over its pixels of each image, then over the images. Where a term has no pixel to
speak of (black, saturated or fully masked images) it is 0 and has no gradient.

The light is taken as co-located with the camera: its offset is a length, and t has only a scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from lightdepth.decline import informative, masked_blur
from lightdepth.frame import FrameBatch
from lightdepth.geometry import normals_from_distance
from lightdepth.photometry import LightTerms, brightness, decode, encode, hue_saturation_albedo, irradiance
from lightdepth.radiosity import indirect_irradiance

_ROWS = 112
"""Image height at which the smoothness weights were measured."""

_CHROMA_V = 0.1
"""Below this brightness, colour is noise."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms and the constants inside them; the defaults are measured on synthetic colons with texture.

    Args:
        photometric: weight of the rendered against the seen brightness.
        saturated: weight of the one-sided term on saturated pixels.
        facing: weight of the term against grazing surfaces.
        smoothness: weight of the edge-aware second differences, at 112 rows.
        chroma: weight of the albedo's hue and saturation.
        self_supervised: weight of all of the above together.
        supervised: weight of the terms that compare with true distance (0: truth is never read).
        reflectance: of the wall, for the indirect light; null takes each image's calibrated value.
        cosine_exponent: q of cos^q; the cosine is weaker in endoscopes than Lambert's 1.
        cosine_floor: cosines below are rendered as this.
        huber: where the photometric term turns from square to linear, in log V.
        white: brightness from which a pixel counts as saturated.
        bounces: of the indirect light.
        pool: pixels per side of an element of the indirect light.
    """

    photometric: float = 1.0
    saturated: float = 0.3
    facing: float = 2.0
    smoothness: float = 50.0
    chroma: float = 1.0
    self_supervised: float = 1.0
    supervised: float = 0.0
    reflectance: float | None = 0.6
    cosine_exponent: float = 0.5
    cosine_floor: float = 0.03
    huber: float = 0.05
    white: float = 0.97
    bounces: int = 3
    pool: int = 8


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean inside the mask of each image, then over images; values outside may be anything, NaN included."""
    kept = torch.where(mask, values, torch.zeros_like(values))
    return (kept.sum((1, 2, 3)) / mask.expand_as(values).sum((1, 2, 3)).clamp(min=1)).mean()


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """Lower median inside the mask of each image, (B, 1, 1, 1); 0 where the mask is empty."""
    ordered = torch.where(mask, values, torch.full_like(values, torch.inf)).flatten(1).sort(1).values
    count = mask.flatten(1).sum(1, keepdim=True)
    median = ordered.gather(1, ((count - 1) // 2).clamp(min=0))
    return torch.where(count > 0, median, torch.zeros_like(median)).reshape(-1, 1, 1, 1)


def rendered_log_brightness(
    distance: Tensor, normals: Tensor, rays: Tensor, mask: Tensor, light: LightTerms, config: LossConfig
) -> Tensor:
    """log(fall · max(cos, floor)^q / t² + E) / gamma, the log brightness of a wall of value 1. (B, 1, H, W)"""
    light = light.co_located()
    direct = irradiance(distance, normals, rays, light, config.cosine_exponent, config.cosine_floor)
    if config.reflectance is not None:
        light = light._replace(reflectance=torch.full_like(light.reflectance, config.reflectance))
    indirect: Tensor | float = 0.0
    if bool((light.reflectance > 0).any()):
        indirect = indirect_irradiance(distance.detach(), rays, mask, light, config.bounces, config.pool)
    return (direct + indirect).clamp(min=1e-12).log() / light.gamma


def brightness_residual(log_seen: Tensor, log_rendered: Tensor, usable: Tensor) -> Tensor:
    """log V - log V_rendered minus its median over the usable pixels: free of gain and exposure. (B, 1, H, W)"""
    residual = log_seen - log_rendered
    return residual - masked_median(residual, usable).detach()


def photometric_loss(residual: Tensor, usable: Tensor, huber: float) -> Tensor:
    """Huber(residual) / huber over the usable pixels: valid, not black, not saturated."""
    return masked_mean(F.smooth_l1_loss(residual, torch.zeros_like(residual), reduction="none", beta=huber), usable)


def saturated_loss(residual: Tensor, saturated: Tensor, usable: Tensor, huber: float) -> Tensor:
    """Huber(max(residual, 0)) / huber on saturated pixels: the rendered may be brighter than white, not darker.

    An image with no usable pixel has no gain to compare with, and counts 0.
    """
    darker = residual.clamp(min=0)
    known = saturated & usable.flatten(1).any(1).reshape(-1, 1, 1, 1)
    return masked_mean(F.smooth_l1_loss(darker, torch.zeros_like(darker), reduction="none", beta=huber), known)


def facing_loss(normals: Tensor, rays: Tensor, mask: Tensor, floor: float) -> Tensor:
    """max(floor - cos, 0): surfaces that are seen are not edge-on."""
    return masked_mean((floor + (normals * rays).sum(1, keepdim=True)).clamp(min=0), mask)


def smoothness_loss(log_distance: Tensor, log_seen: Tensor, mask: Tensor) -> Tensor:
    """Mean over both axes of |second difference of log t| · exp(-5 |difference of blurred log V|).

    Differences are rescaled to an image of 112 rows, so that a weight holds at every resolution: a first difference
    shrinks with the pixel's size, a second difference with its square.
    """
    rows = log_distance.shape[-2] / _ROWS
    guide = masked_blur(log_seen, mask, log_seen.shape[-2] * 0.009)
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
        total = total + masked_mean(second.abs() * rows**2 * torch.exp(-5 * rows * edge), inside)
    return total / 2


def chroma_loss(albedo_hs: Tensor, image: Tensor, light: LightTerms, mask: Tensor) -> Tensor:
    """|(I / V)^gamma - rho|: with value 1 the albedo's colour is the image's, whatever the distance."""
    v = brightness(image)
    seen = decode((image / v.clamp(min=_CHROMA_V)).clamp(max=1), light.gamma)
    return masked_mean((seen - hue_saturation_albedo(albedo_hs)).abs(), mask & (v > _CHROMA_V))


def supervised_loss(distance: Tensor, true_distance: Tensor, true_valid: Tensor) -> dict[str, Tensor]:
    """With e = log t - log t_true: 3 |e - mean e|, and 3 |differences of e| at 112 rows' spacing. Free of scale."""
    error = distance.clamp(min=1e-6).log() - true_distance.clamp(min=1e-6).log()
    error = torch.where(true_valid, error, torch.zeros_like(error))
    mean = error.sum((1, 2, 3), keepdim=True) / true_valid.sum((1, 2, 3), keepdim=True).clamp(min=1)
    rows = distance.shape[-2] / _ROWS
    gradient = error.new_zeros(())
    for axis in (-1, -2):
        length = error.shape[axis] - 1
        if length > 0:
            step = error.narrow(axis, 1, length) - error.narrow(axis, 0, length)
            both = true_valid.narrow(axis, 1, length) & true_valid.narrow(axis, 0, length)
            gradient = gradient + masked_mean(step.abs(), both) * rows
    return {"supervised": 3 * masked_mean((error - mean).abs(), true_valid), "supervised_gradient": 3 * gradient}


def self_supervised_loss(
    distance: Tensor, albedo_hs: Tensor, batch: FrameBatch, config: LossConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum of all terms that need no truth, and the terms unweighted."""
    image, mask, rays, light = batch.image, batch.mask, batch.rays, batch.light
    v = brightness(image)
    log_seen = v.clamp(min=1e-2).log()
    saturated = mask & (v >= config.white)
    usable = informative(image, mask) & ~saturated

    normals = normals_from_distance(distance, rays)
    log_rendered = rendered_log_brightness(distance, normals, rays, mask, light, config)
    residual = brightness_residual(log_seen, log_rendered, usable)
    terms = {
        "photometric": photometric_loss(residual, usable, config.huber),
        "saturated": saturated_loss(residual, saturated, usable, config.huber),
        "facing": facing_loss(normals, rays, mask, config.cosine_floor),
        "smoothness": smoothness_loss(distance.log(), log_seen, mask),
        "chroma": chroma_loss(albedo_hs, image, light, mask & ~saturated),
    }
    total = sum((getattr(config, name) * value for name, value in terms.items()), start=distance.new_zeros(()))
    return total, terms


def training_loss(
    distance: Tensor, albedo_hs: Tensor, batch: FrameBatch, config: LossConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """`self_supervised_loss`, and the supervised terms where the configuration gives them a weight."""
    total, terms = self_supervised_loss(distance, albedo_hs, batch, config)
    total = config.self_supervised * total
    if config.supervised > 0:
        truth = supervised_loss(distance, batch.true_distance, batch.true_valid)
        terms = {**terms, **truth}
        total = total + config.supervised * sum(truth.values(), start=distance.new_zeros(()))
    return total, terms


def render_image(distance: Tensor, albedo_hs: Tensor, batch: FrameBatch, config: LossConfig) -> Tensor:
    """The image as the loss renders it, its gain matched to the one seen and clipped at white. (B, 3, H, W)"""
    normals = normals_from_distance(distance, batch.rays)
    log_rendered = rendered_log_brightness(distance, normals, batch.rays, batch.mask, batch.light, config)
    v = brightness(batch.image)
    usable = informative(batch.image, batch.mask) & (v < config.white)
    gain = masked_median(v.clamp(min=1e-2).log() - log_rendered, usable)
    colour = encode(hue_saturation_albedo(albedo_hs), batch.light.gamma)
    return ((log_rendered + gain).exp() * colour).clamp(max=1) * batch.mask
