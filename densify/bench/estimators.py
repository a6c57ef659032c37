"""Estimators of one keyframe's scale side by side, on points of which a known share is wrong.

Notation: b predicted, a mapped distance; right points have a = s b (1 + e) with s known. e is the error of a depth map
(5 %) and of triangulation (1 % at 20 mm, in proportion to the distance), as in lightdepth.tube.slam. Points lie at
random pixels of a view down a tube (distance radius / sin theta, 100 mm at most). Wrong ones are of three kinds:

    uniform     a is uniform between 0 and four times the median distance, whatever was seen
    clustered   all agree on a scale 1.6 times as large, with the errors of right points
    depth       far points are wrong more often, and by more: a = s b (1.3 + Exp(4) b / median b)

The figure is |found / s - 1|. Every estimator is asked the same questions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np

from densify.agreement import AgreementConfig, View, agree
from densify.alignment import AlignmentConfig, align, bent
from densify.bending import BendingConfig
from densify.evaluation.tables import Table
from lightdepth.camera import Pinhole
from lightdepth.errors import InputError
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import BELOW_ONE, COUNT, SEED, at_least, checked
from lightdepth.reporting.figures import chart_png
from lightdepth.robust import lmeds_scale
from lightdepth.sparse_map import Keyframe

Kind = Literal["uniform", "clustered", "depth"]
NO_LIBRARY = (
    "MAGSAC is not in the table: no library at hand has it for one scale. OpenCV's USAC_MAGSAC estimates homographies, "
    "fundamental and essential matrices and poses; what comes closest to a scale, a translation of logarithms by "
    "estimateTranslation2D, refuses it."
)
_CAMERA = Pinhole(80, 64, 48.0, 48.0, 40.0, 32.0)
_RADIUS_MM, _FARTHEST_MM = 18.0, 100.0
_DEPTH_ERROR, _POINT_ERROR = 0.05, 0.01 / 20
_REACH = 2.5
"""Sigmas within which RANSAC counts a point, where it is told the truth."""


@dataclass(frozen=True)
@checked
class EstimatorsConfig:
    """Shares of wrong points, their kinds, points per keyframe, and keyframes drawn for each combination."""

    shares: Annotated[tuple[float, ...], BELOW_ONE] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.45, 0.5, 0.55, 0.6)
    """Shares of wrong points, each judged on its own. More shares take longer."""
    kinds: tuple[Kind, ...] = ("uniform", "clustered", "depth")
    """Kinds of wrong points: uniform, clustered, depth."""
    points: Annotated[tuple[int, ...], at_least(8, up_to=1_000_000)] = (20, 100, 500)
    """Numbers of points per keyframe, each judged on its own. More numbers take longer."""
    draws: Annotated[int, COUNT] = 50
    """Number of keyframes drawn for each combination. More make the figures more certain and take longer."""
    seed: Annotated[int, SEED] = 0
    """Number that draws the keyframes and their points. Another one draws others."""

    def __post_init__(self) -> None:
        if not self.shares:
            raise InputError("shares", f"{list(self.shares)}", "expected shares of at least 0 and below 1")
        if not self.kinds or set(self.kinds) - set(get_args(Kind)):
            raise InputError("kinds", f"{list(self.kinds)}", f"expected some of {', '.join(get_args(Kind))}")
        if not self.points:
            raise InputError("points", f"{list(self.points)}", "expected numbers of at least 8")


@dataclass(frozen=True)
class Question:
    """Points of one keyframe, the depth map that they were predicted by, the right scale, and the deviation of a right
    point's residual [map units], which nobody knows in practice."""

    observed: ObservedDistances
    prediction: DepthPrediction
    scale: float
    sigma: float


