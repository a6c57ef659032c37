"""One keyframe's scale: LMedS over the map points that it observed, inlier test, refinement, trust.

After "3D Densification for Multi-Map Monocular VSLAM in Endoscopy", System Overview, with two corrections: norms are
taken in the camera frame of the keyframe (the paper prints world-frame norms, which pull the scale to 1 where the
camera is away from the origin), and a point is an inlier where its residual is at most t sigma (the paper prints >=).

Notation: a mapped, b predicted distance of a point; s the scale; the ratios a / b are the proposals for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, get_args

import numpy as np

from densify.bending import Bend
from lightdepth.brief import Brief
from lightdepth.errors import InputError
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import COUNT, SHARE, above, at_least, checked
from lightdepth.robust import Loss, inlier_sigma, lmeds_scale, refine_scale

Estimator = Literal["lmeds", "median"]


@dataclass(frozen=True)
@checked
class AlignmentConfig:
    """When a keyframe's scale is found, and when it is trusted."""

    estimator: Estimator = "lmeds"
    """How a keyframe's first scale is found from its points' ratios of mapped to predicted distance: lmeds takes the
    ratio with the least median of squared residuals, median the median ratio. median is never refined (refine, loss),
    and serves to compare with."""
    t: Annotated[float, above(0)] = 2.5
    """Number of sigmas (sigma is the robust standard deviation of the differences between a keyframe's map points and
    its scaled depth) within which a map point counts as right, an inlier. A larger one takes in more points, wrong ones
    among them."""
    finite_sample: bool = False
    """Whether sigma is widened by Rousseeuw's factor 1 + 5 / (n - 1), n the keyframe's number of points. Switched on,
    keyframes with few points keep more of them as inliers, wrong ones too; with many it makes no difference."""
    refine: bool = True
    """Whether the scale found by lmeds, which is the ratio of a single point, is refined on all inliers by robust least
    squares; switched off, it stays as found. With the estimator median it does nothing."""
    loss: Loss = "geman_mcclure"
    """Robust loss of the refinement (see refine): geman_mcclure, huber, cauchy or tukey. An inlier that is off by 2.5
    sigmas keeps a weight of 0.02 with geman_mcclure, and of about 0.5 with each of the others."""
    min_points: Annotated[int, COUNT] = 8
    """Least number of map points, observed where the model predicts a distance, that a keyframe needs; one with fewer
    is left out of the surface. More make scales safer and leave out more keyframes."""
    min_inliers: Annotated[int, at_least(0, up_to=1_000_000)] = 6
    """Least number of inliers (points within t sigmas) that a keyframe needs; one with fewer is left out of the
    surface. More make scales safer and leave out more keyframes."""
    min_inlier_share: Annotated[float, SHARE] = 0.5
    """Least share, in [0, 1], of a keyframe's observed points that must be inliers; with less it is left out of the
    surface. A larger one leaves out more keyframes."""
    max_relative_sigma: Annotated[float, at_least(0)] = 0.35
    """Largest sigma (robust standard deviation of a keyframe's residuals), as a share of its points' median distance,
    with which a keyframe is used. A larger one also uses keyframes whose points disagree more."""
    min_spread_deg: Annotated[float, at_least(0, up_to=180)] = 3.0
    """Least spread of a keyframe's inliers over its view, degrees: the root mean square angle between their rays and
    the mean ray. A larger one leaves out keyframes whose inliers lie close together in the image."""
    min_distance_spread: Annotated[float, at_least(0)] = 0.02
    """Least standard deviation of the log distance of a keyframe's inliers (0.02 is about 2 %). A larger one leaves out
    keyframes whose inliers are all about equally far, which tell nothing of other distances."""
    max_second_mode: Annotated[float, at_least(0)] = 0.6
    """Largest ratio of the number of points that agree on a rival scale to the number that agree on the one found;
    above it the keyframe is left out. A larger one also uses keyframes with a stronger rival."""

    def __post_init__(self) -> None:
        if self.estimator not in get_args(Estimator):
            raise InputError(
                "alignment.estimator",
                f"{self.estimator!r} is not known",
                f"expected one of {', '.join(get_args(Estimator))}",
            )


@dataclass(frozen=True, repr=False)
class Alignment(Brief):
    """map distance ≈ scale · predicted distance. sigma in map units; ids of the points on either side of t sigma.

    `ok`, or else `reason` says why the keyframe is left out. `range_90` is the 90th percentile of the distance of the
    LMedS inliers. `bend` is the smooth field that the depth is bent by, where there is one; `unbent_because` says why
    what was found is not used, or only a part of it.
    """

    keyframe: str
    scale: float = 0.0
    sigma: float = 0.0
    points: int = 0
    inlier_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    outlier_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    range_90: float = 0.0
    reason: str = ""
    bend: Bend | None = None
    unbent_because: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason

    @property
    def inlier_share(self) -> float:
        return len(self.inlier_ids) / max(self.points, 1)

    def applied(self, prediction: DepthPrediction) -> DepthPrediction:
        """The prediction in map units."""
        return prediction.scaled(self.scale) if self.bend is None else self.bend.applied(prediction)


