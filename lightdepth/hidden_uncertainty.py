"""A predicted uncertainty held against points of a map that were hidden from the alignment, where there is no truth.

Notation: e = log(aligned / mapped) distance at a hidden point, sigma the predicted standard deviation of log distance,
n that of the map's own error. Calibrated is f sigma, with the factor f by which

    |e| <= z(level) sqrt(f² sigma² + n²)

holds for the stated shares of points, z the normal quantile. n comes from neighbours: points that lie side by side in
one image share the model's error, which is smooth, and what they differ by is the map's. Its size is that of these
differences; how it is spread among points, what their pixels leave open (lightdepth.triangulation). Points that stick
out from those around them are wrong ones, and left out. Errors that neighbouring points share stay in e, and make f
too large; a model that errs from pixel to pixel counts as noise of the map, and makes it too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel
from scipy.spatial import cKDTree
from scipy.special import ndtri

from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.robust import mad_sigma

LEVELS = (0.5, 0.68, 0.9)
"""Shares of points that intervals are stated for."""
FILE = "uncertainty.json"

_Z = ndtri((1 + np.asarray(LEVELS)) / 2)
_FACTORS = np.exp(np.linspace(np.log(0.05), np.log(20), 601))  # steps of 1 %
_BESIDE, _AROUND, _NEIGHBOURS = 0.05, 0.1, 6  # in widths of the image
_STICKS_OUT = 4.0  # deviations
_LEAST_POINTS, _LEAST_PAIRS = 200, 100
_FAR_OFF = 0.1


@dataclass(frozen=True, eq=False)
class HiddenErrors:
    """One keyframe's hidden points, (n,) each: e, sigma, how the map's error is spread among them (in any unit, NaN
    where nothing tells), and their fold; and where they are in the image (n, 2), in widths of it."""

    error: np.ndarray
    sigma: np.ndarray
    spread: np.ndarray
    fold: np.ndarray
    place: np.ndarray


@dataclass(frozen=True)
class HiddenCalibration:
    """A predicted uncertainty as hidden points have it. Shares are those of points inside the intervals of LEVELS."""

    factor: float
    """what the uncertainty is to be multiplied by"""
    points: int
    """number of points that it rests on"""
    noise: float
    """median of n, the map's own error that is taken out, in log distance"""
    before: tuple[float, ...]
    """shares as predicted, the map's own error taken out"""
    after: tuple[float, ...]
    """shares with the factor that the other folds say"""
    reason: str = ""
    """why it is not to be used; empty where it is"""

    @property
    def ok(self) -> bool:
        return not self.reason

    def record(self) -> dict[str, object]:
        """For run.json."""
        return asdict(self)

    def __str__(self) -> str:
        if not self.ok:
            return f"not calibrated: {self.reason}"
        shares = f"{self.before[1]:.0%} of hidden points within the 68 % interval before, {self.after[1]:.0%} after"
        own = f"the map's own {self.noise:.1%} taken out, what its points err by together not"
        return f"calibrated on hidden blocks of this map (factor {self.factor:.2f}; {shares}; {own})"


def calibrated(keyframes: Sequence[HiddenErrors]) -> HiddenCalibration:
    """The factor on a predicted uncertainty, from hidden points of keyframes, or the reason why there is none."""
    every = sum(len(k.error) for k in keyframes)
    differences = [_differences(k) for k in keyframes]
    pairs = np.concatenate([np.zeros((0, 2)), *differences])
    if every < _LEAST_POINTS or len(pairs) < _LEAST_PAIRS:
        few = f"{every} hidden points, {len(pairs)} of them beside another; at least {_LEAST_POINTS} and {_LEAST_PAIRS}"
        return HiddenCalibration(1.0, every, 0.0, (), (), few)
    flat, size = (mad_sigma(pairs[:, column]) for column in (0, 1))
    kept = [_without_wrong(k, size, flat) for k in keyframes]
    needed = np.concatenate([_needed(k, size) for k in kept])
    fold = np.concatenate([k.fold for k in kept])
    noise = float(np.median(np.concatenate([size * _filled(k.spread) for k in kept])))
    after = np.zeros(len(LEVELS))
    for hidden in np.unique(fold):
        rows = fold == hidden
        others = _factor(needed[~rows]) if not rows.all() else 1.0
        after += (needed[rows] <= others).sum(0) / len(fold)
    factor = _factor(needed)
    before = (needed <= 1).mean(0)
    reason = ""
    if ((needed <= _FACTORS[0]).mean(0) >= LEVELS).all():
        reason = "the map's own error explains what hidden points are off by, and leaves nothing for the model's"
    elif np.abs(after - LEVELS).max() > _FAR_OFF:
        found = ", ".join(f"{share:.0%}" for share in after)
        reason = f"with the factor of the other blocks, intervals for 50, 68 and 90 % of points hold {found}"
    return HiddenCalibration(factor, len(fold), noise, tuple(map(float, before)), tuple(map(float, after)), reason)


