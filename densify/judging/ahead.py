"""Agreement with the map ahead: a live surface held against points that the map measures only later.

A keyframe brings points that no keyframe before it observed. The last aligned one has seen the wall there and said how
far it is, before these points could bend it: the share by which it is off, seen from there, is asked four ways
(densify.judging.columns). No truth, and no second look: the map's own drift is in points and surface alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from densify.judging.columns import WAYS, Columns
from densify.judging.verdict import Verdict, ahead_verdict
from densify.judging.withheld import Withheld

_DELIVERED = len(WAYS)
NOTHING = np.zeros((0, _DELIVERED + 1))
"""Errors at no points: a column for each of the four ways, and one for what was fused, bend or scale."""


@dataclass(frozen=True)
class AheadConfig:
    """Whether a live surface is held against the points that come after it."""

    on: bool = True
    """true: the points that a keyframe is the first to observe judge the depth of the last aligned keyframe before it,
    and the run has a verdict. false: it has none, and a keyframe takes up to a tenth less time."""


@dataclass(frozen=True)
class Ahead:
    """What new points of a submap say of the depth that was there before them."""

    columns: Columns
    """the four ways at the same points"""
    delivered: Withheld | None
    """by what was fused of each keyframe, its bend or one scale; None where no point was new"""
    keyframes: int
    """number of keyframes that came"""
    aligned: int
    """number of those that were aligned"""

    @classmethod
    def of(cls, errors: Sequence[np.ndarray], keyframes: int, aligned: int) -> Ahead:
        """Of errors (n, 5) of keyframes, as AheadJudge gives them."""
        together = np.concatenate([NOTHING, *errors])
        of_ways = Columns.of([together[:, :_DELIVERED]])
        return cls(of_ways, Withheld.of_errors(together[:, _DELIVERED]), keyframes, aligned)

    @property
    def number(self) -> float:
        """The median share by which the fused depth is off."""
        return float("inf") if self.delivered is None else self.delivered.median

    @property
    def verdict(self) -> Verdict:
        return ahead_verdict(self.columns, self.number, self.keyframes, self.aligned)

    def record(self) -> dict[str, object]:
        """For run.json."""
        delivered = None if self.delivered is None else self.delivered.record()
        return {"new_points": self.columns.record(), "delivered": delivered}


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