def question(kind: Kind, share: float, points: int, rng: np.random.Generator) -> Question:
    """A keyframe with exactly the share of wrong points, rounded."""
    rays, _ = _CAMERA.rays()
    sine = np.linalg.norm(rays[..., :2], axis=-1)
    distance = (_RADIUS_MM / np.maximum(sine, _RADIUS_MM / _FARTHEST_MM)).astype(np.float32)
    known = np.ones(distance.shape, bool)
    prediction = DepthPrediction("000000", distance, known, _CAMERA, "a tube")
    row, column = rng.integers(0, _CAMERA.height, points), rng.integers(0, _CAMERA.width, points)
    b = distance[row, column].astype(np.float64)
    scale = float(np.exp(rng.uniform(np.log(0.02), np.log(0.5))))

    def noisy(factor: np.ndarray) -> np.ndarray:
        error = rng.normal(0, np.hypot(_DEPTH_ERROR, _POINT_ERROR * b))
        result: np.ndarray = scale * b * factor * (1 + error).clip(0.2)
        return result

    a, count = noisy(np.ones(points)), round(share * points)
    chance = b / b.sum() if kind == "depth" else None
    wrong = rng.choice(points, count, replace=False, p=chance)
    if kind == "uniform":
        a[wrong] = rng.uniform(0.01, 4, count) * scale * np.median(b)
    elif kind == "clustered":
        a[wrong] = noisy(np.full(points, 1.6))[wrong]
    else:
        a[wrong] = (scale * b * (1.3 + rng.exponential(4, points) * b / np.median(b)))[wrong]
    pixels = np.stack([column, row], -1) + 0.5
    sigma = float(np.median(scale * b * np.hypot(_DEPTH_ERROR, _POINT_ERROR * b)))
    return Question(ObservedDistances(np.arange(points), a, b, pixels, rays[row, column]), prediction, scale, sigma)


def least_squares(mapped: np.ndarray, predicted: np.ndarray) -> float:
    """argmin over s of sum (a - s b)²."""
    return float((mapped * predicted).sum() / (predicted**2).sum())


def consensus_scale(mapped: np.ndarray, predicted: np.ndarray, threshold: float) -> float:
    """Least squares over the points within `threshold` of the proposal a / b that has most of them: what RANSAC
    (Fischler and Bolles 1981) finds when it tries every point."""
    proposals = np.sort(mapped / predicted)
    below, above = np.sort((mapped - threshold) / predicted), np.sort((mapped + threshold) / predicted)
    agreeing = np.searchsorted(below, proposals, "right") - np.searchsorted(above, proposals, "left")
    best = proposals[np.argmax(agreeing)]
    inlier = np.abs(mapped - best * predicted) <= threshold * (1 + 1e-9)
    return least_squares(mapped[inlier], predicted[inlier])


def _refined(q: Question) -> tuple[float, bool]:
    found = align("000000", q.observed, AlignmentConfig())
    return found.scale, found.ok


def _ours(q: Question) -> tuple[float, bool]:
    """As densify does it with recipe full, for a keyframe without neighbours: the median pixel's scale."""
    config = AlignmentConfig()
    found = align("000000", q.observed, config)
    if not found.ok:
        return found.scale, False
    keyframe = Keyframe("000000.png", _CAMERA, np.eye(4), q.observed.pixels, q.observed.point_ids)
    view = View.of(keyframe, q.observed, q.prediction, found.scale)
    (bend,) = agree([view], np.zeros((1, 1), int), AgreementConfig(), BendingConfig())
    found = bent(found, bend, q.observed, config)
    return float(np.median(found.applied(q.prediction).distance / q.prediction.distance)), found.ok


def _always(scale: Callable[[Question], float]) -> Callable[[Question], tuple[float, bool]]:
    return lambda q: (scale(q), True)


def _pair(q: Question) -> tuple[np.ndarray, np.ndarray]:
    return q.observed.mapped, q.observed.predicted


ESTIMATORS: dict[str, Callable[[Question], tuple[float, bool]]] = {
    "median ratio": _always(lambda q: float(np.median(q.observed.mapped / q.observed.predicted))),
    "least squares": _always(lambda q: least_squares(*_pair(q))),
    "RANSAC, true threshold": _always(lambda q: consensus_scale(*_pair(q), _REACH * q.sigma)),
    "RANSAC, ten times too wide": _always(lambda q: consensus_scale(*_pair(q), 10 * _REACH * q.sigma)),
    "RANSAC, ten times too narrow": _always(lambda q: consensus_scale(*_pair(q), 0.1 * _REACH * q.sigma)),
    "LMedS": _always(lambda q: lmeds_scale(*_pair(q)).scale),
    "LMedS + refinement": _refined,
    "ours (full)": _ours,
}
"""A scale, and whether the estimator would use it: those that are trusted only after a test may refuse."""


@dataclass(frozen=True)
class EstimatorFigures:
    """Errors of one estimator over the keyframes of one combination, as estimators.json has them. Shares of 1."""

    kind: Kind
    """kind of the wrong points"""
    points: int
    """number of points of a keyframe"""
    wrong_share: float
    """share of the points that are wrong"""
    estimator: str
    """name of the estimator"""
    median_error: float
    """median over all keyframes"""
    p90_error: float
    """90th percentile over all keyframes"""
    refused_share: float
    """share of the keyframes whose scale the estimator would not use"""
    p90_error_used: float | None
    """90th percentile over the keyframes whose scale it would use; None where there are none"""


