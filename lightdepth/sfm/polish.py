"""Keyframes of a map put where its own points see them, as far as points that had no say bear it out.

A map's poses may stray from its points: they are of another moment than these, were rounded, or come from another
tracker. Notation: keyframe with pose T = cam_from_map; X_k a map point that it observed at pixel u_k; pi its camera.
With the points held, so that the map's frame and scale stay,

    T' = exp(x) T,   x = argmin sum_k rho(|pi(exp(x) T X_k) - u_k| / s),

rho Geman-McClure's loss, s the deviation of the map's residuals in this keyframe: a pose moves no further than its
points let it. Each keyframe is judged on blocks of wall that were hidden from it in turn (lightdepth.blocks): a pose
stays as it was unless it brings these closer to their pixels by more than noise.

Distances predicted in two keyframes of the same tissue say nothing about poses that points do not say better: with them
poses got worse (docs/far-field.md). Nothing here is random but the blocks, which are drawn by their seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.blocks import hidden_in_turn, submap_folds
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.robust import robust_weights
from lightdepth.sparse_map import Keyframe, Submap

_LEAST = 20  # points that a keyframe must have observed
_LEAST_SEEN = 10  # of them that must be left while others are hidden
_ROUNDS = 12  # of Gauss-Newton, the deviation s taken anew in each
_WIDTH = 2.0  # deviations at which a quarter of a point's weight is left
_DIFFERENCE = 1e-6  # of a turn, and of a shift over the distance, to differentiate by
_STILL = 1e-5  # step of these below which a pose is found
_LEAST_HELD = 1e-10  # against what is held best: what points hold less is left as it is
_LEAST_PX = 0.1  # deviation of residuals: exact data must not make a single one decide
_PER_MEDIAN = 1.1774  # median of the length of a normal residual in two dimensions, over its deviation along each axis
_CUT = 4.0  # deviations from which a point is as wrong as it can be
_BEHIND = 1e3  # pixels: the residual of a point that is not in view
_NEIGHBOURS = 4.0  # points beside each other share their errors: so many count as one
_NOISE = 2.0  # standard errors by which hidden blocks must be better


@dataclass(frozen=True)
class Polish:
    """What became of a map's poses."""

    map: int
    """the submap's id"""
    keyframes: int
    """number of its keyframes"""
    moved: int
    """number of those whose pose was moved"""
    hidden_px: tuple[float, float]
    """median distance of points from their pixels while they were hidden, before and after, in keyframes that could be
    judged"""
    shift: float = 0.0
    """median displacement of the centres that moved, as a share of the distance to the points that they observed"""
    turn_deg: float = 0.0
    """median turn of the keyframes that moved, degrees"""
    left: str = ""
    """why no pose was moved; empty where one was"""

    def __str__(self) -> str:
        if self.left:
            return f"map {self.map}: poses are left as they were: {self.left}"
        before, after = self.hidden_px
        return (
            f"map {self.map}: {self.moved} of {self.keyframes} poses moved to where its points see them, by "
            f"{self.shift:.2%} of the distance and {self.turn_deg:.2f} degrees in the median; hidden blocks of points "
            f"are {before:.2f} -> {after:.2f} px from their pixels"
        )


def polished_submap(submap: Submap, folds: int = 5, seed: int = 0) -> tuple[Submap, Polish]:
    """The submap with the poses that its points bear out, and what that changed; itself where none is moved.

    Points, pixels and who observed what stay. `folds` is in how many turns blocks of wall are hidden.
    """
    keyframes, none = len(submap.keyframes), (float("nan"), float("nan"))
    if submap.weak_visibility:
        return submap, Polish(submap.id, keyframes, 0, none, left="its observations were guessed by these very poses")
    try:
        fold = submap_folds(submap, folds, seed)
    except InputError as error:
        return submap, Polish(submap.id, keyframes, 0, none, left=str(error))
    tried = [found for k in submap.keyframes if (found := _tried(k, submap, fold)) is not None]
    if not tried:
        reason = f"no keyframe observes {_LEAST} points in blocks of wall that can be hidden in turn"
        return submap, Polish(submap.id, keyframes, 0, none, left=reason)
    before = np.concatenate([t.before for t in tried])
    after = np.concatenate([t.after if t.better else t.before for t in tried])
    px = float(np.median(before)), float(np.median(after))
    moved = {t.old.name: t.new for t in tried if t.better}
    if not moved:
        left = f"hidden blocks of points ({px[0]:.2f} px) are brought no closer to their pixels by more than noise"
        return submap, Polish(submap.id, keyframes, 0, px, left=left)
    shift, turn = np.median([t.moved for t in tried if t.better], axis=0)
    polish = Polish(submap.id, keyframes, len(moved), px, float(shift), float(turn))
    return replace(submap, keyframes=tuple(moved.get(k.name, k) for k in submap.keyframes)), polish


