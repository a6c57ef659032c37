"""The keyframes of a submap brought to agree: on the map's points, and where they see the same tissue.

Notation: keyframe i with camera centre c_i; b predicted, a mapped distance, d_i = b exp(phi' w_i) the bent distance
(densify.bending); X a pixel of keyframe i placed in the map by d_i, p its projection in keyframe j. The unknowns w of
all keyframes minimise together

    sum_i sum_k rho((log a_ik - log d_i(k)) / s_i)                      map points k that keyframe i observed
    + overlap sum_ij sum_X rho((log |X - c_j| - log d_j(p)) / o_ij)     pixels of i that j sees as well
    + sum_i w_i' diag(prior) w_i                                        the ridge of the bending

with Geman-McClure's rho; s_i the deviation of the residuals at hand (from their lower quartile), never above what it
was at the LMedS scale, or wrong points would widen it and be let in; o_ij that of the overlap (1.4826 median), but not
below that of the points of i or j. Flat depth maps agree perfectly. So the overlap's deviation is never taken below the
points': a map that fits its points badly gains no weight by being flat. Residuals are of the logarithm, because both a
network and a triangulation err in proportion to the distance or faster. Solved by Gauss-Newton on sparse normal
equations, with weights and projections renewed in every round; nothing in it is random.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Annotated

import cv2
import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import spsolve

from densify.bending import Bend, BendingConfig
from lightdepth.brief import Brief
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction, log_distance_at
from lightdepth.ranges import above, at_least, checked
from lightdepth.robust import lower_quartile, mad_sigma, robust_weights
from lightdepth.sparse_map import Keyframe

_DENSE = 1200  # unknowns up to which one dense matrix is solved faster than a sparse one
_STEP = 1e-3  # of log distance, to differentiate by
_CELLS = 8  # across and down an image: parts whose points share their errors
_WIDTH = 2.0  # sigmas; half weight at 1.3 of them, so that fewer good residuals are lost
_LEAST_SIGMA = 0.01  # of log distance: exact data must not make a single residual decide


@dataclass(frozen=True)
@checked
class AgreementConfig:
    """What the keyframes of a submap must agree on."""

    on: bool = True
    """Whether the keyframes of a submap, each with its own scale, are then fitted together and bent (see bending);
    switched off, each keeps its one scale and nothing bends."""
    overlap: Annotated[float, at_least(0)] = 0.03
    """Weight, against 1 for a map point, of the disagreement of two keyframes at a pixel that both see; 0 compares
    none, and live never does. A larger one makes keyframes agree better with each other, and fit their points less."""
    neighbours: Annotated[int, at_least(0, up_to=1000)] = 4
    """Number of keyframes that each is compared with, those that share most map points with it; live compares none.
    More hold the submap together better and take longer."""
    samples: Annotated[int, at_least(1, up_to=10_000)] = 16
    """Number of pixels across the image at which keyframes are compared, and as many down as keeps the spacing equal;
    live compares none. More find finer disagreement and take longer."""
    rounds: Annotated[int, at_least(0, up_to=10_000)] = 8
    """Largest number of rounds (Gauss-Newton steps) in which keyframes are fitted together; tolerance may end them
    sooner. More come closer to the solution and take longer."""
    tolerance: Annotated[float, at_least(0)] = 1e-3
    """Change of the fit, in log distance (0.001 is 0.1 %), below which a round is the last. A larger one ends sooner,
    at a less exact solution."""
    shared_error: Annotated[float, at_least(0)] = 0.03
    """Error, in log distance (0.03 is 3 %), that map points in the same part of an image (of 8 x 8) have in common:
    however many they are, they count for no more than one point with that error. A larger one fits depth less closely
    to crowded points; 0 counts each on its own."""
    max_gap: Annotated[float, above(0)] = 0.5
    """Disagreement, in log distance (0.5 is a factor of 1.6), from which two keyframes count as seeing different tissue
    at a pixel and are not compared there; live compares none. A larger one compares more pixels."""


MOST_AT_ONCE = 32_000
"""Places that cv2.remap is given at once: of 32767 in a row it takes no more."""


@dataclass(frozen=True, repr=False)
class View(Brief):
    """A keyframe as the agreement sees it: what it observed, its log predicted distance at few rows (h, w) float32
    with validity (h, w), and its LMedS scale."""

    keyframe: Keyframe
    observed: ObservedDistances
    log_distance: np.ndarray
    valid: np.ndarray
    scale: float

    @classmethod
    def of(
        cls, keyframe: Keyframe, observed: ObservedDistances, prediction: DepthPrediction, scale: float, rows: int = 128
    ) -> View:
        height, width = prediction.distance.shape
        rows = min(rows, height)
        size = (max(1, round(width * rows / height)), rows)
        return cls(keyframe, observed, *log_distance_at(prediction, size), scale)

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log predicted distance (n,) at x (n, 2) in [0, 1]², and where it is known (n,)."""
        if len(x) > MOST_AT_ONCE:
            first, rest = self.at(x[:MOST_AT_ONCE]), self.at(x[MOST_AT_ONCE:])
            return np.concatenate([first[0], rest[0]]), np.concatenate([first[1], rest[1]])
        height, width = self.valid.shape
        place = (x * (width, height) - 0.5).astype(np.float32)
        inside = ((place >= 0) & (place <= (width - 1, height - 1))).all(1)
        maps = place[None, :, 0], place[None, :, 1]
        log = cv2.remap(self.log_distance, *maps, cv2.INTER_LINEAR)[0]
        known = cv2.remap(self.valid.astype(np.float32), *maps, cv2.INTER_LINEAR)[0]
        return log.astype(np.float64), inside & (known > 0.999)

    def grid(self, samples: int) -> np.ndarray:
        """x (n, 2) of known pixels, `samples` across the image."""
        height, width = self.valid.shape
        down = max(2, round(samples * height / width))
        y, x = np.meshgrid((np.arange(down) + 0.5) / down, (np.arange(samples) + 0.5) / samples, indexing="ij")
        places = np.stack([x.ravel(), y.ravel()], 1)
        result: np.ndarray = places[self.at(places)[1]]
        return result


