"""Blocks of wall that judge: points of a map that no lesson showed, block by block.

Notation: a distance of a point from a keyframe, t the prediction on its ray, s the keyframe's scale by LMedS over the
points of the other folds, e = |log a - log s t|. A point's error is the median of e over its sightings; points that
both models miss by far are wrong points, and are left out. A block's error is the median of its points', its weight w
the share of the images that lies nearer to them than to points of other blocks. With d the difference of a
block's errors, after less before,

    change = sum w d / sum w e_before,   deviation² = sum (w (d - change e_before))² / (sum w e_before)²

is the relative change of the mean error and its standard deviation, blocks being what is drawn (the ratio estimator,
Cochran 1977, section 6.4). Points of one block err together; blocks that lie beside each other hardly do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lightdepth.blocks import hidden_in_turn, submap_blocks, submap_folds
from lightdepth.datasets import FrameSequence
from lightdepth.light.views import LightView, map_views
from lightdepth.models import DepthModel
from lightdepth.observations import ObservedDistances, observed_distances
from lightdepth.robust import lmeds_scale
from lightdepth.sparse_map import SparseMap, Submap

from .map_teacher import LEAST_POINTS

FOLDS = 5
LEAST_BLOCKS = 8
"""Judging blocks below which nothing is judged."""
_POINTS = 4  # of a block below which it is left out: wrong points lie alone
_GRID = 32  # places along each axis of an image at which the nearest point is asked for

_WRONG = 4.0  # times the median error, from which a point that both models miss is a wrong one

PointKey = tuple[int, int]
"""A submap's id and the point's."""


@dataclass(frozen=True)
class Parted:
    """A submap's points (n,) parted: the block and the fold of each. All of a block are of one fold; -1 is no block."""

    blocks: np.ndarray
    folds: np.ndarray


@dataclass(frozen=True)
class PointError:
    """A judging point's block, its error, and the share of the images that it stands for."""

    block: int
    error: float
    weight: float


@dataclass(frozen=True)
class WallErrors:
    """The errors of the judging points, and the median error of each held-out frame, by its number."""

    points: Mapping[PointKey, PointError]
    frames: Mapping[int, float]

    @property
    def median(self) -> float | None:
        """Median error of the points; None where there are none."""
        return float(np.median([point.error for point in self.points.values()])) if self.points else None


@dataclass(frozen=True)
class Change:
    """How the mean error of the blocks changed, as a share, with its standard deviation."""

    before: float
    after: float
    change: float
    deviation: float
    blocks: int


@dataclass(frozen=True)
class WallJudge:
    """What judges: keyframes with their images, and the parts of their submaps' points by submap id. At the keyframes
    numbered `held` all folds judge, at the others all or, where the map teaches, the first alone."""

    views: tuple[LightView, ...]
    parts: Mapping[int, Parted]
    held: frozenset[int]
    taught: bool

    def errors(self, model: DepthModel) -> WallErrors:
        """What the model errs by at the points that judge."""
        sightings: dict[PointKey, list[tuple[float, float]]] = {}
        blocks: dict[PointKey, int] = {}
        frames: dict[int, float] = {}
        for view in self.views:
            observed = observed_distances(view.keyframe, view.submap, model(view.frame))
            if len(observed) < LEAST_POINTS:
                continue
            part, rows = self.parts[view.submap.id], view.submap.rows_of(observed.point_ids)[0]
            held = view.keyframe.number in self.held
            errors = _errors(observed, part.folds[rows], range(FOLDS) if held or not self.taught else range(1))
            judged = np.isfinite(errors) & (part.blocks[rows] >= 0)
            seen = zip(rows[judged], errors[judged], _areas(view, observed)[judged], strict=True)
            for row, error, area in seen:
                key = (view.submap.id, int(view.submap.point_ids[row]))
                blocks[key] = int(part.blocks[row])
                sightings.setdefault(key, []).append((float(error), float(area)))
            if held and judged.any():
                frames[view.keyframe.number] = float(np.median(errors[judged]))
        points = {}
        for key, told in sightings.items():
            of_point = np.array(told)
            points[key] = PointError(blocks[key], float(np.median(of_point[:, 0])), float(of_point[:, 1].sum()))
        return WallErrors(points, frames)

    def hidden(self) -> dict[int, np.ndarray]:
        """Ids of the points that no lesson may show, by submap id."""
        submaps: dict[int, Submap] = {view.submap.id: view.submap for view in self.views}
        return {i: submap.point_ids[self.parts[i].folds == 0] for i, submap in submaps.items()}


