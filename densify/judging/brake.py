"""How much of its bend each keyframe keeps: as much as distances speak for that it was not fitted to.

A bend follows the points of the map, and these may err together: a side of the wall that is too far bends every
keyframe that sees it. So the bend is held against distances by parallax. With f what it adds in log distance to one
scale, and r what the images say should be added, the share s of the bends that a submap needs is the slope of

    r = s f + noise,

by iterated reweighting. Its variance counts a distance for a quarter, as neighbours share their errors; before any is
seen s is expected to be 1, give or take .5. A keyframe's own share is expected to be its submap's, give or take .1.
Where s is below .3 the bend is undone, as what is left of it is wrong as likely as right; from .85 on all of it stays.

What a finer grid of bumps adds to the bends of a submap is held against the same distances, all keyframes together:
where a map's points are right it is right, where neighbours err together it follows their errors. Where the
images are more than 7 % off without it in the median, as on a map that drifts, none of it is kept.

Where the images are silent, or leave s as unsure as it was, blocks of wall that were hidden from the bend decide
between all of it and none. It must then be better by some, and no larger than its prior lets expect, since blocks
beside the hidden ones may share their error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lightdepth.robust import mad_sigma, robust_weights

_NEIGHBOURS = 4.0
_USUAL, _SPREAD, _APART = 1.0, 0.5, 0.1
_NONE_BELOW, _ALL_FROM = 0.3, 0.85
_NOT_DETAIL = 0.07
_CUT = 0.4
_BORROWED = 100.0
_LEAST = 40
_WIDTH, _LEAST_SIGMA = 2.0, 0.01
_GAIN_BY_MAP = 0.95
_LARGEST = 2.0


@dataclass(frozen=True)
class Tried:
    """One keyframe's bend: errors in log distance (n, 2) by the images with none and all of it, errors as shares (m, 2)
    with none and all of it at hidden blocks, and the size of the bend in deviations of its prior (1 is usual)."""

    by_images: np.ndarray
    by_map: np.ndarray
    size: float


@dataclass(frozen=True)
class Kept:
    """The share of a bend that is kept, and why no more of it is; empty where all is."""

    share: float
    reason: str = ""


def kept_of_finer(by_images: np.ndarray) -> float:
    """The share that a submap keeps of what a finer grid adds to its bends, by errors (n, 2) in log distance by the
    images without it and with it; 0 where they cannot tell, or where more than detail is wrong."""
    errors = by_images[np.isfinite(by_images).all(1)]
    if len(errors) < _LEAST or np.median(np.abs(errors[:, 0])) > _NOT_DETAIL:
        return 0.0
    own = _slope(errors, _USUAL)
    return _rounded(own.value) if own.variance < _SPREAD**2 else 0.0


def kept(tried: Mapping[str, Tried]) -> dict[str, Kept]:
    """What each keyframe keeps of its bend, by name."""
    images = {name: t.by_images[np.isfinite(t.by_images).all(1)] for name, t in tried.items()}
    if sum(map(len, images.values())) >= _LEAST:
        own = _slope(np.concatenate(list(images.values())), _USUAL)
        if own.variance < _SPREAD**2:
            level = own.seen_from(_Share(_USUAL, _SPREAD**2))
            return {name: _by_images(errors, level) for name, errors in images.items()}
    blocks = {name: _squared(t.by_map) for name, t in tried.items()}
    if not sum(map(len, blocks.values())):
        return dict.fromkeys(tried, Kept(0.0, "nothing that it was not fitted to can judge the bend"))
    return {name: _by_blocks(losses[0], losses[1], tried[name].size) for name, losses in _losses(blocks).items()}


@dataclass(frozen=True)
class _Share:
    """A share of a bend, and the variance of what is known of it."""

    value: float
    variance: float

    def seen_from(self, before: _Share) -> _Share:
        """With what was known before."""
        weights = 1 / self.variance, 1 / before.variance
        value = (weights[0] * self.value + weights[1] * before.value) / sum(weights)
        return _Share(value, 1 / sum(weights))


def _slope(errors: np.ndarray, value: float) -> _Share:
    """The share that errors (n, 2) with none and all of a bend speak for; begun at `value`."""
    wanted, added = -errors[:, 0], errors[:, 1] - errors[:, 0]
    variance = np.inf
    for _ in range(10):
        left = wanted - value * added
        weight = robust_weights(left / mad_sigma(left, _LEAST_SIGMA) / _WIDTH) if len(left) else left
        told = float((weight * added**2).sum())
        if told < 1e-9:
            return _Share(value, np.inf)
        value = float((weight * added * wanted).sum()) / told
        variance = _NEIGHBOURS * float(((weight * left * added) ** 2).sum()) / told**2
    return _Share(value, max(variance, 1e-6))


def _by_images(errors: np.ndarray, level: _Share) -> Kept:
    expected = _Share(level.value, level.variance + _APART**2)
    found = _slope(errors, level.value).seen_from(expected).value
    share = _rounded(found)
    if share == 1:
        return Kept(1.0)
    wrong = f"the images support {max(found, 0):.0%} of the bend to the map's points"
    return Kept(share, wrong if share else f"{wrong}, which is as good as none")


def _rounded(share: float) -> float:
    return 0.0 if share < _NONE_BELOW else 1.0 if share >= _ALL_FROM else round(share, 1)


def _by_blocks(none: float, every: float, size: float) -> Kept:
    if size > _LARGEST:
        why = f"the bend is {size:.1f} times as large as is usual, and the images do not tell whether it is right"
        return Kept(0.0, why)
    if every >= _GAIN_BY_MAP**2 * none:
        return Kept(0.0, f"at hidden blocks of wall {_shown(none)} are left with one scale, {_shown(every)} with it")
    return Kept(1.0)


def _losses(squared: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    lent = _BORROWED * np.concatenate(list(squared.values())).mean(0)
    return {name: (of.sum(0) + lent) / (len(of) + _BORROWED) for name, of in squared.items()}


def _squared(errors: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.minimum(errors[np.isfinite(errors).all(1)] ** 2, _CUT**2)
    return result


def _shown(loss: float) -> str:
    return f"{np.sqrt(loss):.1%}"