def compared_estimators(config: EstimatorsConfig, on_case: Callable[[], None] = lambda: None) -> list[EstimatorFigures]:
    """One record for each kind, share, number of points and estimator."""
    records = []
    for kind in config.kinds:
        for points in config.points:
            for share in config.shares:
                key = [config.seed, get_args(Kind).index(kind), points, round(1000 * share)]
                rng = np.random.default_rng(key)
                asked = [question(kind, share, points, rng) for _ in range(config.draws)]
                for name, estimate in ESTIMATORS.items():
                    found = [(q.scale, *estimate(q)) for q in asked]
                    error = np.array([abs(s / right - 1) for right, s, _ in found])
                    used = np.array([ok for *_, ok in found])
                    records.append(
                        EstimatorFigures(
                            kind=kind,
                            points=points,
                            wrong_share=share,
                            estimator=name,
                            median_error=float(np.median(error)),
                            p90_error=float(np.quantile(error, 0.9)),
                            refused_share=float(1 - used.mean()),
                            p90_error_used=float(np.quantile(error[used], 0.9)) if used.any() else None,
                        )
                    )
                on_case()
    return records


def estimators_tables(records: Sequence[EstimatorFigures]) -> list[Table]:
    """For each kind and number of points: median / 90th percentile of the error in %, and what was refused."""
    tables = []
    for kind in dict.fromkeys(r.kind for r in records):
        for points in dict.fromkeys(r.points for r in records):
            of = [r for r in records if r.kind == kind and r.points == points]
            shares = list(dict.fromkeys(r.wrong_share for r in of))
            rows = []
            for name in dict.fromkeys(r.estimator for r in of):
                own = {r.wrong_share: r for r in of if r.estimator == name}
                rows.append([name, *(_cell(own[share]) for share in shares)])
            title = f"Wrong points: {kind}; {points} points. Error of the scale in %: median / 90th percentile."
            tables.append(Table(title, ["Estimator", *(f"{share:.0%} wrong" for share in shares)], rows))
    return tables


def _cell(record: EstimatorFigures) -> str:
    text = f"{100 * record.median_error:.1f} / {100 * record.p90_error:.1f}"
    return text + (f" ({record.refused_share:.0%} refused)" if record.refused_share else "")


def losses(
    records: Sequence[EstimatorFigures], against: Sequence[str] = ("median ratio", "least squares")
) -> list[str]:
    """Where LMedS is worse than a simpler estimator, in sentences: the table says it, but among many numbers."""
    found = {(r.kind, r.points, r.wrong_share, r.estimator): r.median_error for r in records}
    sentences = []
    for kind in dict.fromkeys(r.kind for r in records):
        lost = []
        for points, share in dict.fromkeys((r.points, r.wrong_share) for r in records if r.kind == kind):
            best = min(against, key=lambda name: found[kind, points, share, name])
            mine, other = found[kind, points, share, "LMedS"], found[kind, points, share, best]
            if mine > other:
                lost.append(f"{share:.0%} of {points} ({100 * mine:.1f} % against {100 * other:.1f} % by {best})")
        where = "; ".join(lost) or "nowhere"
        sentences.append(f"Wrong points {kind}: LMedS loses to the median ratio or least squares at {where}.")
    return sentences


def estimators_picture(records: Sequence[EstimatorFigures]) -> bytes:
    """90th percentile of the error over the share of wrong points: kinds across, numbers of points down."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    kinds = list(dict.fromkeys(r.kind for r in records))
    counts = list(dict.fromkeys(r.points for r in records))
    names = list(dict.fromkeys(r.estimator for r in records))
    figure = Figure(figsize=(3.6 * len(kinds) + 0.6, 2.6 * len(counts) + 1.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(counts), len(kinds), sharex=True, sharey=True, squeeze=False)
    for row, points in zip(grid, counts, strict=True):
        for axes, kind in zip(row, kinds, strict=True):
            for i, name in enumerate(names):
                of = [r for r in records if (r.kind, r.points, r.estimator) == (kind, points, name)]
                line = "-" if i >= len(names) - 3 else "--"
                x, y = [100 * r.wrong_share for r in of], [100 * r.p90_error for r in of]
                axes.plot(x, y, line, label=name, linewidth=1.8 if line == "-" else 1.2, color=f"C{i}")
            axes.set_yscale("log")
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.3)
            axes.set_title(f"{kind}, {points} points", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("wrong points [%]")
    for axes in grid[:, 0]:
        axes.set_ylabel("error of scale, p90 [%]")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return chart_png(figure)