def agree(
    views: Sequence[View],
    shared: np.ndarray,
    config: AgreementConfig,
    bending: BendingConfig,
    start: Sequence[Bend] | None = None,
) -> list[Bend]:
    """The field of every view. `shared` (n, n) counts the points that two views share (sparse_map.covisibility).

    The rounds begin at one scale each; or at `start`, fields of the same bending that agree already: then each round
    moves every view with the others held, which takes far less time for many unknowns, and nears what moving all
    together comes to: of what a finer grid adds, three rounds leave some half of an RMS undone (docs/far-field.md)."""
    bends = [unbent(view, bending) for view in views]
    if not config.on:
        return bends
    unknowns = len(bending.precision)
    prior = np.tile(bending.precision, len(views))
    pairs = compared_pairs(shared, config.neighbours) if config.overlap else []
    places = [_Places(view, bend, config.samples) for view, bend in zip(views, bends, strict=True)]
    most = [inlier_deviation(_residual(*each)) for each in zip(views, bends, places, strict=True)]
    bends = bends if start is None else list(start)
    w = np.concatenate([bend.weights for bend in bends])
    for _ in range(config.rounds):
        points = [_point_rows(i, *each, config) for i, each in enumerate(zip(views, bends, places, most, strict=True))]
        rows = points + _overlap_rows(views, bends, places, pairs, config, points)
        step = _step(rows, prior, prior * w, len(views), held=start is not None)
        if step is None:
            break  # nothing holds some unknown: stay where the last round was
        w = w + step
        bends = [replace(b, weights=w[i * unknowns : (i + 1) * unknowns]) for i, b in enumerate(bends)]
        if np.abs(step).max() < config.tolerance:
            break
    return bends


@dataclass(frozen=True)
class _Rows:
    """Residuals (n,), their weights (n,) and minus their derivatives (n, m) by the unknowns of each view named."""

    residual: np.ndarray
    weight: np.ndarray
    blocks: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class _WhenAsked(Mapping[int, np.ndarray]):
    """Derivatives that are made each time: those of all pairs of some hundred views are gigabytes."""

    made: dict[int, Callable[[], np.ndarray]]

    def __getitem__(self, view: int) -> np.ndarray:
        return self.made[view]()

    def __iter__(self) -> Iterator[int]:
        yield from self.made

    def __len__(self) -> int:
        return len(self.made)