@dataclass(frozen=True)
class _Tried:
    """A keyframe, and where its points put it; its hidden points' distance in pixels from where they were observed,
    (n,) each, at the pose as it was and at those found without them, and whether these are better."""

    old: Keyframe
    new: Keyframe
    before: np.ndarray
    after: np.ndarray
    better: bool
    moved: tuple[float, float]


def _tried(keyframe: Keyframe, submap: Submap, fold: np.ndarray) -> _Tried | None:
    """None where a keyframe has too few points to be judged by."""
    ids, points, pixels = submap.observed_points(keyframe)
    if len(ids) < _LEAST:
        return None
    camera, in_camera = keyframe.camera, keyframe.in_camera(points)
    before = np.linalg.norm(_off(camera, in_camera, pixels)[0], axis=1)
    after = before.copy()
    for hidden, seen in hidden_in_turn(fold[submap.rows_of(ids)[0]]):
        if seen.sum() < _LEAST_SEEN:
            return None
        step = _found(camera, in_camera[seen], pixels[seen])
        after[hidden] = np.linalg.norm(_off(camera, _moved(step, in_camera[hidden]), pixels[hidden])[0], axis=1)
    step = _found(camera, in_camera, pixels)
    new = replace(keyframe, cam_from_map=step @ keyframe.cam_from_map)
    shift = float(np.linalg.norm(new.center - keyframe.center)) / _size(in_camera)
    turn = float(np.degrees(Rotation.from_matrix(step[:3, :3]).magnitude()))
    return _Tried(keyframe, new, before, after, _is_better(before, after), (shift, turn))


def _is_better(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether hidden points (n,) come closer to their pixels by more than noise; wrong ones count alike."""
    cut = _CUT * _deviation(np.minimum(before, after))
    gain = np.minimum(before, cut) ** 2 - np.minimum(after, cut) ** 2
    error = float(gain.std()) * np.sqrt(_NEIGHBOURS / len(gain))
    return bool(gain.mean() > _NOISE * error)


def _found(camera: CameraModel, in_camera: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """exp(x) (4, 4), from points (n, 3) in camera axes to where they meet their pixels (n, 2) best."""
    size, found = _size(in_camera), np.eye(4)
    sides = _DIFFERENCE * size * np.eye(3)
    for _ in range(_ROUNDS):
        places = _moved(found, in_camera)
        off, seen = _off(camera, places, pixels)
        beside = [_off(camera, places + side, pixels) for side in sides]
        seen = np.all([seen, *(there for _, there in beside)], axis=0)
        by_shift = np.stack([(there - off) / _DIFFERENCE for there, _ in beside], 2)[seen]  # (m, 2, 3)
        slope = np.concatenate([np.cross(places[seen, None] / size, by_shift), by_shift], 2)  # turn, shift / size
        length = np.linalg.norm(off, axis=1)
        weight = robust_weights(length / _deviation(length) / _WIDTH)[seen]
        matrix = np.einsum("n,nki,nkj->ij", weight, slope, slope)
        right = np.einsum("n,nki,nk->i", weight, slope, off[seen])
        x = np.linalg.lstsq(matrix, -right, rcond=_LEAST_HELD)[0]
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), size * x[3:]
        found = step @ found
        if np.abs(x).max() < _STILL:
            break
    return found


def _size(in_camera: np.ndarray) -> float:
    """Median distance of points, map units."""
    return max(float(np.median(np.linalg.norm(in_camera, axis=1))), 1e-12)


def _deviation(lengths: np.ndarray) -> float:
    return max(float(np.median(lengths)) / _PER_MEDIAN, _LEAST_PX)


def _moved(step: np.ndarray, places: np.ndarray) -> np.ndarray:
    result: np.ndarray = places @ step[:3, :3].T + step[:3, 3]
    return result


def _off(camera: CameraModel, places: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) from where points were observed to where places (n, 3) are seen, and which are seen (n,)."""
    projected, seen = camera.project(places)
    off = projected - pixels
    seen = seen & np.isfinite(off).all(1)
    return np.where(seen[:, None], off, _BEHIND), seen
