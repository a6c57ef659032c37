"""A live surface held against points that the map measures only later and, once it is finished, against the images.

A keyframe brings points that no keyframe before it observed. The last aligned one has seen the wall there and said how
far it is, before these points could bend it: the share by which it is off, seen from there, is asked four ways
(densify.judging.columns). That is no second look: the map's own drift is in points and surface alike. So where the
last keyframe of a submap is done, distances by parallax between its images judge the surface as they judge densify's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from densify.judging.columns import WAYS, Columns
from densify.judging.verdict import Asked, Verdict, ahead_verdict, spoke
from densify.judging.withheld import Withheld
from lightdepth.parallax import ParallaxConfig

_DELIVERED = len(WAYS)
NOTHING = np.zeros((0, _DELIVERED + 1))
"""Errors at no points: a column for each of the four ways, and one for what was fused, bend or scale."""


@dataclass(frozen=True)
class AheadConfig:
    """How a live surface is judged: by the points that come after it and, when it is finished, by the images."""

    on: bool = True
    """true: the points that a keyframe is the first to observe judge the depth of the last aligned keyframe before it,
    and the run has a verdict. false: it has none, and a keyframe takes up to a tenth less time."""
    parallax: ParallaxConfig = field(default_factory=ParallaxConfig)
    """how distances are measured between the images of keyframes, after the last one of a submap
    (--judge.parallax.on false leaves them out; nothing is then green)"""


@dataclass(frozen=True)
class Ahead:
    """What new points of a submap say of the depth that was there before them, and the images of its surface."""

    columns: Columns
    """the four ways at the same points"""
    delivered: Withheld | None
    """by what was fused of each keyframe, its bend or one scale; None where no point was new"""
    keyframes: int
    """number of keyframes that came"""
    aligned: int
    """number of those that were aligned"""
    surface: Withheld | None = None
    """the finished surface against distances by parallax; None where the images are silent or were not asked"""
    seen_well: float | None = None
    """share of the finished surface's wall that was seen well; None where there is no surface"""

    @classmethod
    def of(cls, errors: Sequence[np.ndarray], keyframes: int, aligned: int, surface: Withheld | None = None) -> Ahead:
        """Of errors (n, 5) of keyframes, as AheadJudge gives them."""
        together = np.concatenate([NOTHING, *errors])
        of_ways = Columns.of([together[:, :_DELIVERED]])
        return cls(of_ways, Withheld.of_errors(together[:, _DELIVERED]), keyframes, aligned, surface)

    @property
    def judge(self) -> Asked:
        """Whose word the number is."""
        return "images" if spoke(self.surface) else "map"

    @property
    def number(self) -> float:
        """The program's own estimate of the surface's error: what the images say, else `by_points`."""
        met = self.surface.median_met if self.judge == "images" and self.surface is not None else self.by_points
        return float("inf") if met is None else met

    @property
    def by_points(self) -> float:
        """The median share by which the fused depth is off at new points."""
        return float("inf") if self.delivered is None else self.delivered.median

    @property
    def verdict(self) -> Verdict:
        found = ahead_verdict(self.columns, self.by_points, self.surface, self.keyframes, self.aligned)
        return replace(found, seen_well=self.seen_well)

    def record(self) -> dict[str, object]:
        """For run.json."""
        delivered, surface = (None if w is None else w.record() for w in (self.delivered, self.surface))
        return {"new_points": self.columns.record(), "delivered": delivered, "surface": surface}


def running(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Medians (k, 2) over all errors (n, 5) up to each of k keyframes, of what was fused and of a constant distance by
    the better of its two ways; NaN before the first new point."""
    found = np.full((len(errors), 2), np.nan)
    together = NOTHING
    for i, new in enumerate(errors):
        together = np.concatenate([together, new])
        if len(together):
            medians = np.median(together, axis=0)
            found[i] = medians[_DELIVERED], medians[2:_DELIVERED].min()
    return found