def wall_judge(frames: FrameSequence, held: FrameSequence, sparse_map: SparseMap, taught: bool, seed: int) -> WallJudge:
    """The map's keyframes among the frames as a judge; `taught` where the map teaches as well."""
    views = map_views(frames, sparse_map, frames.first().camera)
    parts = {submap.id: _parted(submap, seed) for submap in sparse_map.submaps}
    return WallJudge(tuple(views), parts, frozenset(held.numbers), taught)


def compared(before: WallErrors, after: WallErrors) -> Change | None:
    """The change of the blocks that both know, or None where these are too few to tell."""
    keys = [key for key in before.points if key in after.points]
    if not keys:
        return None
    old, new = ([found.points[key] for key in keys] for found in (before, after))
    errors = np.array([[a.error, b.error] for a, b in zip(old, new, strict=True)])
    blocks = np.unique(
        [[key[0], point.block] for key, point in zip(keys, old, strict=True)], axis=0, return_inverse=True
    )
    of_block, weights = blocks[1].reshape(-1), np.array([point.weight for point in old])
    least = errors.min(1)
    right = least <= _WRONG * np.median(least)
    rows = [np.flatnonzero(right & (of_block == block)) for block in range(int(of_block.max()) + 1)]
    rows = [row for row in rows if weights[row].sum() > 0]
    if len(rows) < LEAST_BLOCKS:
        return None
    w = np.array([weights[row].sum() for row in rows])
    first, second = np.array([np.median(errors[row], axis=0) for row in rows]).T
    total = float((w * first).sum())
    if not total > 0:
        return None
    change = float((w * second).sum()) / total - 1
    deviation = float(np.sqrt(np.square(w * (second - first - change * first)).sum())) / total
    mean = total / float(w.sum())
    return Change(mean, mean * (1 + change), change, deviation, len(rows))


def _parted(submap: Submap, seed: int) -> Parted:
    folds = submap_folds(submap, FOLDS, seed)
    blocks = FOLDS * submap_blocks(submap, seed) + folds
    return Parted(np.where(np.bincount(blocks)[blocks] >= _POINTS, blocks, -1), folds)


def _errors(observed: ObservedDistances, folds: np.ndarray, judging: Sequence[int]) -> np.ndarray:
    """|log a - log s t| (n,) of the points of the judging folds, s by the points of the others; NaN elsewhere."""
    errors = np.full(len(observed), np.nan)
    for judged, others in hidden_in_turn(folds, judging):
        others = others if others.sum() >= LEAST_POINTS else np.ones(len(judged), bool)
        scale = lmeds_scale(observed.mapped[others], observed.predicted[others]).scale
        errors[judged] = np.abs(np.log(observed.mapped[judged] / (scale * observed.predicted[judged])))
    return errors


def _areas(view: LightView, observed: ObservedDistances) -> np.ndarray:
    """Share of the visible image (n,) that is nearer to each point than to the others."""
    camera, valid = view.frame.camera, view.frame.valid
    x, y = ((np.arange(_GRID) + 0.5) / _GRID * side for side in (camera.width, camera.height))
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    places = places[valid[places[:, 1].astype(int), places[:, 0].astype(int)]]
    nearest = cKDTree(observed.pixels).query(places)[1]
    result: np.ndarray = np.bincount(nearest, minlength=len(observed)) / max(1, len(places))
    return result
