"""How far a predicted uncertainty can be trusted: sparsification, coverage, and the calibration that mends both ends.

Notation: e error of log distance once the frame's scale is taken out, sigma its predicted standard deviation, both (n,)
over the valid pixels of one frame.

Sparsification (Ilg et al., ECCV 2018): the mean (or RMS) |e| that is left when the most uncertain pixels are dropped,
as a curve over the share dropped; its area above the curve of the best order there is, |e| itself, is the
sparsification error. Dropping at random leaves the mean as it is. Coverage: the share of pixels with |e| <= z sigma, z
the normal quantile.

Calibration: sigma' = s sigma^k, with k of the greatest normal likelihood and s of the coverage that is meant.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import ndtri

from lightdepth.reporting import figures

LEVELS = (0.5, 0.68, 0.9, 0.95)
"""Shares of pixels that intervals are stated for."""

_DROPPED = np.arange(20) / 20


@dataclass(frozen=True)
class Doubted:
    """One frame's errors and what was predicted of them, (n,) float64 each; sigma > 0."""

    error: np.ndarray
    sigma: np.ndarray

    def __post_init__(self) -> None:
        assert self.error.shape == self.sigma.shape and self.error.ndim == 1, (self.error.shape, self.sigma.shape)
        assert len(self.error) and (self.sigma > 0).all(), "empty, or a standard deviation of 0"


@dataclass(frozen=True)
class Sparsification:
    """Mean or RMS of e over what is left when the shares `dropped` are gone: by sigma, by |e|, at random. (m,) each."""

    dropped: np.ndarray
    predicted: np.ndarray
    best: np.ndarray
    random: np.ndarray

    @property
    def area(self) -> float:
        """Area between the predicted curve and the best one (AUSE)."""
        return float((self.predicted - self.best).mean())

    @property
    def relative(self) -> float:
        """`area` over that of a random order: 0 knows each pixel's error, 1 knows nothing."""
        random = float((self.random - self.best).mean())
        return self.area / random if random > 0 else 1.0


def doubted(
    distance: np.ndarray, sigma: np.ndarray, true_distance: np.ndarray, valid: np.ndarray, log: bool = True
) -> Doubted | None:
    """The valid pixels of a frame, (H, W) arrays; the scale is the median log ratio. None when there are no pixels.

    Errors are those of log distance, as sigma is; or with log false of distance, in the truth's unit, where sigma is
    that share of the distance.
    """
    valid = valid & (true_distance > 0) & np.isfinite(true_distance) & (distance > 0) & (sigma > 0)
    if not valid.any():
        return None
    found, true, doubt = (values[valid].astype(np.float64) for values in (distance, true_distance, sigma))
    error = np.log(found / true)
    scale = np.exp(-np.median(error))
    if log:
        return Doubted(error + np.log(scale), doubt)
    return Doubted(scale * found - true, doubt * scale * found)


def sparsification(frames: Iterable[Doubted], power: int = 1) -> Sparsification:
    """Curves averaged over frames, of the mean |e| (power 1) or the RMS (power 2). Raises ValueError without frames."""
    curves = []
    for frame in frames:
        size = np.abs(frame.error) ** power
        kept = len(size) - (len(size) * _DROPPED).astype(int)

        def left(order: np.ndarray, size: np.ndarray = size, kept: np.ndarray = kept) -> np.ndarray:
            result: np.ndarray = (np.cumsum(size[order]) / np.arange(1, len(size) + 1))[kept - 1] ** (1 / power)
            return result

        flat = np.full(len(kept), size.mean() ** (1 / power))
        curves.append((left(np.argsort(frame.sigma, kind="stable")), left(np.argsort(size)), flat))
    if not curves:
        raise ValueError("no frame with truth")
    return Sparsification(_DROPPED, *np.mean(curves, axis=0))