def _differences(k: HiddenErrors) -> np.ndarray:
    """Differences (n, 2) of e between each point and the nearest one of its fold: over sqrt(2), and over the root sum
    of squares of both spreads."""
    spread, found = _filled(k.spread), []
    for fold in np.unique(k.fold):
        rows = np.flatnonzero(k.fold == fold)
        if len(rows) > 1:
            apart, beside = cKDTree(k.place[rows]).query(k.place[rows], 2)
            near = apart[:, 1] < _BESIDE
            one, other = rows[near], rows[beside[near, 1]]
            gap = k.error[one] - k.error[other]
            found.append(np.stack([gap / np.sqrt(2), gap / np.hypot(spread[one], spread[other])], 1))
    return np.concatenate([np.zeros((0, 2)), *found])


def _filled(spread: np.ndarray) -> np.ndarray:
    """Spreads (n,), a usual one where nothing tells."""
    known = spread[np.isfinite(spread) & (spread > 0)]
    usual = float(np.median(known)) if len(known) else 1.0
    return np.where(np.isfinite(spread) & (spread > 0), spread, usual)


def _without_wrong(k: HiddenErrors, size: float, flat: float) -> HiddenErrors:
    """The same without the points whose error sticks out from the median of those of its fold around it."""
    middle = np.full(len(k.error), np.nan)
    for fold in np.unique(k.fold):
        rows = np.flatnonzero(k.fold == fold)
        if len(rows) > _NEIGHBOURS:
            apart, around = cKDTree(k.place[rows]).query(k.place[rows], _NEIGHBOURS + 1)
            near, errors = apart[:, 1:] < _AROUND, k.error[rows[around[:, 1:]]]
            # numpy.nanmedian takes a hundred times as long.
            ordered, count = np.sort(np.where(near, errors, np.inf), axis=1), near.sum(1)
            low, high = (np.take_along_axis(ordered, (m // 2)[:, None], 1)[:, 0] for m in (count - 1, count))
            middle[rows] = np.where(count >= 2, (low + high) / 2, np.nan)
    usual = np.maximum(size * _filled(k.spread), flat)
    stays = ~(np.abs(k.error - middle) > _STICKS_OUT * usual)
    return HiddenErrors(*(getattr(k, name)[stays] for name in HiddenErrors.__dataclass_fields__))


def _needed(k: HiddenErrors, size: float) -> np.ndarray:
    """The factor (n, 3) from which on each point is inside the interval of each level."""
    noise = size * _filled(k.spread)
    left = np.maximum((np.abs(k.error)[:, None] / _Z) ** 2 - noise[:, None] ** 2, 0)
    result: np.ndarray = np.sqrt(left) / k.sigma[:, None]
    return result


def _factor(needed: np.ndarray) -> float:
    """The factor whose shares inside are nearest to those that are stated, in least squares."""
    inside = np.stack([np.searchsorted(np.sort(column), _FACTORS, "right") for column in needed.T], 1) / len(needed)
    gap = ((inside - LEVELS) ** 2).sum(1)
    best = np.flatnonzero(gap <= gap.min() + 1e-6)
    return float(np.exp(np.log(_FACTORS[best]).mean()))


class _File(BaseModel):
    checkpoint: str
    factor: float


def read_factor(path: Path, *names: str) -> float:
    """The factor on the uncertainty of a checkpoint, by any of its names, that a run folder, or its uncertainty.json,
    says. Raises InputError where there is none, or it is another checkpoint's."""
    file = path / FILE if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        raise InputError(
            path, "no uncertainty.json in it", "expected a `densify` run whose log says that uncertainty is calibrated"
        )
    found = checked_fields(_File, read_json(file), str(file))
    if found.checkpoint not in names:
        raise InputError(file, f"it was made with the checkpoint {found.checkpoint}", f"expected one of {names[0]}")
    if not (np.isfinite(found.factor) and found.factor > 0):
        raise InputError(file, f"factor: {found.factor}", "expected a positive number")
    return found.factor