def _step(
    rows: Sequence[_Rows], prior: np.ndarray, pull: np.ndarray, views: int, held: bool = False
) -> np.ndarray | None:
    """Solves (J' W J + diag(prior)) step = J' W r - pull; None where it has no solution.

    J' W J is built block by block, its lower half alone: views that do not meet have none. A few blocks are solved as
    a dense matrix, many as a sparse one; with the other views held, each by itself.
    """
    unknowns = len(prior) // views
    blocks = {(i, i): np.diag(part) for i, part in enumerate(np.split(prior, views))}
    right = -pull.reshape(views, unknowns)
    for r in rows:
        root = np.sqrt(r.weight)[:, None]  # numpy makes but half of the product of a matrix with its own transpose
        weighted = {i: of_i * root for i, of_i in r.blocks.items()}
        for i, of_i in weighted.items():
            right[i] += of_i.T @ (root[:, 0] * r.residual)
            for j, of_j in weighted.items():
                if j == i or (j < i and not held):
                    blocks[i, j] = blocks.get((i, j), 0) + of_i.T @ of_j
    if held:
        try:
            step = np.concatenate([np.linalg.solve(blocks[i, i], right[i]) for i in range(views)])
        except np.linalg.LinAlgError:
            return None
    elif len(prior) <= _DENSE:
        matrix = np.zeros((views, unknowns, views, unknowns))
        for (i, j), block in blocks.items():
            matrix[i, :, j] = block
        try:
            factor = cho_factor(matrix.reshape(len(prior), -1), lower=True, overwrite_a=True, check_finite=False)
            step = cho_solve(factor, right.ravel(), check_finite=False)
        except np.linalg.LinAlgError:
            return None
    else:
        blocks |= {(j, i): block.T for (i, j), block in blocks.items() if i != j}
        order = sorted(blocks)
        first = np.searchsorted([i for i, _ in order], np.arange(views + 1))
        data = np.stack([blocks[place] for place in order])
        matrix = sparse.bsr_matrix((data, [j for _, j in order], first), (len(prior), len(prior)))
        step = spsolve(matrix.tocsc(), right.ravel(), permc_spec="MMD_AT_PLUS_A")
    return step if np.isfinite(step).all() else None


def unbent(view: View, bending: BendingConfig) -> Bend:
    """A view's own scale, as a field that does not bend."""
    weights = np.zeros(len(bending.precision))
    weights[0] = np.log(view.scale)
    known = view.log_distance[view.valid]
    middle = float(np.median(known)) if len(known) else 0.0
    log_range = np.quantile(np.log(view.observed.predicted), (0.02, 0.98)) if len(view.observed) else (-np.inf, np.inf)
    image_size = view.keyframe.camera.width, view.keyframe.camera.height
    return Bend(bending, middle, weights, image_size, (float(log_range[0]), float(log_range[1])))


@dataclass(frozen=True)
class _Places:
    """What no round changes, made when it is first asked for: one view has no use for a grid."""

    view: View
    bend: Bend
    samples: int

    @cached_property
    def at_points(self) -> np.ndarray:
        """The basis (n, m) at the observed points."""
        o = self.view.observed
        return self.bend.basis(o.pixels / self.bend.image_size, np.log(o.predicted))

    @cached_property
    def growth(self) -> np.ndarray:
        return growth_of(self.view.observed.mapped)

    @cached_property
    def cells(self) -> np.ndarray:
        return cells_of(self.view.observed.pixels, self.bend.image_size)

    @cached_property
    def grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of a grid of pixels the unit rays (g, 3), the log predicted distance (g,) and the basis (g, m)."""
        x = self.view.grid(self.samples)
        log_predicted, _ = self.view.at(x) if len(x) else (np.zeros(0), None)
        rays, _ = self.view.keyframe.camera.unproject(x * self.bend.image_size)
        return rays, log_predicted, self.bend.basis(x, log_predicted)

    def sloped(self, slope: np.ndarray, use: np.ndarray) -> np.ndarray:
        return np.asarray(-slope[:, None] * self.grid[2][use])


def _residual(view: View, bend: Bend, places: _Places) -> np.ndarray:
    o = view.observed
    result: np.ndarray = np.log(o.mapped) - np.log(o.predicted) - places.at_points @ bend.weights
    return result


def _point_rows(index: int, view: View, bend: Bend, places: _Places, most: float, config: AgreementConfig) -> _Rows:
    residual = _residual(view, bend, places)
    weight = point_weights(residual, places.growth, places.cells, most, config.shared_error)
    return _Rows(residual, weight, {index: places.at_points})


def point_weights(
    residual: np.ndarray,
    growth: np.ndarray,
    cells: np.ndarray,
    most: float,
    shared_error: float,
    width: float = _WIDTH,
) -> np.ndarray:
    """Weights (n,) of points by their residuals (n,) of log distance: small where a point is wrong. `growth` and
    `cells` (n,) as the functions below have them; `most` is the largest deviation that the points may have; at `width`
    deviations a quarter of a point's weight is left."""
    sigma = min(inlier_deviation(residual), most) * growth
    weight = robust_weights(residual / sigma / width) / sigma**2
    # Points of one cell share an error: together they tell no more than one point with that error would.
    told = np.bincount(cells, weight, _CELLS**2)[cells]
    result: np.ndarray = weight / (1 + told * shared_error**2)
    return result


