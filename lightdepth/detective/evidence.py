"""How well a reading fits, and whether another fits better: medians over points, then over keyframes.

Points of one keyframe err together, so keyframes are what is counted; the points only have to agree with them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

LEAST_POINTS = 30
"""Sightings from which a reading can be judged."""
_OF_A_KEYFRAME = 5  # of them, from which it has a say
_SIGMAS = 3.0
CLEAR = 0.02
"""Gain of the NCC from which another reading counts as clearly better. Right readings of real maps lose at least .008
by any other, and those with keypoints 2 px off gain .01 at most."""
_SHARPER = 0.05  # gain of the corners' logarithm; right readings lose by any other, but .02 by half a pixel
_FITS = 0.5  # NCC, below which a reading is not right, however much better it is
_MOST_KEYFRAMES = 0.75  # of the keyframes, that have to agree


class Seen(Protocol):
    """Sightings: rows (n, k) of the k keyframes that have a say in each."""

    @property
    def rows(self) -> np.ndarray: ...


@dataclass(frozen=True)
class Fit:
    """How well one reading fits, and how it compares with the one at hand."""

    reading: str
    likeness: float
    """median NCC over the points"""
    keyframes: int
    """that were compared, or for the reading at hand that have a say"""
    gain: float = 0.0
    """of the NCC over the reading at hand: the median over keyframes"""
    better: float = 0.0
    """share of the keyframes in which it fits better"""
    sure: float = 0.0
    """by how many deviations more or fewer than half of the points say so"""
    corners: Fit | None = None
    """the same of how much of a corner the pixels are at which the map's keypoints lie; None where it was not asked"""

    @property
    def wins(self) -> bool:
        """Whether it fits clearly better than the reading at hand, or as well and keypoints are clearly more of
        corners by it; not where they are clearly less."""
        by_corners = self.corners is not None and self.corners.gain >= _SHARPER and self.corners.agreed
        alike = self.gain >= CLEAR and self.agreed and not (self.corners is not None and self.corners.loses)
        return (alike or (by_corners and not self.loses)) and self.keyframes >= 3 and self.likeness >= _FITS

    @property
    def rivals(self) -> bool:
        """Whether it fits better, but too little or in too few keyframes to say that it is right."""
        corners = self.corners
        alike = self.gain >= CLEAR / 2 and self.agreed and not (corners is not None and corners.loses)
        by_corners = corners is not None and corners.gain >= _SHARPER / 2 and corners.agreed and not self.loses
        return (alike or by_corners) and not self.wins

    @property
    def loses(self) -> bool:
        """Whether the reading at hand fits better for sure."""
        if self.corners is not None and self.corners.loses and self.gain < CLEAR / 2:
            return True
        return self.gain < 0 and self.better <= 1 - _MOST_KEYFRAMES and self.sure <= -_SIGMAS

    @property
    def agreed(self) -> bool:
        """Whether enough of keyframes and points say so."""
        return self.better >= _MOST_KEYFRAMES and self.sure >= _SIGMAS

    def record(self) -> dict[str, object]:
        """As run.json holds it."""
        return {
            "reading": self.reading,
            "ncc": self.likeness,
            "keyframes": self.keyframes,
            "gain": self.gain,
            "better_in": self.better,
            "deviations": self.sure,
            "gain_of_corners": None if self.corners is None else self.corners.gain,
        }


def by_keyframe(witnesses: Seen, values: np.ndarray) -> dict[int, float]:
    """Median of values (n,) of the sightings of each keyframe that has enough; NaN is left out."""
    found = {}
    for row in np.unique(witnesses.rows).tolist():
        own = values[(witnesses.rows == row).any(1) & np.isfinite(values)]
        if len(own) >= _OF_A_KEYFRAME:
            found[row] = float(np.median(own))
    return found


def compared(name: str, witnesses: Seen, votes: np.ndarray, at_hand: np.ndarray) -> Fit | None:
    """Another reading's votes (n,) against those at hand, sighting by sighting; None where too few can be compared.
    Sightings that are the same by both have nothing to say, unless nearly all are."""
    difference = votes - at_hand
    if (difference == 0).sum() >= max(LEAST_POINTS, 0.9 * np.isfinite(difference).sum()):
        return Fit(name, float(np.nanmedian(votes)), len(by_keyframe(witnesses, difference)), 0.0, 0.5)
    difference[difference == 0] = np.nan
    usable = np.isfinite(difference)
    gains = by_keyframe(witnesses, difference)
    if len(gains) < 2 or usable.sum() < LEAST_POINTS:
        return None
    return Fit(
        name,
        float(np.median(votes[np.isfinite(votes)])),
        len(gains),
        float(np.median(list(gains.values()))),
        float(np.mean([gain > 0 for gain in gains.values()])),
        float((2 * (difference[usable] > 0).mean() - 1) * np.sqrt(usable.sum())),
    )


def compared_apart(name: str, one: tuple[Seen, np.ndarray], at_hand: tuple[Seen, np.ndarray] | None) -> Fit | None:
    """The same for readings whose sightings are not the same: keyframes of one against all of the other, where it has
    any."""
    others = np.array(list(by_keyframe(*one).values()))
    own = np.array(list(by_keyframe(*at_hand).values())) if at_hand is not None else np.zeros(0)
    if len(others) < 2 or np.isfinite(one[1]).sum() < LEAST_POINTS:
        return None
    if not len(own):
        return Fit(name, float(np.nanmedian(one[1])), len(others))
    more = others[:, None] > own
    return Fit(
        name,
        float(np.nanmedian(one[1])),
        len(others),
        float(np.median(others) - np.median(own)),
        float(more.mean()),
        float((2 * more.mean() - 1) * np.sqrt(3 * len(others) * len(own) / (len(others) + len(own) + 1))),
    )


def told_from_chance(votes: np.ndarray, chance: np.ndarray) -> float:
    """Share of the pairs of a vote (n,) and a patch compared with a wrong one (m,) in which the vote is higher: 1/2
    where the pairing says nothing."""
    votes, chance = votes[np.isfinite(votes)], np.sort(chance[np.isfinite(chance)])
    return float(np.searchsorted(chance, votes).mean() / max(len(chance), 1)) if len(votes) else float("nan")
