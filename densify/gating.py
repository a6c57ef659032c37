"""Which keyframes are doubted because light says little of their depth (lightdepth.depth_gate), and what follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from lightdepth.depth_gate import DepthGate
from lightdepth.frame import Frame
from lightdepth.ranges import at_least, checked

LEFT_OUT = "its depth is doubted"
"""Begins the reason of a keyframe that is left out for that."""


@dataclass(frozen=True)
@checked
class GateConfig:
    """Which keyframes are doubted for depth, and what becomes of them."""

    on: bool = False
    """Whether keyframes with doubtful depth are left out of the surface, unless they are more than half of a submap's.
    It helps where smoke or clipping spoils many. Switched off, they are fused like others, and only named. The recipe
    paper leaves none out."""
    contrast: Annotated[float, at_least(1, up_to=1000)] = DepthGate.contrast
    """Ratio of a keyframe's bright to its dark light (90th to 10th percentile, linear) below which its depth is
    doubtful; smoke and clipping lower it. A larger one doubts more keyframes."""

    def doubt(self, frame: Frame | None) -> str:
        """Why a keyframe's depth is doubted; empty where it is not, or its image is not there."""
        return "" if frame is None else DepthGate(self.contrast).doubt(frame)
