"""What `recipe paper` has that the paper does not state: settings that decide what is left out of the surface.

The paper prints the scale (LMedS), its refinement on inliers and a TSDF. It says neither when a keyframe is not to be
trusted nor how far its depth reaches. Each setting here can be opened until it does nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

from densify.config import DensifyConfig
from lightdepth.ranges import LARGEST

_GATES = {
    "min_points": (1, "a keyframe needs {value} observed points"),
    "min_inliers": (0, "a keyframe needs {value} inliers"),
    "min_inlier_share": (0.0, "{value:.0%} of a keyframe's points must be inliers"),
    "max_relative_sigma": (LARGEST, "sigma is at most {value:.0%} of the points' median distance"),
    "min_spread_deg": (0.0, "inliers spread over {value:g} degrees of the view"),
    "min_distance_spread": (0.0, "log distances of inliers spread by {value:g}"),
    "max_second_mode": (LARGEST, "a rival scale has at most {value:.0%} of the points that the chosen one has"),
}
"""Settings of alignment: the value at which they do nothing, and what they ask for."""


@dataclass(frozen=True)
class Addition:
    """One setting that leaves something out."""

    setting: str
    """its option, without dashes before it"""
    value: float
    """what it is set to"""
    asks: str
    """what stays, in words"""
    nothing: float
    """the value at which nothing is left out"""

    def __str__(self) -> str:
        return f"{self.asks} (--{self.setting.replace('_', '-')} {self.nothing:g} leaves that out)"


def additions(config: DensifyConfig) -> tuple[Addition, ...]:
    """What is added to the paper by these settings; nothing under another recipe, which is not the paper's at all."""
    if config.recipe != "paper":
        return ()
    found = []
    for name, (nothing, asks) in _GATES.items():
        value = getattr(config.alignment, name)
        if value != nothing:
            found.append(Addition(f"alignment.{name}", value, asks.format(value=value), nothing))
    far = config.fusion.far
    if far < LARGEST:
        asks = f"depth is fused up to {far:g} times the distance within which 90 % of a keyframe's inliers lie"
        found.append(Addition("fusion.far", far, asks, LARGEST))
    return tuple(found)


def said(added: tuple[Addition, ...]) -> str:
    """One sentence for log and report."""
    if not added:
        return "Recipe paper, with nothing added to what is published: no keyframe and no distance is left out"
    return "Recipe paper, with what the published one is not known to have: " + "; ".join(map(str, added))
