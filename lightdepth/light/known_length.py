"""The scales of maps weighed with a length that somebody knows in one of them.

Notation: x (k,) logarithms of the scales that the light tells, C (k, k) their covariance. A length in map a says that
x_a is y, with deviation e. With the gain G = C_a / (C_aa + e²), C_a being column a,

    x' = x + G (y - x_a),    C' = C - G C_aᵀ.

So a map whose scale errs together with that of a, by the reflectance that both share, is moved along with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lightdepth.errors import InputError
from lightdepth.light.millimetres import Millimetres, Together

_APART = 3.0  # deviations from which length and light contradict each other
LENGTH, BOTH = "a known length", "the light and a known length"


@dataclass(frozen=True)
class KnownLength:
    """A length of so many map units in a map (its place among all), and the millimetres that it has, with their
    standard error."""

    map: int
    units: float
    mm: float
    error_mm: float

    def __post_init__(self) -> None:
        if not (self.units > 0 and np.isfinite(self.units)):
            raise InputError("the known length", f"{self.units:g} map units", "give two places that lie apart")
        if not (self.mm > 0 and self.error_mm > 0 and np.isfinite([self.mm, self.error_mm]).all()):
            found = f"{self.mm:g} mm, error {self.error_mm:g} mm"
            raise InputError("the known length", found, "expected numbers above 0")
        if self.error_mm >= self.mm:
            found = f"{self.mm:g} mm, with a standard error of {self.error_mm:g} mm"
            raise InputError("the known length", found, "expected an error below the length, or it tells nothing")

    @property
    def mm_per_unit(self) -> float:
        return self.mm / self.units

    @property
    def deviation(self) -> float:
        """of the scale's logarithm"""
        return self.error_mm / self.mm

    def alone(self, like: Millimetres) -> Millimetres:
        """What the length tells by itself of its map, of which the light told something else or nothing, with the
        reason for that."""
        alone = replace(like, mm_per_unit=self.mm_per_unit, deviation=self.deviation, refused="", by=LENGTH)
        return replace(alone, light_refused=like.refused)


def weighed(found: Together, known: KnownLength) -> Together:
    """The scales with the length. Where both contradict each other the light is not believed, in any map."""
    own = found.maps[known.map]
    if own.refused:
        return _with_length_alone(found.maps, known)
    rows = [i for i, one in enumerate(found.maps) if not one.refused]
    a, told = rows.index(known.map), [found.maps[i] for i in rows]
    covariance = found.covariance[np.ix_(rows, rows)]
    deviation = float(np.sqrt(covariance[a, a] + known.deviation**2))
    apart = float(np.log(known.mm_per_unit / own.mm_per_unit)) / deviation
    if abs(apart) > _APART:
        times = known.mm_per_unit / own.mm_per_unit
        why = f"the light contradicts the known length, by which units are {times:.2f} times as large"
        return _with_length_alone([one if one.refused else replace(one, refused=why) for one in found.maps], known)
    gain = covariance[:, a] / deviation**2
    logs = np.log([one.mm_per_unit for one in told]) + gain * apart * deviation
    after = covariance - np.outer(gain, covariance[a])
    maps, whole = list(found.maps), found.covariance.copy()
    whole[np.ix_(rows, rows)] = after
    for i, one, log, variance in zip(rows, told, logs, np.diag(after), strict=True):
        maps[i] = replace(one, mm_per_unit=float(np.exp(log)), deviation=float(np.sqrt(variance)), by=BOTH)
    return Together(tuple(maps), whole)


def _with_length_alone(maps: Sequence[Millimetres], known: KnownLength) -> Together:
    covariance = np.diag([np.inf if one.refused else one.deviation**2 for one in maps])
    covariance[known.map, known.map] = known.deviation**2
    return Together(tuple(known.alone(one) if i == known.map else one for i, one in enumerate(maps)), covariance)
