"""A small U-Net that a CPU trains in minutes and runs in milliseconds."""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

WIDTHS = (1, 2, 3, 4, 6)
"""Channels of the levels, in units of the network's width."""


def normalisation(kind: str, channels: int) -> nn.Module:
    """ "group" (at least 8 channels a group, or all where there are fewer, independent of the batch) or "batch"."""
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    groups = next(n for n in range(max(1, channels // 8), 0, -1) if channels % n == 0)
    return nn.GroupNorm(groups, channels)


class _Residual(nn.Module):
    """x + f(x), f two 3x3 convolutions; the shortcut is 1x1 where the number of channels changes."""

    def __init__(self, inputs: int, outputs: int, norm: str, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm1 = normalisation(norm, outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norm2 = normalisation(norm, outputs)
        same = inputs == outputs and stride == 1
        self.shortcut: nn.Module = nn.Identity() if same else nn.Conv2d(inputs, outputs, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm1(self.conv1(x)))
        return F.relu(self.shortcut(x) + self.norm2(self.conv2(y)))


class _Join(nn.Module):
    """Upsample, put beside the skip connection, convolve."""

    def __init__(self, below: int, skip: int, outputs: int, norm: str) -> None:
        super().__init__()
        self.conv = nn.Conv2d(below + skip, outputs, 3, 1, 1, bias=False)
        self.norm = normalisation(norm, outputs)

    def forward(self, below: Tensor, skip: Tensor) -> Tensor:
        below = F.interpolate(below, size=skip.shape[-2:], mode="bilinear", align_corners=False)
        return F.relu(self.norm(self.conv(torch.cat([below, skip], 1))))


class TinyUNet(nn.Module):
    """(B, inputs, H, W) -> features (B, channels, H/2, W/2) for `head`, H and W multiples of `multiple`."""

    multiple = 32

    def __init__(self, inputs: int, outputs: int, width: int = 16, norm: str = "group") -> None:
        super().__init__()
        widths = [width * w for w in WIDTHS]
        self.stem = nn.Sequential(
            nn.Conv2d(inputs, widths[0], 3, 2, 1, bias=False), normalisation(norm, widths[0]), nn.ReLU()
        )
        self.encoder = nn.ModuleList(
            [_Residual(widths[0], widths[0], norm)] + [_Residual(a, b, norm, stride=2) for a, b in pairwise(widths)]
        )
        self.decoder = nn.ModuleList([_Join(b, a, a, norm) for a, b in zip(widths[-2::-1], widths[:0:-1], strict=True)])
        self.channels = widths[0]
        self.head = nn.Conv2d(self.channels, outputs, 3, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        skips = [self.stem(x)]
        for block in self.encoder:
            skips.append(block(skips[-1]))
        x = skips[-1]
        for join, skip in zip(self.decoder, skips[-2:0:-1], strict=True):
            x = join(x, skip)
        return x
