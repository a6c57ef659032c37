"""Curves in place of one figure: error against coverage, and error by distance.

Coverage in two ways. Of a surface: vertices are dropped from the least trusted on, by the error that is expected of
them or by the number of keyframes that saw them; what is left is more accurate and less complete. Of depth: pixels are
dropped from the most uncertain on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from densify.bench.completion.figures import Band, FrontPoint, SortedPoint
from densify.dense_map import DenseMap
from densify.evaluation.errors import ComparedDepth, TrueSurface, closest, rms
from densify.similarity import Similarity

BANDS_MM = (0.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0)
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
_NEAR_MM = 2.0
_TRUE_POINTS = 20_000


def bands(compared: Sequence[ComparedDepth]) -> list[Band]:
    """Errors of some keyframes' depth by true depth; bands without a pixel are left out."""
    p, q = (np.concatenate([getattr(c, name)[c.valid] for c in compared]) for name in ("predicted", "truth"))
    found = []
    for low, high in zip(BANDS_MM, BANDS_MM[1:], strict=False):
        ratio = (p / q)[(q >= low) & (q < high)]
        if len(ratio):
            mean, bias = float(np.abs(ratio - 1).mean()), float(np.median(ratio) - 1)
            found.append(Band(low, high, len(ratio), mean, bias))
    return found


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


def front(dense: DenseMap, true_from_map: Similarity, truth: TrueSurface) -> list[FrontPoint]:
    """The accuracy-completeness front of a surface, from all of it to what is trusted most."""
    if not len(dense.vertices):
        return []
    vertices = true_from_map.apply(dense.vertices)
    accuracy = closest(vertices, truth.tree)
    cloud = truth.cloud[:: max(1, len(truth.cloud) // _TRUE_POINTS)]
    found = []
    for by, doubt in _doubts(dense, true_from_map.scale).items():
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
