"""How well a surface explains points that took no part in the alignment: a judge where there is no truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from densify.dense_map import DenseMap
from lightdepth.observations import ObservedDistances
from lightdepth.sparse_map import Keyframe


@dataclass(frozen=True)
class Withheld:
    """How far withheld points are from the surface along their rays, as shares |surface - point| / point.

    A point whose ray misses the surface counts as infinitely far in `median` and `p90`, so that cropping cannot win.
    Keyframes that were left out are judged too: the surface that the others made should explain what they saw.
    """

    points: int
    """number of withheld points"""
    median: float
    """median share, misses included"""
    p90: float
    """90th percentile of the shares, misses included"""
    miss: float
    """share of the points whose rays miss the surface"""
    median_met: float
    """median share of the points whose rays meet the surface"""

    @classmethod
    def of(cls, dense: DenseMap, withheld: Sequence[tuple[Keyframe, ObservedDistances]]) -> Withheld | None:
        """Of a surface and the points withheld of each keyframe; None when no point was withheld."""
        errors = []
        for keyframe, observed in withheld:
            if len(observed):
                hit = dense.surface.cast(keyframe.center, observed.rays @ keyframe.cam_from_map[:3, :3])
                errors.append(np.abs(hit - observed.mapped) / observed.mapped)
        if not errors:
            return None
        error = np.concatenate(errors)
        met = error[np.isfinite(error)]
        median, p90 = (float(np.quantile(error, q, method="higher")) for q in (0.5, 0.9))
        median_met = float(np.median(met)) if len(met) else np.inf
        return cls(len(error), median, p90, 1 - len(met) / len(error), median_met)
