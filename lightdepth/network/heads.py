"""What goes into a depth network and what comes out, whatever lies between.

Notation: t distance along the unit ray r, V = max(R, G, B), c = log t in closed form (lightdepth.decline). Images are
(B, C, H, W).

In: channels chosen by name, each zero outside the mask. Out, from three raw channels (a, h, s):

    log t = mean c + b - mean b    with b = a            output "absolute"
                                   b = c + a             output "residual": corrects the closed form, which is a = 0
                                   b = tanh(c - mean c) + a    output "limited": the same, but no farther than a factor
                                                         of e from the mean, as dark lumen comes out much too far
    log t = a                      output "free": a scale of its own, for losses with a fixed gain
    albedo = (sigmoid h, sigmoid s), hue and saturation of a colour whose value is 1

Unless it is "free" the scale is the closed form's: no loss that is free of gain could teach it, and it would drift
until exp overflows.

Uncertainty: the standard deviation of log t, once each frame's scale is taken out, from a head of its own (raw b):

    log sigma = k b + log s        k, s the calibration, (1, 1) until lightdepth.uncertainty has fitted it
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from lightdepth.decline import log_closed_form
from lightdepth.photometry import LightTerms

CHANNELS = {"rgb": 3, "closed_form": 1, "ray_z": 1, "mask": 1, "reflectance": 1}
"""Inputs to choose from, and how many channels each takes; reflectance is the wall's, as the calibration has it."""

OUTPUTS = ("residual", "limited", "absolute", "free")

ClosedForm = Callable[[Tensor, Tensor, Tensor, LightTerms, float], Tensor]
"""Log distance of image, mask, rays and light, and the width of the blur."""

_LOG_LIMIT = 15.0  # only to keep exp, and its square, finite
_LOG_SIGMA_LIMIT = 6.0


def input_channels(names: tuple[str, ...]) -> int:
    return sum(CHANNELS[name] for name in names)


def mean_per_image(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of each image (B, 1, H, W) inside its mask, (B, 1, 1, 1); 0 where the mask is empty."""
    total = torch.where(mask, values, 0).sum((-2, -1), keepdim=True)
    return total / mask.sum((-2, -1), keepdim=True).clamp(min=1)


def network_inputs(
    image: Tensor,
    mask: Tensor,
    rays: Tensor,
    light: LightTerms,
    names: tuple[str, ...],
    blur: float,
    closed_form: ClosedForm = log_closed_form,
) -> tuple[Tensor, Tensor]:
    """The input channels (B, C, H, W) and the log closed form c (B, 1, H, W), which outside the mask is its mean.

    `blur` of the closed form as a share of the image height.
    """
    log_closed = closed_form(image, mask, rays, light, blur)
    mean = mean_per_image(log_closed, mask)
    log_closed = torch.where(mask, log_closed, mean)
    made = {
        "rgb": torch.where(mask, image - 0.5, 0),
        "closed_form": log_closed - mean,
        "ray_z": torch.where(mask, rays[:, 2:3], 0),
        "mask": mask.to(image.dtype),
        "reflectance": torch.where(mask, light.reflectance, 0),
    }
    return torch.cat([made[name] for name in names], 1), log_closed


def network_outputs(raw: Tensor, log_closed: Tensor, mask: Tensor, output: str) -> tuple[Tensor, Tensor]:
    """Distance (B, 1, H, W) > 0 and albedo as hue and saturation (B, 2, H, W), from raw channels (B, 3, H, W)."""
    shape = raw[:, :1].float()
    if output == "free":
        return shape.clamp(-_LOG_LIMIT, _LOG_LIMIT).exp(), raw[:, 1:].float().sigmoid()
    mean = mean_per_image(log_closed, mask)
    if output == "residual":
        shape = shape + log_closed
    elif output == "limited":
        shape = shape + (log_closed - mean).tanh()
    log_distance = mean + shape - mean_per_image(shape, mask)
    return log_distance.clamp(-_LOG_LIMIT, _LOG_LIMIT).exp(), raw[:, 1:].float().sigmoid()


def draw_small(weights: Tensor) -> None:
    """Draws weights about 0, a thousandth off. On the device `meta`, where there are none to draw, it does
    nothing: PyTorch would load its compiler for that, which takes seconds."""
    if not weights.is_meta:
        nn.init.normal_(weights, std=1e-3)


class UncertaintyHead(nn.Module):
    """(B, channels, h, w) -> log sigma (B, 1, h, w). It reads features and never changes them.

    `calibration` (2,) is (k, log s); it travels with the weights.
    """

    calibration: Tensor

    def __init__(self, channels: int, width: int = 32) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels, width, 3, 1, 1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, 1, 2, dilation=2),
            nn.ReLU(),
            nn.Conv2d(width, 1, 1),
        )
        last = self.layers[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        draw_small(last.weight)
        nn.init.constant_(last.bias, -2.0)  # 13 %, about what the closed form errs by
        self.register_buffer("calibration", torch.tensor([1.0, 0.0]))

    def forward(self, features: Tensor) -> Tensor:
        raw = self.layers(features.detach()).float().clamp(-_LOG_SIGMA_LIMIT, _LOG_SIGMA_LIMIT)
        result: Tensor = self.calibration[0] * raw + self.calibration[1]
        return result
