"""DepthNetwork: a calibrated image in, distance and albedo out."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch.nn.functional as F
from torch import Tensor, nn

from lightdepth.errors import InputError
from lightdepth.network.heads import CHANNELS, OUTPUTS, input_channels, network_inputs, network_outputs
from lightdepth.network.tiny import TinyUNet
from lightdepth.network.unet import ResNetUNet
from lightdepth.photometry import LightTerms

KINDS = ("tiny", "unet")


@dataclass(frozen=True)
class NetworkConfig:
    """Which network. Plain values, so that it travels as JSON inside a checkpoint.

    Args:
        kind: "tiny" (0.5 M parameters) or "unet" (ResNet-18, 14 M).
        inputs: channels that go in, of rgb, closed_form, ray_z, mask.
        output: "residual" (a correction of the closed form) or "absolute" (log distance itself); both have its scale.
        width: channels of the tiny network's first level.
        norm: normalisation of the tiny network, "batch" or "group".
        blur: width of the blur of the closed form that goes in, as a share of the image height.
    """

    kind: Literal["tiny", "unet"] = "tiny"
    inputs: tuple[str, ...] = ("rgb", "closed_form", "ray_z")
    output: Literal["residual", "absolute"] = "residual"
    width: int = 16
    norm: Literal["batch", "group"] = "group"
    blur: float = 0.018

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", tuple(self.inputs))  # JSON has lists
        unknown = [name for name in self.inputs if name not in CHANNELS]
        if unknown or not self.inputs:
            raise InputError(f"network inputs {list(self.inputs)}; expected some of {', '.join(CHANNELS)}")
        for what, value, allowed in (
            ("kind", self.kind, KINDS),
            ("output", self.output, OUTPUTS),
            ("norm", self.norm, ("batch", "group")),
        ):
            if value not in allowed:
                raise InputError(f"network {what} {value!r}; expected one of {', '.join(allowed)}")
        if self.width < 1 or self.blur < 0:
            raise InputError(f"network width {self.width}, blur {self.blur}; expected width > 0 and blur >= 0")

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON and for checkpoints that load without pickle."""
        return {**asdict(self), "inputs": list(self.inputs)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkConfig:
        """The inverse of `to_dict`. Raises InputError on names or values it does not know."""
        try:
            return cls(**values)
        except TypeError as error:
            raise InputError(f"network configuration {values}: {error}") from error


class DepthNetwork(nn.Module):
    """Any of the networks between the same inputs and outputs. Any image size: padded inside, cropped back."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        inputs, outputs = input_channels(config.inputs), 3
        self.body: TinyUNet | ResNetUNet
        if config.kind == "tiny":
            self.body = TinyUNet(inputs, outputs, config.width, config.norm)
        else:
            self.body = ResNetUNet(inputs, outputs)
        # Training starts from the closed form (residual) or a flat distance (absolute), and a grey albedo.
        nn.init.normal_(self.body.head.weight, std=1e-3)
        assert self.body.head.bias is not None
        nn.init.zeros_(self.body.head.bias)

    def forward(self, image: Tensor, mask: Tensor, rays: Tensor, light: LightTerms) -> tuple[Tensor, Tensor]:
        """Distance (B, 1, H, W) > 0, up to scale, and albedo as hue and saturation (B, 2, H, W) in [0, 1].

        image (B, 3, H, W) encoded RGB; mask (B, 1, H, W) bool; rays (B, 3, H, W) unit; light terms (B, 1, 1, 1).
        """
        height, width = image.shape[-2:]
        features, log_closed = network_inputs(image, mask, rays, light, self.config.inputs, self.config.blur)
        multiple = self.body.multiple
        padding = (0, -width % multiple, 0, -height % multiple)
        raw = self.body(F.pad(features, padding, mode="replicate"))[..., :height, :width]
        return network_outputs(raw, log_closed, mask, self.config.output)


def build_network(config: NetworkConfig) -> DepthNetwork:
    """A network with fresh weights, drawn from torch's global generator."""
    return DepthNetwork(config)
