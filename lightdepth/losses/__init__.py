"""What a depth network is trained on: one function per term, and their weighted sums.

Everything is (B, C, H, W); a term is the mean over its pixels of each image, then over the images. Where a term has no
pixel to speak of (black, saturated or fully masked images) it is 0 and has no gradient.

The light is taken as co-located with the camera: its offset is a length, and t has only a scale.
"""

from lightdepth.losses.config import LossConfig
from lightdepth.losses.light import (
    brightness_residual,
    chroma_loss,
    indirect_light,
    photometric_loss,
    rendered_log_brightness,
    rendered_rgb,
    rgb_residual,
    saturated_loss,
    specular_loss,
    ssim_loss,
)
from lightdepth.losses.masked import masked_median, mean_over_images
from lightdepth.losses.surface import albedo_loss, facing_loss, smoothness_guide, smoothness_loss
from lightdepth.losses.total import Seen, render_image, self_supervised_loss, training_loss
from lightdepth.losses.truth import log_error, supervised_loss, uncertainty_loss

__all__ = [
    "LossConfig",
    "Seen",
    "albedo_loss",
    "brightness_residual",
    "chroma_loss",
    "facing_loss",
    "indirect_light",
    "log_error",
    "mean_over_images",
    "masked_median",
    "photometric_loss",
    "render_image",
    "rendered_log_brightness",
    "rendered_rgb",
    "rgb_residual",
    "saturated_loss",
    "self_supervised_loss",
    "smoothness_guide",
    "smoothness_loss",
    "specular_loss",
    "ssim_loss",
    "supervised_loss",
    "training_loss",
    "uncertainty_loss",
]
