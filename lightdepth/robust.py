"""Least Median of Squares for one scale, and its refinement. Plain arrays in, numbers out.

Notation: a (n,) mapped distances, b (n,) predicted distances, both > 0; s the scale wanted, a ≈ s b; r_k = a_k - s b_k.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Loss = Literal["geman_mcclure", "huber", "cauchy", "tukey"]
HUBER, CAUCHY, TUKEY = 1.345, 2.3849, 4.685
"""Of residuals in units of sigma: where each loss is 95 % efficient on Gaussian noise (Zhang 1997, table 1)."""
_SIGMA_PER_MEDIAN = 1.4826  # of |x|, x normal


@dataclass(frozen=True)
class LMedS:
    """The winning proposal: its scale, the median |residual| it leaves, and which point proposed it."""

    scale: float
    median: float
    proposal: int


def median_rank(n: int) -> int:
    """0-based rank, among all n residuals, the proposer's own (zero) included, of the lower median of the others."""
    return (n - 2) // 2 + 1


def lmeds_scale(mapped: np.ndarray, predicted: np.ndarray, rng: np.random.Generator | None = None) -> LMedS:
    """Scale s, among the proposals mapped/predicted, with the least median of (mapped - s * predicted)^2.

    The median of proposal j is the lower one over all other points k != j. Exact: no proposal is left out and none is
    sampled (Rousseeuw 1984; expected O(n log² n)). A proposal can beat the best median m only if more than half of the
    intervals ((a_k - m) / b_k, (a_k + m) / b_k) contain it, and two sorted lists count that for all proposals at once;
    each round draws a live proposal at random, which in expectation halves the live set. `rng` decides only the order.
    """
    mapped, predicted = np.asarray(mapped, np.float64), np.asarray(predicted, np.float64)
    n = len(mapped)
    assert n >= 2 and len(predicted) == n, (n, len(predicted))
    assert (mapped > 0).all() and (predicted > 0).all(), "distances must be positive"
    rng = np.random.default_rng(0) if rng is None else rng
    rank = median_rank(n)
    proposals = mapped / predicted
    live = np.arange(n)
    best = LMedS(scale=float(proposals[0]), median=np.inf, proposal=0)
    while len(live):
        drawn = int(live[rng.integers(len(live))])
        residuals = np.abs(mapped - proposals[drawn] * predicted)
        residuals[drawn] = 0.0
        median = float(np.partition(residuals, rank)[rank])
        live = live[live != drawn]
        if median < best.median:
            best = LMedS(scale=float(proposals[drawn]), median=median, proposal=drawn)
            below = np.sort((mapped - median) / predicted)
            above = np.sort((mapped + median) / predicted)
            # A proposal's own interval always contains it, just as its own residual always ranks first.
            inside = np.searchsorted(below, proposals[live], "left") - np.searchsorted(above, proposals[live], "right")
            live = live[inside > rank]
    return best


def mad_sigma(residuals: np.ndarray, least: float = 0.0) -> float:
    """Standard deviation of residuals (n,) around 0, from their median size, so that up to half may be wrong; not below
    `least`."""
    return max(_SIGMA_PER_MEDIAN * float(np.median(np.abs(residuals))), least)


def inlier_sigma(median: float, n: int, finite_sample: bool = False) -> float:
    """Standard deviation of the inliers, 1.4826 sqrt(min median of squares).

    `finite_sample` adds Rousseeuw's factor 1 + 5 / (n - 1), which the densification paper leaves out.
    """
    return _SIGMA_PER_MEDIAN * median * (1 + 5 / (n - 1) if finite_sample else 1.0)


def lower_quartile(values: np.ndarray) -> float:
    """numpy.quantile(values, 0.25) of (n,), n > 0, in a twentieth of its time where there are some hundred."""
    at = (len(values) - 1) / 4
    first, second = int(at), min(int(at) + 1, len(values) - 1)
    ordered = np.partition(values, (first, second))
    return float(ordered[first] + (ordered[second] - ordered[first]) * (at - first))


def robust_weights(x: np.ndarray, loss: Loss = "geman_mcclure") -> np.ndarray:
    """rho'(x) / x of residuals x in units of sigma, 1 at x = 0.

    geman_mcclure: rho = x² / (1 + x²) / 2 · huber: x² / 2 up to 1.345, linear beyond · cauchy: c² log(1 + x² / c²) / 2
    with c 2.3849 · tukey: c² (1 - (1 - x² / c²)³) / 6 up to c 4.685, constant beyond.
    """
    match loss:
        case "geman_mcclure":
            return 1 / (1 + x**2) ** 2
        case "huber":
            result: np.ndarray = HUBER / np.maximum(np.abs(x), HUBER)
            return result
        case "cauchy":
            return 1 / (1 + (x / CAUCHY) ** 2)
        case "tukey":
            return np.clip(1 - (x / TUKEY) ** 2, 0, None) ** 2
    raise ValueError(f"loss {loss!r}; expected geman_mcclure, huber, cauchy or tukey")


def refine_scale(
    mapped: np.ndarray,
    predicted: np.ndarray,
    scale: float,
    sigma: float,
    iterations: int = 20,
    loss: Loss = "geman_mcclure",
) -> float:
    """argmin over s of sum rho(r_k / sigma), from `scale` by reweighting: weights rho'(x) / x of `loss`."""
    mapped, predicted = np.asarray(mapped, np.float64), np.asarray(predicted, np.float64)
    sigma = max(sigma, 1e-12 * float(np.abs(mapped).max(initial=1.0)))
    for _ in range(iterations):
        weights = robust_weights((mapped - scale * predicted) / sigma, loss)
        if not weights.any():
            break  # Tukey sees no point within its reach: the start is all there is
        previous, scale = scale, float((weights * mapped * predicted).sum() / (weights * predicted**2).sum())
        if abs(scale - previous) <= 1e-12 * abs(scale):
            break
    return scale
