"""One keyframe's scale: LMedS over the map points that it observed, inlier test, refinement, trust.

After "3D Densification for Multi-Map Monocular VSLAM in Endoscopy", System Overview, with two corrections: norms are
taken in the camera frame of the keyframe (the paper prints world-frame norms, which pull the scale to 1 where the
camera is away from the origin), and a point is an inlier where its residual is at most t sigma (the paper prints >=).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lightdepth.observations import ObservedDistances
from lightdepth.robust import inlier_sigma, lmeds_scale, refine_scale


@dataclass(frozen=True)
class AlignmentConfig:
    """When a keyframe's scale is found, and when it is trusted."""

    t: float = 2.5  # a residual of at most t sigma makes an inlier
    finite_sample: bool = False  # Rousseeuw's factor 1 + 5 / (n - 1) in sigma
    refine: bool = True  # robust refinement on the inliers
    min_points: int = 8  # observed points with a prediction; fewer are not worth a scale
    min_inlier_share: float = 0.5  # of the observed points
    max_relative_sigma: float = 0.35  # sigma over the median mapped distance


@dataclass(frozen=True)
class Alignment:
    """map distance ≈ scale · predicted distance. sigma in map units; ids of the points on either side of t sigma.

    `ok`, or else `reason` says why the keyframe is left out. `range_90` is the 90th percentile of the inliers'
    distance.
    """

    keyframe: str
    scale: float = 0.0
    sigma: float = 0.0
    points: int = 0
    inlier_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    outlier_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    range_90: float = 0.0
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason

    @property
    def inlier_share(self) -> float:
        return len(self.inlier_ids) / max(self.points, 1)


def align(name: str, observed: ObservedDistances, config: AlignmentConfig) -> Alignment:
    """The scale of one keyframe, or the reason why there is none."""
    n = len(observed)
    if n < config.min_points:
        return Alignment(name, points=n, reason=f"{n} observed points with a prediction; at least {config.min_points}")
    a, b = observed.mapped, observed.predicted
    best = lmeds_scale(a, b)
    sigma = inlier_sigma(best.median, n, config.finite_sample)
    scale = best.scale
    # Data without noise leave a median of rounding errors: do not call their own inliers outliers.
    threshold = config.t * sigma + 1e-9 * float(np.median(a))
    inlier = np.abs(a - scale * b) <= threshold
    if config.refine:
        scale = refine_scale(a[inlier], b[inlier], scale, max(sigma, 1e-12))
    reason = ""
    if inlier.mean() < config.min_inlier_share:
        reason = f"{inlier.mean():.0%} of {n} points are inliers; at least {config.min_inlier_share:.0%}"
    elif sigma > config.max_relative_sigma * np.median(a):
        reason = f"sigma is {sigma / np.median(a):.0%} of the median distance; at most {config.max_relative_sigma:.0%}"
    elif not scale > 0:
        reason = f"scale {scale:.3g}; it must be positive"
    return Alignment(
        name,
        scale=scale,
        sigma=sigma,
        points=n,
        inlier_ids=observed.point_ids[inlier],
        outlier_ids=observed.point_ids[~inlier],
        range_90=float(np.quantile(a[inlier], 0.9)) if inlier.any() else 0.0,
        reason=reason,
    )
