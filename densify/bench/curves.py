"""Curves in place of one figure: error against coverage, and error by distance.

Coverage in two ways. Of a surface: vertices are dropped from the least trusted on, by the error that is expected of
them or by the number of keyframes that saw them; what is left is more accurate and less complete. Of depth: pixels are
dropped from the most uncertain on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from densify.dense_map import DenseMap
from densify.evaluation.errors import ComparedDepth, TrueSurface, closest, rms
from densify.similarity import Similarity

BANDS_MM = (0.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0)
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
_NEAR_MM = 2.0
_TRUE_POINTS = 20_000


@dataclass(frozen=True)
class Band:
    """Pixels whose true depth is within a band, of all keyframes of a row."""

    from_mm: float
    """true depth from which on a pixel counts"""
    to_mm: float
    """true depth up to which it counts"""
    pixels: int
    """number of pixels"""
    abs_rel: float
    """mean of |p - q| / q"""
    bias: float
    """median of p / q - 1: above 0 where the wall is put too far"""


@dataclass(frozen=True)
class FrontPoint:
    """A surface of which only what is trusted most is kept."""

    by: str
    """what is swept: expected error, or views"""
    threshold: float
    """largest expected error [mm], or least number of views, that is kept"""
    kept_share: float
    """share of the surface's vertices that are kept"""
    rms_mm: float
    """from the kept vertices to the truth"""
    median_mm: float
    """median of the same"""
    precision_2mm: float
    """share of the kept vertices within 2 mm of the truth"""
    recall_2mm: float
    """share of the true points within 2 mm of the kept vertices"""


@dataclass(frozen=True)
class SortedPoint:
    """Pixels of which only what is most certain is kept."""

    kept_share: float
    """share of the pixels that are kept"""
    by_uncertainty: float
    """mean of |p - q| / q over the pixels whose uncertainty is predicted least"""
    by_error: float
    """the same over those that err least: what no uncertainty can beat"""


def bands(ratio: np.ndarray, truth: np.ndarray) -> list[Band]:
    """Errors by true depth q (n,), `ratio` (n,) being p / q; bands without a pixel are left out."""
    found = []
    for low, high in zip(BANDS_MM, BANDS_MM[1:], strict=False):
        own = ratio[(truth >= low) & (truth < high)]
        if len(own):
            found.append(Band(low, high, len(own), float(np.abs(own - 1).mean()), float(np.median(own) - 1)))
    return found


def bands_of(compared: Sequence[ComparedDepth]) -> list[Band]:
    """Errors of some keyframes' depth by true depth, over all of their pixels together."""
    p, q = (np.concatenate([getattr(c, name)[c.valid] for c in compared]) for name in ("predicted", "truth"))
    return bands(p / q, q)


def sorted_errors(compared: Sequence[ComparedDepth], uncertainty: Sequence[np.ndarray]) -> list[SortedPoint]:
    """AbsRel of the pixels that are kept, mean over keyframes. `uncertainty` (H, W) of each."""
    curves = []
    for c, sigma in zip(compared, uncertainty, strict=True):
        error = np.abs(c.predicted / np.where(c.valid, c.truth, 1) - 1)[c.valid]
        counts = [max(1, round(share * len(error))) for share in SHARES]
        means = np.arange(1, len(error) + 1)
        ways = [np.cumsum(error[np.argsort(by, kind="stable")]) / means for by in (sigma[c.valid], error)]
        curves.append([[way[count - 1] for count in counts] for way in ways])
    if not curves:
        return []
    by_uncertainty, by_error = np.mean(curves, 0)
    return [SortedPoint(s, float(u), float(e)) for s, u, e in zip(SHARES, by_uncertainty, by_error, strict=True)]


def front(surfaces: Sequence[tuple[DenseMap, Similarity]], truth: TrueSurface) -> list[FrontPoint]:
    """The accuracy-completeness front of surfaces together, each with its true_from_map: from all of it to what is
    trusted most. By what not every surface tells, there is none."""
    some = [(dense, true_from_map) for dense, true_from_map in surfaces if len(dense.vertices)]
    if not some:
        return []
    vertices = np.concatenate([true_from_map.apply(dense.vertices) for dense, true_from_map in some])
    accuracy = closest(vertices, truth.tree)
    cloud = truth.cloud[:: max(1, len(truth.cloud) // _TRUE_POINTS)]
    each = [_doubts(dense, true_from_map.scale) for dense, true_from_map in some]
    found = []
    for by in each[0]:
        if not all(by in doubts for doubts in each):
            continue
        doubt = np.concatenate([doubts[by] for doubts in each])
        for threshold in np.unique(np.quantile(doubt, SHARES, method="inverted_cdf"))[::-1]:
            kept = doubt <= threshold
            near = cKDTree(vertices[kept]).query(cloud, distance_upper_bound=_NEAR_MM)[0] <= _NEAR_MM
            error = accuracy[kept]
            shares = float((error <= _NEAR_MM).mean()), float(near.mean())
            told = float(abs(threshold)), float(kept.mean()), rms(error), float(np.median(error))
            found.append(FrontPoint(by, *told, *shares))
    return found


def _doubts(dense: DenseMap, mm: float) -> dict[str, np.ndarray]:
    """What a vertex is doubted by, larger where more."""
    found = {}
    if dense.expected_error is not None:
        found["expected error"] = dense.expected_error * mm
    if dense.views is not None:
        found["views"] = -dense.views.astype(float)
    return found