def growth_of(mapped: np.ndarray) -> np.ndarray:
    """How many times as large as a middling point's the deviation of each observed point (n,) is: a triangulated
    distance errs with its square, so its logarithm in proportion to it."""
    ratio = mapped / np.median(mapped)
    result: np.ndarray = np.sqrt((1 + ratio**2) / 2).clip(max=3)
    return result


def cells_of(pixels: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """The part of the image (n,) that each observed point, at pixels (n, 2), lies in."""
    place = np.clip((pixels / image_size * _CELLS).astype(int), 0, _CELLS - 1)
    result: np.ndarray = place[:, 1] * _CELLS + place[:, 0]
    return result


def inlier_deviation(residual: np.ndarray) -> float:
    """Standard deviation, where up to half of the residuals are wrong: from the lower quartile, which they inflate
    less than the median."""
    return max(lower_quartile(np.abs(residual)) / 0.3186, _LEAST_SIGMA)


def _deviation(residual: np.ndarray) -> float:
    return mad_sigma(residual, _LEAST_SIGMA)


def _weight(x: np.ndarray) -> np.ndarray:
    return robust_weights(x / _WIDTH)


def compared_pairs(shared: np.ndarray, neighbours: int) -> list[tuple[int, int]]:
    """Each view with those that share most points with it, in both directions."""
    pairs = set()
    for i, row in enumerate(shared):
        order = np.argsort(-row, kind="stable")
        for j in [int(j) for j in order if j != i and row[j]][:neighbours]:
            pairs |= {(i, j), (j, i)}
    return sorted(pairs)


def _overlap_rows(
    views: Sequence[View],
    bends: Sequence[Bend],
    places: Sequence[_Places],
    pairs: Sequence[tuple[int, int]],
    config: AgreementConfig,
    points: Sequence[_Rows],
) -> list[_Rows]:
    found = []
    for i, view in enumerate(views):
        partners = [j for a, j in pairs if a == i]
        if not partners:
            continue
        rays, log_predicted, phi = places[i].grid
        if not len(rays):
            continue
        log_d = log_predicted + phi @ bends[i].weights
        for j in partners:
            here = gap_between(view, views[j], bends[j], rays, log_d)
            moved = gap_between(view, views[j], bends[j], rays, log_d + _STEP)
            slope = (moved.gap - here.gap) / _STEP
            use = here.known & moved.known & (np.abs(here.gap) < config.max_gap) & (np.abs(slope) < 5)
            if use.sum() >= 10:
                own = partial(places[i].sloped, slope[use], use)
                other = partial(bends[j].basis, here.x[use], here.log_predicted[use])
                found.append(_Rows(here.gap[use], np.ones(int(use.sum())), _WhenAsked({i: own, j: other})))
    if not found:
        return []
    together = _deviation(np.concatenate([f.residual for f in found]))
    sigmas = [max(together, *(_deviation(points[i].residual) for i in f.blocks)) for f in found]
    weights = [config.overlap * _weight(f.residual / sigma) / sigma**2 for f, sigma in zip(found, sigmas, strict=True)]
    return [replace(f, weight=weight) for f, weight in zip(found, weights, strict=True)]


@dataclass(frozen=True)
class OverlapGap:
    """Pixels X of one view as another sees them: `gap` (n,) = log |X - c| - log d(p), where `known` (n,); p at `x`
    (n, 2) in [0, 1]², log predicted distance there (n,), and `log_reach` (n,) = log |X - c|."""

    gap: np.ndarray
    known: np.ndarray
    x: np.ndarray
    log_predicted: np.ndarray
    log_reach: np.ndarray


def gap_between(view: View, other: View, bend: Bend, rays: np.ndarray, log_d: np.ndarray) -> OverlapGap:
    """Pixels of `view`, on unit rays (n, 3) at log distance log_d (n,), against the depth of `other`, bent."""
    other_from_view = other.keyframe.cam_from_map @ np.linalg.inv(view.keyframe.cam_from_map)
    points = (rays * np.exp(log_d)[:, None]) @ other_from_view[:3, :3].T + other_from_view[:3, 3]
    camera = other.keyframe.camera
    pixels, seen = camera.project(points)
    x = np.where(seen[:, None], pixels / (camera.width, camera.height), 0.5)
    log_predicted, known = other.at(x)
    log_reach = np.log(np.linalg.norm(points, axis=1).clip(min=1e-12))
    d = log_predicted + bend.along(x, log_predicted)
    return OverlapGap(log_reach - d, seen & known, x, log_predicted, log_reach)
