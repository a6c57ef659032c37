"""Blocks of wall that judge: points of a map that no lesson showed, block by block.

Notation: a distance of a point from a keyframe, t the prediction on its ray, s the keyframe's scale by LMedS over the
points of the other folds, e = |log a - log s t|. A block's error is the median of e over all sightings of its points,
its weight w the share of the images that lies nearer to them than to points of other blocks. With d the difference of a
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

from lightdepth.blocks import BLOCK_SIZE, submap_folds, wall_blocks
from lightdepth.datasets import FrameSequence
from lightdepth.light.fit_on_map import LightView, map_views
from lightdepth.models import DepthModel
from lightdepth.observations import ObservedDistances, observed_distances
from lightdepth.robust import lmeds_scale
from lightdepth.sparse_map import SparseMap, Submap, typical_distance

from .map_teacher import LEAST_POINTS

FOLDS = 5
LEAST_BLOCKS = 8
"""Judging blocks below which nothing is judged."""
_POINTS = 4  # of a block below which it is left out: wrong points lie alone
_GRID = 32  # places along each axis of an image at which the nearest point is asked for

Block = tuple[int, int]
"""A submap's id and the block's number."""


@dataclass(frozen=True)
class Parted:
    """A submap's points (n,) parted: the block and the fold of each. All of a block are of one fold; -1 is no block."""

    blocks: np.ndarray
    folds: np.ndarray


@dataclass(frozen=True)
class BlockErrors:
    """The error and weight of each block, and the median error of each held-out frame, by its number."""

    errors: Mapping[Block, float]
    weights: Mapping[Block, float]
    frames: Mapping[int, float]

    @property
    def mean(self) -> float | None:
        """Mean error of the blocks, weighted; None where there are none."""
        total = sum(self.weights[key] for key in self.errors)
        return sum(self.weights[key] * self.errors[key] for key in self.errors) / total if total > 0 else None


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

    def errors(self, model: DepthModel) -> BlockErrors:
        """What the model errs by at the blocks."""
        sightings: dict[Block, list[np.ndarray]] = {}
        weights: dict[Block, float] = {}
        frames: dict[int, float] = {}
        for view in self.views:
            observed = observed_distances(view.keyframe, view.submap, model(view.frame))
            if len(observed) < LEAST_POINTS:
                continue
            part, rows = self.parts[view.submap.id], view.submap.rows_of(observed.point_ids)[0]
            blocks, folds, area = part.blocks[rows], part.folds[rows], _areas(view, observed)
            held = view.keyframe.number in self.held
            errors = _errors(observed, folds, range(FOLDS) if held or not self.taught else range(1))
            judged = np.isfinite(errors) & (blocks >= 0)
            for block in np.unique(blocks[judged]).tolist():
                chosen = judged & (blocks == block)
                key = (view.submap.id, block)
                sightings.setdefault(key, []).append(errors[chosen])
                weights[key] = weights.get(key, 0.0) + float(area[chosen].sum())
            if held and np.isfinite(errors).any():
                frames[view.keyframe.number] = float(np.nanmedian(errors))
        return BlockErrors(
            {key: float(np.median(np.concatenate(seen))) for key, seen in sightings.items()}, weights, frames
        )

    def hidden(self) -> dict[int, np.ndarray]:
        """Ids of the points that no lesson may show, by submap id."""
        submaps: dict[int, Submap] = {view.submap.id: view.submap for view in self.views}
        return {i: submap.point_ids[self.parts[i].folds == 0] for i, submap in submaps.items()}


def wall_judge(frames: FrameSequence, held: FrameSequence, sparse_map: SparseMap, taught: bool, seed: int) -> WallJudge:
    """The map's keyframes among the frames as a judge; `taught` where the map teaches as well."""
    views = map_views(frames, sparse_map, frames[0].camera)
    parts = {submap.id: _parted(submap, seed) for submap in sparse_map.submaps}
    return WallJudge(tuple(views), parts, frozenset(held.numbers), taught)


def compared(before: BlockErrors, after: BlockErrors) -> Change | None:
    """The change of the blocks that both know, or None where these are too few to tell."""
    keys = [key for key in before.errors if key in after.errors and before.weights[key] > 0]
    if len(keys) < LEAST_BLOCKS:
        return None
    w = np.array([before.weights[key] for key in keys])
    first, second = (np.array([found.errors[key] for key in keys]) for found in (before, after))
    total = float((w * first).sum())
    if not total > 0:
        return None
    change = float((w * second).sum()) / total - 1
    deviation = float(np.sqrt(np.square(w * (second - first - change * first)).sum())) / total
    mean = total / float(w.sum())
    return Change(mean, mean * (1 + change), change, deviation, len(keys))


def _parted(submap: Submap, seed: int) -> Parted:
    folds = submap_folds(submap, FOLDS, seed)
    blocks = FOLDS * wall_blocks(submap.points, BLOCK_SIZE * typical_distance(submap), seed) + folds
    return Parted(np.where(np.bincount(blocks)[blocks] >= _POINTS, blocks, -1), folds)


def _errors(observed: ObservedDistances, folds: np.ndarray, judging: Sequence[int]) -> np.ndarray:
    """|log a - log s t| (n,) of the points of the judging folds, s by the points of the others; NaN elsewhere."""
    errors = np.full(len(observed), np.nan)
    for fold in judging:
        judged = folds == fold
        others = ~judged if (~judged).sum() >= LEAST_POINTS else np.ones(len(judged), bool)
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
