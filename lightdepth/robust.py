"""Least Median of Squares for one scale, and its refinement. Plain arrays in, numbers out.

Notation: a (n,) mapped distances, b (n,) predicted distances, both > 0; s the scale wanted, a ≈ s b; r_k = a_k - s b_k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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


def inlier_sigma(median: float, n: int, finite_sample: bool = False) -> float:
    """Standard deviation of the inliers, 1.4826 sqrt(min median of squares).

    `finite_sample` adds Rousseeuw's factor 1 + 5 / (n - 1), which the densification paper leaves out.
    """
    return 1.4826 * median * (1 + 5 / (n - 1) if finite_sample else 1.0)


def refine_scale(mapped: np.ndarray, predicted: np.ndarray, scale: float, sigma: float, iterations: int = 20) -> float:
    """argmin over s of sum rho(r_k / sigma), Geman-McClure's rho(x) = x² / (1 + x²), from `scale` by reweighting."""
    mapped, predicted = np.asarray(mapped, np.float64), np.asarray(predicted, np.float64)
    sigma = max(sigma, 1e-12 * float(np.abs(mapped).max(initial=1.0)))
    for _ in range(iterations):
        weights = 1 / (1 + ((mapped - scale * predicted) / sigma) ** 2) ** 2
        previous, scale = scale, float((weights * mapped * predicted).sum() / (weights * predicted**2).sum())
        if abs(scale - previous) <= 1e-12 * abs(scale):
            break
    return scale
