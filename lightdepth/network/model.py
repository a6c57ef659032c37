"""DepthNetwork: a calibrated image in, distance, albedo and uncertainty out."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightdepth.decline import log_closed_form
from lightdepth.errors import InputError
from lightdepth.network import dpt, unet
from lightdepth.network.dpt import DPT
from lightdepth.network.heads import (
    CHANNELS,
    OUTPUTS,
    ClosedForm,
    UncertaintyHead,
    draw_small,
    input_channels,
    network_inputs,
    network_outputs,
)
from lightdepth.network.tiny import TinyUNet
from lightdepth.network.unet import UNet
from lightdepth.photometry import LightTerms
from lightdepth.ranges import SHARE, at_least, checked

Input = Literal["rgb", "closed_form", "ray_z", "mask", "reflectance"]
Encoder = Literal["resnet18", "resnet34", "resnet50", "efficientnet-lite0", "vitt14", "vits14", "vitb14", "vitl14"]
KINDS = ("tiny", "unet", "dpt")
ENCODERS = {"tiny": (), "unet": unet.ENCODERS, "dpt": tuple(dpt.ENCODERS)}
MAX_WIDTH = 256
"""Of the tiny network, which then has 130 million weights: a file that asks for more is no checkpoint of ours."""
_DEFAULT_ENCODER = {"unet": "resnet18", "dpt": "vits14"}


@dataclass(frozen=True)
@checked
class NetworkConfig:
    """Which network. Plain values, so that it travels as JSON inside a checkpoint."""

    kind: Literal["tiny", "unet", "dpt"] = "tiny"
    """Which network is trained: "tiny" is small and fast (0.5 million weights); "unet" has a larger encoder, a ResNet
    or EfficientNet-Lite (5 million and more); "dpt" is a vision transformer (6 million and more, needs the extra
    `dpt`)."""
    inputs: tuple[Input, ...] = ("rgb", "closed_form", "ray_z")
    """What the network sees at each pixel, a list: rgb (the image), closed_form (log distance, computed from brightness
    alone), ray_z (cosine of the angle from the optical axis), mask (whether tissue shows), reflectance (the share of
    light that the wall reflects onto other wall, as the calibration has it). The network does without what is left
    out."""
    output: Literal["residual", "limited", "absolute", "free"] = "residual"
    """What the network answers at each pixel: "residual", what is to be added to the log distance of the closed form
    (which brightness alone gives); "limited", the same, but with the closed form held within a factor of e of its
    mean in each image; "absolute", the log distance itself, but with that mean; "free", log distance with a scale of
    its own, as --model.loss.gain one needs it."""
    encoder: Encoder | None = None
    """Encoder, the part of the network that reads the image: for unet efficientnet-lite0 (5 million weights), resnet18
    (14), resnet34 (24) or resnet50 (33); for dpt vitt14 (6 million), vits14 (25), vitb14 (97) or vitl14 (335). Those
    with more weights are stronger and slower. null takes resnet18 or vits14; for tiny it has no effect."""
    uncertainty: bool = False
    """true: the network also says how uncertain it is at each pixel, the standard deviation of log distance; it learns
    that where --model.loss.uncertainty is above 0. false: it gives distance and albedo (the wall's colour) only."""
    width: Annotated[int, at_least(1, up_to=1024)] = 16
    """Number of channels of the first level of the tiny network; deeper levels have 2 to 6 times as many, and other
    kinds do not use it. More make a stronger and slower network."""
    norm: Literal["batch", "group"] = "group"
    """How the tiny network normalises its channels: "batch", by mean and deviation over all images of a batch; "group",
    over groups of channels of each image by itself, whatever the size of the batch. Other kinds do not use it."""
    blur: Annotated[float, SHARE] = 0.018
    """Deviation (sigma) of the Gaussian blur of the closed form (distance from brightness alone), as network input and
    under the output "residual", as a share of the image height; 0 for none. A larger one leaves less of the image's
    texture in it."""

    def __post_init__(self) -> None:
        _check_plain(self)
        object.__setattr__(self, "inputs", tuple(self.inputs))  # JSON has lists
        unknown = [name for name in self.inputs if name not in CHANNELS]
        if unknown or not self.inputs:
            raise InputError("network inputs", f"{list(self.inputs)}", f"expected some of {', '.join(CHANNELS)}")
        choices: tuple[tuple[str, str, tuple[str, ...]], ...] = (
            ("kind", self.kind, KINDS),
            ("output", self.output, OUTPUTS),
            ("norm", self.norm, ("batch", "group")),
        )
        for what, value, allowed in choices:
            if value not in allowed:
                raise InputError(f"network {what}", f"{value!r} is not known", f"expected one of {', '.join(allowed)}")
        if self.encoder is None:
            object.__setattr__(self, "encoder", _DEFAULT_ENCODER.get(self.kind))
        elif self.encoder not in ENCODERS[self.kind]:
            known = ", ".join(ENCODERS[self.kind]) or "none"
            raise InputError("network encoder", f"{self.encoder!r} of {self.kind} is not known", f"expected {known}")
        if not 1 <= self.width <= MAX_WIDTH or not 0 <= self.blur <= 1:
            raise InputError(
                "network",
                f"width {self.width}, blur {self.blur}",
                f"expected width > 0, at most {MAX_WIDTH}, and blur >= 0, at most 1",
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON and for checkpoints that load without pickle."""
        return {**asdict(self), "inputs": list(self.inputs)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkConfig:
        """The inverse of `to_dict`. Raises InputError on names or values it does not know."""
        try:
            return cls(**values)
        except TypeError as error:
            raise InputError(
                "network configuration", f"{error}", "was it written by another version of the program?"
            ) from error


def _check_plain(config: NetworkConfig) -> None:
    """Raises InputError for values of another kind, as a file of anyone's may have them, before they are shown."""
    words = ("kind", "output", "norm")
    fits = all(isinstance(getattr(config, name), str) for name in words)
    fits &= config.encoder is None or isinstance(config.encoder, str)
    fits &= isinstance(config.inputs, (list, tuple)) and len(config.inputs) <= len(CHANNELS)
    fits = fits and all(isinstance(name, str) for name in config.inputs)
    fits &= isinstance(config.uncertainty, bool) and isinstance(config.width, int)
    fits &= isinstance(config.blur, (int, float))
    if not fits:
        raise InputError(
            "network configuration", "values of another kind", "was it written by another version of the program?"
        )


class Estimate(NamedTuple):
    """What a network says about a batch.

    distance (B, 1, H, W) > 0, up to scale; albedo_hs (B, 2, H, W) hue and saturation in [0, 1]; log_sigma (B, 1, H, W)
    the log of the standard deviation of log distance, or None.
    """

    distance: Tensor
    albedo_hs: Tensor
    log_sigma: Tensor | None


class DepthNetwork(nn.Module):
    """Any of the networks between the same inputs and outputs. Any image size: padded inside, cropped back."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        inputs, outputs = input_channels(config.inputs), 3
        self.body: TinyUNet | UNet | DPT
        if config.kind == "tiny":
            self.body = TinyUNet(inputs, outputs, config.width, config.norm)
        elif config.kind == "unet":
            self.body = UNet(inputs, outputs, config.encoder or "")
        else:
            self.body = DPT(inputs, outputs, config.encoder or "")
        # Training starts from the closed form (residual) or a flat distance, and a grey albedo.
        draw_small(self.body.head.weight)
        assert self.body.head.bias is not None
        nn.init.zeros_(self.body.head.bias)
        self.uncertainty = UncertaintyHead(self.body.channels + inputs + 1) if config.uncertainty else None

    def forward(self, image: Tensor, mask: Tensor, rays: Tensor, light: LightTerms) -> tuple[Tensor, Tensor]:
        """Distance and albedo of `estimate`."""
        return self.estimate(image, mask, rays, light)[:2]

    def estimate(
        self,
        image: Tensor,
        mask: Tensor,
        rays: Tensor,
        light: LightTerms,
        closed_form: ClosedForm = log_closed_form,
    ) -> Estimate:
        """image (B, 3, H, W) encoded RGB; mask (B, 1, H, W) bool; rays (B, 3, H, W) unit; light terms (B, 1, 1, 1).
        `closed_form` is there for graphs of any image size, which need it in other operations."""
        height, width = image.shape[-2:]
        with full_precision(image.device):
            inputs, log_closed = network_inputs(
                image, mask, rays, light, self.config.inputs, self.config.blur, closed_form
            )
        multiple = self.body.multiple
        padded = F.pad(inputs, (0, -width % multiple, 0, -height % multiple), mode="replicate")
        features = self.body(padded)
        coarse = self.body.head(features)
        raw = _cropped(_resized(coarse, padded), height, width)
        with full_precision(image.device):
            distance, albedo_hs = network_outputs(raw, log_closed, mask, self.config.output)
        log_sigma = None
        if self.uncertainty is not None:
            seen = torch.cat([_resized(x, features) for x in (features, padded, coarse[:, :1])], 1)
            log_sigma = _cropped(_resized(self.uncertainty(seen), padded), height, width)
        return Estimate(distance, albedo_hs, log_sigma)


def full_precision(device: torch.device) -> AbstractContextManager[Any]:
    """Switches autocast off for a while: the physics of light spans more than half precision holds."""
    kind = device.type
    return torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext()


def build_network(config: NetworkConfig) -> DepthNetwork:
    """A network with fresh weights, drawn from torch's global generator."""
    return DepthNetwork(config)


def _resized(values: Tensor, like: Tensor) -> Tensor:
    """Bilinear, to the height and width of `like`."""
    size = like.shape[-2:]
    if not torch.compiler.is_compiling() and values.shape[-2:] == size:  # a graph of any size asks no sizes
        return values
    return F.interpolate(values, size=size, mode="bilinear")


def _cropped(values: Tensor, height: int, width: int) -> Tensor:
    """The first rows and columns."""
    if not torch.compiler.is_compiling():
        return values[..., :height, :width]
    # In a graph of any size a view would ask whether it is the whole; a copy does not.
    rows, columns = (torch.arange(n, device=values.device) for n in (height, width))
    return values.index_select(-2, rows).index_select(-1, columns)
