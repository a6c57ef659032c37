"""Convolutional encoders, ResNets among them, and a decoder with skip connections, in plain torch.

The layout is the customary one of self-supervised depth networks (He et al., CVPR 2016; Godard et al., ICCV 2019).
Parameters of a ResNet are named as torchvision names them, so that its ImageNet weights can be read from a file.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightdepth.network.efficientnet import EfficientNetLite

DECODER = (16, 32, 64, 128, 256)

RESNETS = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3), "resnet50": (3, 4, 6, 3)}
"""Blocks per stage; resnet50's have a bottleneck."""

IMAGENET_STD = (0.229, 0.224, 0.225)
"""Of the colours of ImageNet."""

LITE = "efficientnet-lite0"
ENCODERS = (*RESNETS, LITE)


def _conv(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)


def _shortcut(inputs: int, outputs: int, stride: int) -> nn.Module:
    if inputs == outputs and stride == 1:
        return nn.Identity()
    return nn.Sequential(_conv(inputs, outputs, 1, stride), nn.BatchNorm2d(outputs))


class _BasicBlock(nn.Module):
    """Two 3x3 convolutions."""

    expansion = 1

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = _conv(inputs, width, 3, stride), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = _conv(width, width), nn.BatchNorm2d(width)
        self.downsample = _shortcut(inputs, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(y)) + self.downsample(x))


class _Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions; the middle one takes the stride."""

    expansion = 4

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = width * self.expansion
        self.conv1, self.bn1 = _conv(inputs, width, 1), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = _conv(width, width, 3, stride), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = _conv(width, outputs, 1), nn.BatchNorm2d(outputs)
        self.downsample = _shortcut(inputs, outputs, stride)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class ResNet(nn.Module):
    """Features at 1/2, 1/4, 1/8, 1/16 and 1/32 of the resolution, with `channels` channels."""

    stem = "conv1.weight"
    """The weights that see the image."""
    std = IMAGENET_STD
    """By which torchvision's weights expect colours to be divided."""

    def __init__(self, encoder: str, inputs: int) -> None:
        super().__init__()
        block = _Bottleneck if encoder == "resnet50" else _BasicBlock
        widths = (64, 128, 256, 512)
        self.channels = (64, *(width * block.expansion for width in widths))
        self.conv1, self.bn1 = _conv(inputs, 64, 7, 2), nn.BatchNorm2d(64)
        self.pool = nn.MaxPool2d(3, 2, 1)
        for stage, (width, below, blocks) in enumerate(zip(widths, self.channels, RESNETS[encoder], strict=False), 1):
            stride = 1 if stage == 1 else 2
            first = block(below, width, stride)
            rest = [block(width * block.expansion, width, 1) for _ in range(blocks - 1)]
            self.add_module(f"layer{stage}", nn.Sequential(first, *rest))

    def forward(self, x: Tensor) -> list[Tensor]:
        features = [F.relu(self.bn1(self.conv1(x)))]
        x = self.pool(features[0])
        for stage in range(1, 5):
            x = self.get_submodule(f"layer{stage}")(x)
            features.append(x)
        return features


class _UpConv(nn.Module):
    """3x3 convolution that mirrors the border, then ELU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, 1, 1, padding_mode="replicate")

    def forward(self, x: Tensor) -> Tensor:
        return F.elu(self.conv(x))


class UNet(nn.Module):
    """(B, inputs, H, W) -> features (B, channels, H, W) for `head`, H and W multiples of `multiple`.

    Parameters: 5 M with efficientnet-lite0, 14 M with resnet18, 24 M with resnet34, 33 M with resnet50.
    """

    multiple = 32

    def __init__(self, inputs: int, outputs: int, encoder: str = "resnet18") -> None:
        super().__init__()
        self.encoder = EfficientNetLite(inputs) if encoder == LITE else ResNet(encoder, inputs)
        below = [*DECODER[1:], self.encoder.channels[-1]]
        skips = [0, *self.encoder.channels[:-1]]
        self.reduce = nn.ModuleList(_UpConv(b, d) for b, d in zip(below, DECODER, strict=True))
        self.join = nn.ModuleList(_UpConv(d + s, d) for d, s in zip(DECODER, skips, strict=True))
        self.channels = DECODER[0]
        self.head = nn.Conv2d(self.channels, outputs, 3, 1, 1, padding_mode="replicate")

    def forward(self, x: Tensor) -> Tensor:
        features = self.encoder(x)
        x = features[-1]
        for level in reversed(range(len(DECODER))):
            x = F.interpolate(self.reduce[level](x), scale_factor=2.0, mode="nearest")
            if level > 0:
                x = torch.cat([x, features[level - 1]], 1)
            x = self.join[level](x)
        return x
