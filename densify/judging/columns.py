"""Four ways to one keyframe's distance, side by side, and how far each is from distances that it was not fitted to.

The prediction and a constant distance get the same help: one scale each, or a bend. Errors are shares |d - a| / a of
the measured distance a, at single keyframes, before any of them is trusted or fused: so the constant is not refused
where the prediction is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from densify.agreement import AgreementConfig, View, agree
from densify.alignment import AlignmentConfig, align
from densify.bending import Bend, BendingConfig
from lightdepth.blocks import hidden_in_turn
from lightdepth.observations import ObservedDistances

WAYS = ("one_scale", "bent", "constant_one_scale", "constant_bent")


@dataclass(frozen=True)
class Columns:
    """The median error of each way at the same distances, as a share; NaN where there is none."""

    count: int
    """number of distances"""
    one_scale: float
    """the prediction, with one scale for each keyframe"""
    bent: float
    """the prediction, bent"""
    constant_one_scale: float
    """a constant distance, with one scale for each keyframe"""
    constant_bent: float
    """a constant distance, bent"""

    @classmethod
    def of(cls, errors: Sequence[np.ndarray]) -> Columns:
        """Of errors (n, 4) of several keyframes; rows that were not judged are NaN."""
        together = np.concatenate([np.zeros((0, len(WAYS))), *errors])
        together = together[np.isfinite(together).all(1)]
        if not len(together):
            return cls(0, *[float("nan")] * len(WAYS))
        return cls(len(together), *(float(v) for v in np.median(together, axis=0)))

    @property
    def best(self) -> float:
        """The smaller error of the prediction's two ways."""
        return min(self.one_scale, self.bent)

    @property
    def constant(self) -> float:
        """The smaller error of the constant's two ways."""
        return min(self.constant_one_scale, self.constant_bent)

    def record(self) -> dict[str, float | int | None]:
        """For run.json; what is not known is null."""
        told = {way: getattr(self, way) for way in WAYS}
        return {"count": self.count, **{way: v if np.isfinite(v) else None for way, v in told.items()}}


@dataclass(frozen=True)
class Method:
    """How keyframes are aligned, but for their overlap: each is judged alone."""

    alignment: AlignmentConfig
    agreement: AgreementConfig
    bending: BendingConfig


@dataclass(frozen=True)
class FourWays:
    """One keyframe aligned to some points in four ways: two scales and two bends."""

    scale: float
    bend: Bend
    constant_scale: float
    constant_bend: Bend

    @classmethod
    def of(cls, view: View, method: Method) -> FourWays:
        return cls.beside(*_aligned(view, method), view, method)

    @classmethod
    def beside(cls, scale: float, bend: Bend, view: View, method: Method) -> FourWays:
        """A scale and a bend that are known already, and the constant's with the same points."""
        return cls(scale, bend, *_aligned(_constant(view), method))

    def errors(self, at: ObservedDistances) -> np.ndarray:
        """The share (n, 4) by which each way is off at measured distances."""
        result: np.ndarray = np.abs(self.ratios(at) - 1)
        return result

    def ratios(self, at: ObservedDistances) -> np.ndarray:
        """What each way says (n, 4), over the measured distances."""
        level = replace(at, predicted=np.ones(len(at)))
        guesses = [
            self.scale * at.predicted,
            at.predicted * np.exp(self.bend.at(at.pixels, at.predicted)),
            np.full(len(at), self.constant_scale),
            np.exp(self.constant_bend.at(level.pixels, level.predicted)),
        ]
        result: np.ndarray = np.stack(guesses, 1) / at.mapped[:, None]
        return result


def hidden_errors(view: View, fold: np.ndarray, method: Method) -> np.ndarray:
    """Errors (n, 4) as `hidden_ratios` has them."""
    result: np.ndarray = np.abs(hidden_ratios(view, fold, method) - 1)
    return result


def hidden_ratios(view: View, fold: np.ndarray, method: Method) -> np.ndarray:
    """What each way says over the measured distance (n, 4), at every observed point of a keyframe, by an alignment to
    the points of the other folds (n,); NaN where too few are left to align to, and in folds below 0, which are never
    hidden."""
    o = view.observed
    ratios = np.full((len(o), len(WAYS)), np.nan)
    for hidden, others in hidden_in_turn(fold):
        if others.sum() >= method.alignment.min_points:
            used = replace(view, observed=o.subset(others))
            ratios[hidden] = FourWays.of(used, method).ratios(o.subset(hidden))
    return ratios


def _aligned(view: View, method: Method) -> tuple[float, Bend]:
    """One scale, and a bend, whether or not they deserve trust."""
    scale = align(view.keyframe.name, view.observed, method.alignment).scale
    on = method.agreement if method.agreement.overlap == 0 else replace(method.agreement, overlap=0.0)
    return scale, agree([replace(view, scale=scale)], np.zeros((1, 1)), on, method.bending)[0]


def _constant(view: View) -> View:
    """The same view, predicted to be equally far everywhere."""
    level = replace(view.observed, predicted=np.ones(len(view.observed)))
    return replace(view, observed=level, log_distance=np.zeros_like(view.log_distance))
