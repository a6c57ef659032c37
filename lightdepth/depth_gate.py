"""Whether a frame is fit for depth from the decline of light, without truth; apart from being sharp enough to match.

Depth from light lives on the contrast between near and far tissue. Blur, noise and compression leave that contrast and
do little harm, though they spoil matching; smoke, which lifts the dark parts, and clipping, which cuts the bright ones,
take it away. So one number judges a frame: the ratio of its bright to its dark light,

    c = q90(V^gamma) / q10(V^gamma),

with V = max(R, G, B), blurred by 1.6 % of the height, q the quantiles over the valid pixels. It needs neither a model
nor other frames. The limit was set on twelve colons of lightdepth.tube, spoilt on purpose: it is the largest at which,
by the closed form and the default network together, four fifths of the frames below it err by more than 1.5 times their
error as they were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from lightdepth.frame import Frame, brightest
from lightdepth.ranges import at_least, checked

_ROWS = 128  # at which frames are looked at
_BLUR = 2 / 128  # of the height
_FLOOR = 1 / 255
_WHITE = 0.97
_LEAST_PIXELS = 50
_MUCH = 0.3  # share of white from which clipping is the likelier cause


@dataclass(frozen=True)
@checked
class DepthGate:
    """When a frame is doubted for depth from light."""

    contrast: Annotated[float, at_least(1, up_to=1000)] = 1.3
    """Least ratio of a frame's bright to its dark light (90th to 10th percentile, linear) with which its depth is not
    doubted; smoke and clipping lower it. A larger one doubts more frames; 1 doubts only frames that are black."""

    def doubt(self, frame: Frame) -> str:
        """Why the frame's depth is doubted; empty where it is not."""
        return Lit.of(frame).doubt(self)


@dataclass(frozen=True)
class Lit:
    """How a frame is lit: the ratio c of bright to dark light, 0 where too little can be seen; the share of white
    pixels."""

    contrast: float
    white: float

    @classmethod
    def of(cls, frame: Frame) -> Lit:
        """Of the frame's valid pixels, at 128 rows."""
        height, width = frame.valid.shape
        value: np.ndarray = np.ascontiguousarray(brightest(frame.image), dtype=np.float32)
        inside: np.ndarray = frame.valid.astype(np.float32)
        if height > _ROWS:
            size = max(1, round(width * _ROWS / height)), _ROWS
            weight = cv2.resize(inside, size, interpolation=cv2.INTER_AREA)
            value = cv2.resize(value * inside, size, interpolation=cv2.INTER_AREA) / np.maximum(weight, 1e-6)
            inside = (weight > 0.99).astype(np.float32)
        valid = inside > 0
        if int(valid.sum()) < _LEAST_PIXELS or value[valid].max() <= 2 * _FLOOR:
            return cls(0.0, 0.0)
        white = float((value[valid] >= _WHITE).mean())
        around = [cv2.GaussianBlur(plane, (0, 0), _BLUR * len(plane)) for plane in (value * inside, inside)]
        seen = np.maximum(around[0][valid] / around[1][valid], _FLOOR)
        low, high = np.quantile(seen, (0.1, 0.9))
        return cls(float((high / low) ** frame.light.gamma), white)

    def doubt(self, gate: DepthGate) -> str:
        """Why the depth of such a frame is doubted; empty where it is not."""
        if self.contrast == 0:
            return "it is black, or masked"
        if self.contrast >= gate.contrast:
            return ""
        cause = f"{self.white:.0%} of it is white" if self.white > _MUCH else "as in smoke, or before a flat wall"
        return f"its bright light is only {self.contrast:.2f} times its dark light ({cause})"


def sentence(doubts: Mapping[str, str], frames: int) -> str:
    """A sentence on the frames of a run whose depth is doubted: reasons by name, at least one."""
    name, reason = next(iter(doubts.items()))
    return (
        f"the depth of {len(doubts)} of {frames} frames is doubted, as they have too little contrast of light; the "
        f"first, {name}: {reason}"
    )