def coverage(frames: Sequence[Doubted], levels: Sequence[float] | np.ndarray = LEVELS) -> np.ndarray:
    """Share of pixels inside the central normal interval of each level, mean over frames (len(levels),)."""
    factors = ndtri((1 + np.asarray(levels)) / 2)
    result: np.ndarray = np.mean(
        [(np.abs(f.error)[:, None] <= factors * f.sigma[:, None]).mean(0) for f in frames], axis=0
    )
    return result


@dataclass(frozen=True)
class Calibration:
    """sigma' = scale · sigma^exponent."""

    exponent: float = 1.0
    scale: float = 1.0

    def __call__(self, sigma: np.ndarray) -> np.ndarray:
        return self.scale * sigma**self.exponent


def fit_calibration(frames: Sequence[Doubted]) -> Calibration:
    """The exponent with the greatest normal likelihood, the scale with the least squared gap in coverage over LEVELS.

    Every frame counts the same. The likelihood would set the scale by the few largest errors; coverage is what an
    interval promises. Raises ValueError without frames.
    """
    if not frames:
        raise ValueError("no frame with truth")

    def cost(exponent: float) -> float:
        # With the best scale for this exponent, a normal density's log likelihood is -log s - exponent mean(log sigma).
        square = np.mean([np.mean((f.error / f.sigma**exponent) ** 2) for f in frames])
        return float(0.5 * np.log(max(square, 1e-300)) + exponent * np.mean([np.log(f.sigma).mean() for f in frames]))

    exponent = float(minimize_scalar(cost, bounds=(0.1, 4.0), method="bounded").x)
    ratio = [np.abs(f.error) / f.sigma**exponent for f in frames]
    factors = ndtri((1 + np.asarray(LEVELS)) / 2)

    def gap(log_scale: float) -> float:
        covered = np.mean([(r[:, None] <= factors * np.exp(log_scale)).mean(0) for r in ratio], axis=0)
        return float(((covered - LEVELS) ** 2).sum())

    middle = float(np.log(max(np.mean([np.quantile(r, 0.68) for r in ratio]), 1e-12)))
    log_scale = min(np.linspace(middle - 1, middle + 1, 401), key=gap)  # steps of 0.5 %; coverage is no smooth function
    return Calibration(exponent, float(np.exp(log_scale)))


def chart_png(frames: Sequence[Doubted]) -> bytes:
    """Sparsification curves and, beside them, stated against found coverage, as a PNG."""
    curves = sparsification(frames)
    figure, axes = figures.chart((8.4, 3.2))
    axes.remove()
    left, right = figure.subplots(1, 2)
    for values, label, style in (
        (curves.random, "at random", ":"),
        (curves.predicted, f"by predicted uncertainty ({curves.relative:.2f} of random)", "-"),
        (curves.best, "by true error", "--"),
    ):
        left.plot(100 * curves.dropped, 100 * values, style, label=label)
    left.set(xlabel="most uncertain pixels dropped [%]", ylabel="mean |error| of log distance left [%]")
    left.set_ylim(0, 140 * curves.random[0])
    left.legend(frameon=False, fontsize=8, loc="upper right")
    stated = np.linspace(0.05, 0.99, 20)
    right.plot([0, 100], [0, 100], ":", color="grey")
    right.plot(100 * stated, 100 * coverage(frames, stated), "-")
    right.plot(100 * np.asarray(LEVELS), 100 * coverage(frames), "o")
    right.set(xlabel="stated coverage [%]", ylabel="pixels inside [%]")
    for side in (left, right):
        side.spines[["top", "right"]].set_visible(False)
    return figures.chart_png(figure)


def summary(frames: Sequence[Doubted]) -> dict[str, Any]:
    """Relative sparsification errors and coverage, as numbers for a card."""
    found = coverage(frames)
    return {
        "sparsification": {name: round(sparsification(frames, p).relative, 4) for name, p in (("mean", 1), ("rms", 2))},
        "coverage": {f"{level:.0%}": round(float(share), 4) for level, share in zip(LEVELS, found, strict=True)},
        "frames": len(frames),
    }
