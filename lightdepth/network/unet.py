"""A ResNet-18 encoder and a decoder with skip connections, in plain torch.

The layout is the customary one of self-supervised depth networks (He et al., CVPR 2016; Godard et al., ICCV 2019): 11 M
parameters down to 1/32 of the resolution, 3 M back up.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

ENCODER = (64, 64, 128, 256, 512)
DECODER = (16, 32, 64, 128, 256)


def _conv(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)


class _BasicBlock(nn.Module):
    """ResNet's block of two 3x3 convolutions."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            _conv(inputs, outputs, 3, stride),
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
            _conv(outputs, outputs),
            nn.BatchNorm2d(outputs),
        )
        same = inputs == outputs and stride == 1
        self.shortcut: nn.Module = (
            nn.Identity() if same else nn.Sequential(_conv(inputs, outputs, 1, stride), nn.BatchNorm2d(outputs))
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.body(x) + self.shortcut(x))


class ResNet18(nn.Module):
    """Features at 1/2, 1/4, 1/8, 1/16 and 1/32 of the resolution, with 64, 64, 128, 256 and 512 channels."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(_conv(inputs, ENCODER[0], 7, 2), nn.BatchNorm2d(ENCODER[0]), nn.ReLU())
        self.pool = nn.MaxPool2d(3, 2, 1)
        pairs = zip(ENCODER[:-1], ENCODER[1:], (1, 2, 2, 2), strict=True)
        self.stages = nn.ModuleList(
            nn.Sequential(_BasicBlock(a, b, stride), _BasicBlock(b, b, 1)) for a, b, stride in pairs
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        features = [self.stem(x)]
        x = self.pool(features[0])
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


class _UpConv(nn.Module):
    """3x3 convolution that mirrors the border, then ELU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, 1, 1, padding_mode="replicate")

    def forward(self, x: Tensor) -> Tensor:
        return F.elu(self.conv(x))


class ResNetUNet(nn.Module):
    """(B, inputs, H, W) -> (B, outputs, H, W), H and W multiples of `multiple`. 14 M parameters."""

    multiple = 32

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.encoder = ResNet18(inputs)
        below = [*DECODER[1:], ENCODER[-1]]
        skips = [0, *ENCODER[:-1]]
        self.reduce = nn.ModuleList(_UpConv(b, d) for b, d in zip(below, DECODER, strict=True))
        self.join = nn.ModuleList(_UpConv(d + s, d) for d, s in zip(DECODER, skips, strict=True))
        self.head = nn.Conv2d(DECODER[0], outputs, 3, 1, 1, padding_mode="replicate")

    def forward(self, x: Tensor) -> Tensor:
        features = self.encoder(x)
        x = features[-1]
        for level in reversed(range(len(DECODER))):
            x = F.interpolate(self.reduce[level](x), scale_factor=2.0, mode="nearest")
            if level > 0:
                x = torch.cat([x, features[level - 1]], 1)
            x = self.join[level](x)
        return self.head(x)