def align(name: str, observed: ObservedDistances, config: AlignmentConfig) -> Alignment:
    """The scale of one keyframe, or the reason why there is none."""
    n = len(observed)
    if n < config.min_points:
        return Alignment(name, points=n, reason=f"{n} observed points with a prediction; at least {config.min_points}")
    a, b = observed.mapped, observed.predicted
    scale, median = _first_scale(a, b, config.estimator)
    sigma = inlier_sigma(median, n, config.finite_sample)
    # Data without noise leave a median of rounding errors: do not call their own inliers outliers.
    threshold = config.t * sigma + 1e-9 * float(np.median(a))
    inlier = np.abs(a - scale * b) <= threshold
    if config.refine and config.estimator == "lmeds":
        scale = refine_scale(a[inlier], b[inlier], scale, max(sigma, 1e-12), loss=config.loss)
    found = Alignment(
        name,
        scale=scale,
        sigma=sigma,
        points=n,
        inlier_ids=observed.point_ids[inlier],
        outlier_ids=observed.point_ids[~inlier],
        range_90=float(np.quantile(a[inlier], 0.9)) if inlier.any() else 0.0,
    )
    return replace(found, reason=distrust(found, observed, inlier, config))


def _first_scale(mapped: np.ndarray, predicted: np.ndarray, estimator: Estimator) -> tuple[float, float]:
    """A scale that leaves wrong points for the inlier test to find, and the median |residual| that it leaves."""
    if estimator == "lmeds":
        best = lmeds_scale(mapped, predicted)
        return best.scale, best.median
    scale = float(np.median(mapped / predicted))
    return scale, float(np.median(np.abs(mapped - scale * predicted)))


def bent(alignment: Alignment, bend: Bend, observed: ObservedDistances, config: AlignmentConfig) -> Alignment:
    """The alignment with a bend, and the points judged again: inliers within t sigma of the log residuals. A bend that
    does not deserve trust is left out, and the alignment stays what it was, one scale."""
    field = bend.at(observed.pixels, observed.predicted)
    residual = np.abs(np.log(observed.mapped / observed.predicted) - field)
    sigma = inlier_sigma(float(np.median(residual)), len(residual), config.finite_sample)
    inlier = residual <= config.t * sigma + 1e-9
    found = replace(
        alignment,
        scale=bend.scale,
        sigma=sigma * float(np.median(observed.mapped)),
        inlier_ids=observed.point_ids[inlier],
        outlier_ids=observed.point_ids[~inlier],
        bend=bend,
    )
    judged = replace(found, scale=1.0), replace(observed, predicted=observed.predicted * np.exp(field))
    return alignment if distrust(*judged, inlier, config) else found


def distrust(found: Alignment, observed: ObservedDistances, inlier: np.ndarray, config: AlignmentConfig) -> str:
    """Why a scale does not deserve trust; empty where it does."""
    a, n, relative = observed.mapped, len(observed), found.sigma / float(np.median(observed.mapped))
    if inlier.sum() < config.min_inliers:
        return f"{inlier.sum()} inliers of {n} points; at least {config.min_inliers}"
    if inlier.mean() < config.min_inlier_share:
        return f"{inlier.mean():.0%} of {n} points are inliers; at least {config.min_inlier_share:.0%}"
    if relative > config.max_relative_sigma:
        return f"sigma is {relative:.0%} of the median distance; at most {config.max_relative_sigma:.0%}"
    if not (np.isfinite(found.scale) and found.scale > 0):
        return f"scale {found.scale:.3g}; it must be positive"
    spread = spread_deg(observed.rays[inlier])
    if spread < config.min_spread_deg:
        return f"the inliers fill {spread:.2g} degrees of the view; at least {config.min_spread_deg:g}"
    deviation = float(np.log(a[inlier]).std())
    if deviation < config.min_distance_spread:
        return (
            f"the inliers' distances deviate by {deviation:.1%}, so nothing tells how the depth does at others; "
            f"at least {config.min_distance_spread:.1%}"
        )
    factor, share, own = second_mode(observed, found.scale, config.t * found.sigma)
    if share > config.max_second_mode * own:
        return (
            f"two scales: {share:.0%} of {n} points agree on {factor:.3g} times the scale that {own:.0%} agree on; "
            "one of the two groups is wrong, and nothing tells which"
        )
    return ""


def spread_deg(rays: np.ndarray) -> float:
    """Root mean square angle between unit rays (n, 3) and their mean, degrees."""
    mean = rays.mean(0)
    cosine = rays @ mean / max(float(np.linalg.norm(mean)), 1e-12)
    return float(np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1, 1)) ** 2).mean())))


def second_mode(observed: ObservedDistances, scale: float, reach: float) -> tuple[float, float, float]:
    """Another scale that points agree on: its factor to `scale`, the share of points around it, the share around scale.

    LMedS breaks without a sign where half of the points agree on a wrong scale, so a rival is looked for: the densest
    window of log(a / b) apart from the one around `scale`, both as wide as `reach` [map units] is at the median
    distance. With no such window the factor is 1 and its share 0.
    """
    log_ratio = np.sort(np.log(observed.mapped / observed.predicted / scale))
    half = float(np.clip(reach / np.median(observed.mapped), 0.02, 0.25))
    inside = np.searchsorted(log_ratio, log_ratio + half, "right") - np.searchsorted(log_ratio, log_ratio - half)
    own = float((np.abs(log_ratio) <= half).mean())
    apart = np.abs(log_ratio) > 2 * half
    if not apart.any():
        return 1.0, 0.0, own
    best = int(np.argmax(np.where(apart, inside, 0)))
    return float(np.exp(log_ratio[best])), float(inside[best] / len(log_ratio)), own
