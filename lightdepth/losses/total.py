"""The weighted sums."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from lightdepth.decline import informative
from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch
from lightdepth.geometry import normals_from_distance
from lightdepth.losses import light as lit
from lightdepth.losses import surface, truth
from lightdepth.losses.config import LossConfig
from lightdepth.losses.highlights import highlights
from lightdepth.losses.masked import masked_median
from lightdepth.photometry import bent, brightness, straightened

_V_FLOOR = 1e-2


@dataclass(frozen=True)
class Seen:
    """What the loss takes from the images alone, (B, 1, H, W) each: log V, which pixels are white, which tell of
    distance, the guide of the smoothness, and which white ones are highlights (None where no term asks). A loss that is
    taken many times on the same images needs it once."""

    log_v: Tensor
    saturated: Tensor
    usable: Tensor
    guide: Tensor
    highlights: Tensor | None = None

    @classmethod
    def of(cls, batch: FrameBatch, config: LossConfig) -> Seen:
        v = brightness(batch.image)
        log_v = straightened(v, config.shoulder).clamp(min=_V_FLOOR).log()
        saturated = batch.mask & (v >= config.white)
        usable = informative(batch.image, batch.mask) & ~saturated
        shine = None
        if config.specular > 0:
            shine = highlights(v, saturated, batch.mask, config.highlight_size, config.highlight_contrast)
        return cls(log_v, saturated, usable, surface.smoothness_guide(log_v, batch.mask), shine)


def self_supervised_loss(
    distance: Tensor,
    albedo_hs: Tensor | None,
    batch: FrameBatch,
    config: LossConfig,
    seen: Seen | None = None,
    indirect: Tensor | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum of all terms that need no truth, and the terms unweighted.

    Terms of weight 0 are skipped, except the five in the default loss, which are always reported.

    `seen` and `indirect` are made from the images and the distance where they are not given. Without an albedo there
    is no chroma, and nothing but brightness can be compared.
    """
    image, mask, rays, light = batch.image, batch.mask, batch.rays, batch.light
    seen = seen or Seen.of(batch, config)
    if indirect is None:
        indirect = lit.indirect_light(distance, rays, mask, light, config)

    normals = normals_from_distance(distance, rays)
    log_rendered = lit.rendered_log_brightness(distance, normals, rays, mask, light, indirect, config)
    free = config.gain == "free"
    residual = lit.brightness_residual(seen.log_v, log_rendered, seen.usable) if free else seen.log_v - log_rendered
    image = straightened(image, config.shoulder)
    compared, rendered = residual, image
    if config.space != "log" or config.ssim > 0:
        if albedo_hs is None:
            raise InputError(
                "loss",
                f"space {config.space!r}, ssim {config.ssim}, but no colours without albedo",
                "take space log and ssim 0, or a network that gives albedo",
            )
        rendered = lit.rendered_rgb(seen.log_v - residual, albedo_hs, light.gamma)
    if config.space != "log":
        compared = lit.rgb_residual(image, rendered, light.gamma, config.space)
    terms = {
        "photometric": lit.photometric_loss(compared, seen.usable, config.huber),
        "saturated": lit.saturated_loss(residual, seen.saturated, seen.usable, config.huber),
        "facing": surface.facing_loss(normals, rays, mask, config.cosine_floor),
        "smoothness": surface.smoothness_loss(distance.log(), seen.guide, mask),
    }
    if albedo_hs is not None:
        terms["chroma"] = lit.chroma_loss(albedo_hs, image, light, mask & ~seen.saturated)
    if config.ssim > 0:
        terms["ssim"] = lit.ssim_loss(image, rendered, seen.usable)
    if seen.highlights is not None:
        terms["specular"] = lit.specular_loss(normals, rays, seen.highlights)
    if config.albedo > 0 and albedo_hs is not None:
        terms["albedo"] = surface.albedo_loss(albedo_hs, mask)
    total = sum((getattr(config, name) * value for name, value in terms.items()), start=distance.new_zeros(()))
    return total, terms


def training_loss(
    distance: Tensor, albedo_hs: Tensor, batch: FrameBatch, config: LossConfig, log_sigma: Tensor | None = None
) -> tuple[Tensor, dict[str, Tensor]]:
    """`self_supervised_loss`, and the terms with truth where the configuration gives them a weight."""
    total, terms = self_supervised_loss(distance, albedo_hs, batch, config)
    total = config.self_supervised * total
    if config.supervised > 0:
        found = truth.supervised_loss(distance, batch.true_distance, batch.true_valid)
        terms = {**terms, **found}
        total = total + config.supervised * sum(found.values(), start=distance.new_zeros(()))
    if config.uncertainty > 0 and log_sigma is not None:
        error = truth.log_error(distance, batch.true_distance, batch.true_valid)
        terms["uncertainty"] = truth.uncertainty_loss(log_sigma, error, batch.true_valid)
        total = total + config.uncertainty * terms["uncertainty"]
    return total, terms


def render_image(distance: Tensor, albedo_hs: Tensor, batch: FrameBatch, config: LossConfig) -> Tensor:
    """The image as the loss renders it, its gain matched to the one seen, bent by the tone curve and clipped at white.
    (B, 3, H, W)"""
    normals = normals_from_distance(distance, batch.rays)
    indirect = lit.indirect_light(distance, batch.rays, batch.mask, batch.light, config)
    log_rendered = lit.rendered_log_brightness(distance, normals, batch.rays, batch.mask, batch.light, indirect, config)
    seen = Seen.of(batch, config)
    gain = masked_median(seen.log_v - log_rendered, seen.usable)
    rendered = lit.rendered_rgb(log_rendered + gain, albedo_hs, batch.light.gamma)
    return bent(rendered, config.shoulder).clamp(max=1) * batch.mask
