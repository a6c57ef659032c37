"""Errors of a map that come together: neighbouring points, and whole stretches of the path, are wrong alike.

A SLAM seldom errs point by point. It loses its scale along the way, takes one fold for the next, closes a loop that is
none, and puts a whole side of the wall too far away. Each function here takes a submap whose truth is known and gives
one with such an error of a stated size; they compose in any order. `with_errors` applies what a MapErrors names.

What stays: the ids, who observed what, and the recorded pixels, which are what the camera saw. What moves: positions in
the map, of points, keyframes or both. So the ids say which points moved, and by how much. Rotations of keyframes
change under `pose_drift` and `wrong_loop` alone. Sizes have no unit: a factor, or a share of the submap's typical
distance D (lightdepth.sparse_map.typical_distance).

Notation: c_k, R_k a keyframe's centre and map_from_cam rotation, p a point, K(p) the keyframes that observed it (the
nearest one, where none did), t_k in [0, 1] how far along the path k stands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, overload

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lightdepth.ranges import SHARE, Range, at_least, checked
from lightdepth.sparse_map import Keyframe, SparseMap, Submap, typical_distance


@dataclass(frozen=True)
@checked
class MapErrors:
    """Errors of a map that neighbouring points share, each with its size; left as they are, there are none."""

    drift: Annotated[float, Range(0.1, 10)] = 1.0
    """Scale of each submap at the beginning of its path, as a factor of that at the end, from 0.1 to 10, changing
    steadily between; 1 is no drift. A larger one makes the beginning larger; below 1 it is smaller than the end."""
    side_share: Annotated[float, SHARE] = 0.0
    """Share, in [0, 1], of a submap's points, all on one side of the wall, whose distance from the keyframes that saw
    them is multiplied by side_factor. A larger one makes that side wider."""
    side_factor: Annotated[float, Range(0.1, 10)] = 1.3
    """Factor, from 0.1 to 10, on the distance of the points that side_share names. A larger one puts them farther away;
    below 1 they come nearer."""
    fold_share: Annotated[float, SHARE] = 0.0
    """Share, in [0, 1], of a submap's points, one patch of wall, that are put on the next fold, as if mistaken for it
    (see fold_shift). A larger one makes a larger patch."""
    fold_shift: Annotated[float, Range(-1000, 1000)] = 0.6
    """How far the patch of fold_share is moved ahead, as a share of the typical distance from a submap's keyframes to
    its points. A larger one moves it farther; below 0 it moves back."""
    loop_share: Annotated[float, SHARE] = 0.0
    """Length of a false loop, as a share, in [0, 1], of each submap's path: two places so far apart along it are taken
    for neighbours (see loop_shift); 0 closes none. A larger one makes a longer loop."""
    loop_shift: Annotated[float, SHARE] = 0.5
    """How far the second of the two places of loop_share is moved towards the first, as a share in [0, 1] of the way
    between them; 1 makes them one. A larger one bends the map more."""
    loop_at: Annotated[float | None, SHARE] = None
    """Where the first of the two places of loop_share is, as a share, in [0, 1], of the stretch of path where it can
    be; left out, it is drawn. A larger one closes the loop later on the path."""
    pose_drift: Annotated[float, at_least(0)] = 0.0
    """How far the last keyframe is from its true place, as a share of the path's length; the error grows along the
    path, from 0 at the first. A larger one bends the path more."""
    pose_drift_deg: Annotated[float, at_least(0)] = 0.0
    """How far the last keyframe is turned from its true direction, degrees; the error grows along the path, from 0 at
    the first. A larger one turns the keyframes more."""
    points_follow: bool = False
    """Whether points move along with the keyframes that saw them when these drift (pose_drift, pose_drift_deg), as in a
    real SLAM; switched off, they stay where they are, and the poses contradict them."""


@overload
def with_errors(map_or_submap: Submap, errors: MapErrors, seed: int) -> Submap: ...
@overload
def with_errors(map_or_submap: SparseMap, errors: MapErrors, seed: int) -> SparseMap: ...
def with_errors(map_or_submap: Submap | SparseMap, errors: MapErrors, seed: int) -> Submap | SparseMap:
    """The submap, or every submap of a map, with the errors; a seed draws each alike whatever the others are.

    The side, then the fold, then the loop, then the drift of poses, then that of scale: what is local first.
    """
    if isinstance(map_or_submap, SparseMap):
        return replace(map_or_submap, submaps=tuple(with_errors(s, errors, seed) for s in map_or_submap.submaps))
    submap = map_or_submap
    side, fold, poses, loop = np.random.default_rng([seed, submap.id, 2]).spawn(4)
    if errors.side_share > 0 and errors.side_factor != 1:
        submap = side_moved(submap, errors.side_share, errors.side_factor, side)
    if errors.fold_share > 0 and errors.fold_shift != 0:
        submap = wrong_fold(submap, errors.fold_share, errors.fold_shift, fold)
    if errors.loop_share > 0 and errors.loop_shift > 0:
        at = loop.random() if errors.loop_at is None else errors.loop_at
        submap = wrong_loop(submap, errors.loop_share, errors.loop_shift, at)
    if errors.pose_drift > 0 or errors.pose_drift_deg > 0:
        submap = pose_drift(submap, errors.pose_drift, errors.pose_drift_deg, errors.points_follow, poses)
    return submap if errors.drift == 1 else scale_drift(submap, errors.drift)


def moved_ids(before: SparseMap, after: SparseMap) -> dict[int, np.ndarray]:
    """Ids of the points that are elsewhere after errors, by submap id."""
    pairs = zip(before.submaps, after.submaps, strict=True)
    return {a.id: a.point_ids[(a.points != b.points).any(1)] for a, b in pairs}


def scale_drift(submap: Submap, start: float) -> Submap:
    """The scale of everything is s_k = start^(1 - t_k): `start` where the path begins, 1 where it ends.

    Steps of the path grow by the mean scale of their ends, c'_k+1 = c'_k + (s_k + s_k+1) / 2 (c_k+1 - c_k), and p' is
    the mean over K(p) of c'_k + s_k (p - c_k). Rotations stay, so that what one keyframe sees keeps its shape: no image
    can tell. A keyframe's points have the mean scale of those it shares them with, so that where every keyframe sees
    the same wall the drift is that of the path alone.
    """
    order, along = _path(submap)
    centers = np.stack([submap.keyframes[k].center for k in order])
    scale = start ** (1 - along)
    steps = (scale[1:] + scale[:-1])[:, None] / 2 * np.diff(centers, axis=0)
    moved = centers[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])

    def follow(k: int, points: np.ndarray) -> np.ndarray:
        result: np.ndarray = moved[k] + scale[k] * (points - centers[k])
        return result

    keyframes = list(submap.keyframes)
    for k, place in enumerate(order):
        keyframes[place] = _posed(keyframes[place], keyframes[place].cam_from_map[:3, :3], moved[k])
    return replace(submap, keyframes=tuple(keyframes), points=_followed(submap, order, follow))


def side_moved(submap: Submap, share: float, factor: float, rng: np.random.Generator) -> Submap:
    """A `share` of the points, one side of the wall, `factor` times as far from the keyframes that saw them.

    With c the mean centre of K(p) and z their mean way of looking, a point's side is the direction of p - c across z;
    the points nearest to a drawn direction move to c + factor (p - c). Poses stay.
    """
    center, ahead = _seen_from(submap)
    offset = submap.points - center
    across = offset - (offset * ahead).sum(1, keepdims=True) * ahead
    way = rng.standard_normal(3)
    way = way - (ahead @ way)[:, None] * ahead
    cosine = (_unit(across) * _unit(way)).sum(1)
    chosen = np.argsort(-cosine, kind="stable")[: round(share * len(offset))]
    return _moved(submap, chosen, (center + factor * offset)[chosen])


def wrong_fold(submap: Submap, share: float, shift: float, rng: np.random.Generator) -> Submap:
    """A `share` of the points, a patch of wall, on the next fold: `shift` D further along the way that K(p) look.

    The patch is what lies nearest to a drawn point. Poses stay.
    """
    ahead = _seen_from(submap)[1]
    middle = submap.points[rng.integers(len(submap.points))]
    away = np.linalg.norm(submap.points - middle, axis=1)
    chosen = np.argsort(away, kind="stable")[: round(share * len(away))]
    return _moved(submap, chosen, (submap.points + shift * typical_distance(submap) * ahead)[chosen])


def wrong_loop(submap: Submap, share: float, shift: float, at: float) -> Submap:
    """A loop is closed between keyframes i and j > i, `share` of the path apart: what i saw is taken for what j sees,
    one fold for the next, so that j is moved by `shift` of its way to i.

    What a pose graph makes of it (Dubbelman and Browning 2015, without scale): the turn is spread along the loop, then
    the gap that is left; what comes after j follows it rigidly, what comes before i stays. With G = (R_i R_j^T)^shift
    and u_k from 0 at i to 1 at j, steps turn by G^u, and what j lacks is added in proportion to u. A point goes to the
    mean of where K(p) carry it. Then points are fused: one that j saw is put onto the nearest that i saw within a tenth
    of D, each onto another; the rest of that wall is there twice. No bundle adjustment follows.
    """
    order, along = _path(submap)
    last = len(order) - 1
    if last < 1:
        return submap
    start = at * (1 - share)
    i = min(int(np.abs(along - start).argmin()), last - 1)
    j = max(int(np.abs(along - start - share).argmin()), i + 1)
    centers = np.stack([submap.keyframes[k].center for k in order])
    axes = np.stack([submap.keyframes[k].cam_from_map[:3, :3].T for k in order])  # map_from_cam
    whole = along[j] - along[i]
    u = ((along - along[i]) / whole).clip(0, 1) if whole > 0 else np.arange(-i, last + 1 - i).clip(0, j - i) / (j - i)
    turn = Rotation.from_rotvec(shift * u[:, None] * Rotation.from_matrix(axes[i] @ axes[j].T).as_rotvec()).as_matrix()
    steps = np.einsum("kij,kj->ki", (turn[1:] + turn[:-1]) / 2, np.diff(centers, axis=0))
    moved = centers[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])
    moved += u[:, None] * (centers[j] + shift * (centers[i] - centers[j]) - moved[j])

    def follow(k: int, points: np.ndarray) -> np.ndarray:
        result: np.ndarray = moved[k] + (points - centers[k]) @ turn[k].T
        return result

    keyframes = list(submap.keyframes)
    for k, place in enumerate(order.tolist()[i + 1 :], i + 1):
        keyframes[place] = _posed(keyframes[place], (turn[k] @ axes[k]).T, moved[k])
    seen = _seen(submap)[order]
    # Where nothing moves, rounding would.
    points = np.where(seen[i + 1 :].any(0)[:, None], _followed(submap, order, follow), submap.points)
    points = _fused(points, np.flatnonzero(seen[j] & ~seen[i]), np.flatnonzero(seen[i]), 0.1 * typical_distance(submap))
    return replace(submap, keyframes=tuple(keyframes), points=points)


def _fused(points: np.ndarray, rows: np.ndarray, onto: np.ndarray, reach: float) -> np.ndarray:
    """Points with those of `rows` put onto the nearest of `onto`, where each is the other's nearest and in reach."""
    if not len(rows) or not len(onto):
        return points
    away, nearest = cKDTree(points[onto]).query(points[rows])
    back = cKDTree(points[rows]).query(points[onto])[1]
    fused = (away <= reach) & (back[nearest] == np.arange(len(rows)))
    points = points.copy()
    points[rows[fused]] = points[onto[nearest[fused]]]
    return points


def pose_drift(submap: Submap, share: float, degrees: float, points_follow: bool, rng: np.random.Generator) -> Submap:
    """Keyframes leave their places, smoothly along the path, more and more: the last one by `share` of its length and
    by `degrees`, in ways that are drawn.

    Points stay where they are; with `points_follow`, p' is the mean over K(p) of where each keyframe carries it.
    """
    order, along = _path(submap)
    centers = np.stack([submap.keyframes[k].center for k in order])
    length = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    shift = share * length * along[:, None] * _wandering(len(order), rng)
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * along[:, None] * _wandering(len(order), rng)).as_matrix()

    def follow(k: int, points: np.ndarray) -> np.ndarray:
        result: np.ndarray = centers[k] + shift[k] + (points - centers[k]) @ turn[k].T
        return result

    keyframes = list(submap.keyframes)
    for k, place in enumerate(order):
        turned = keyframes[place].cam_from_map[:3, :3] @ turn[k].T
        keyframes[place] = _posed(keyframes[place], turned, centers[k] + shift[k])
    points = _followed(submap, order, follow) if points_follow else submap.points
    return replace(submap, keyframes=tuple(keyframes), points=points)


def _path(submap: Submap) -> tuple[np.ndarray, np.ndarray]:
    """Keyframes by number (k,), and how far along the path each stands, from 0 to 1; by count where nothing moves."""
    order = np.argsort([k.number for k in submap.keyframes], kind="stable")
    centers = np.stack([submap.keyframes[k].center for k in order])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))])
    if along[-1] == 0:
        along = np.arange(len(order), dtype=float)
    return order, along / max(along[-1], 1e-12)


def _seen(submap: Submap) -> np.ndarray:
    """(keyframes, points) bool; a point that no keyframe observed counts as seen by the nearest."""
    seen = np.zeros((len(submap.keyframes), len(submap.points)), bool)
    for row, keyframe in zip(seen, submap.keyframes, strict=True):
        places, held = submap.rows_of(keyframe.point_ids)
        row[places[held]] = True
    lonely = np.flatnonzero(~seen.any(0))
    if len(lonely):
        centers = np.stack([k.center for k in submap.keyframes])
        away = np.linalg.norm(submap.points[None, lonely] - centers[:, None], axis=-1)
        seen[away.argmin(0), lonely] = True
    return seen


def _seen_from(submap: Submap) -> tuple[np.ndarray, np.ndarray]:
    """Of each point, the mean centre of K(p) (n, 3) and the unit mean of the ways that they look (n, 3)."""
    seen = _seen(submap).T.astype(float)
    seen /= seen.sum(1, keepdims=True)
    centers = np.stack([k.center for k in submap.keyframes])
    looking = np.stack([k.cam_from_map[2, :3] for k in submap.keyframes])
    return seen @ centers, _unit(seen @ looking)


def _followed(submap: Submap, order: np.ndarray, follow: Callable[[int, np.ndarray], np.ndarray]) -> np.ndarray:
    """Points (n, 3): each the mean over K(p) of where `follow` carries it with the k-th keyframe of the path."""
    seen = _seen(submap)[order]
    total = np.zeros_like(submap.points, dtype=float)
    for k, row in enumerate(seen):
        total[row] += follow(k, submap.points[row])
    result: np.ndarray = total / seen.sum(0)[:, None]
    return result


def _moved(submap: Submap, chosen: np.ndarray, to: np.ndarray) -> Submap:
    points = submap.points.astype(float)  # a copy
    points[chosen] = to
    return replace(submap, points=points)


def _posed(keyframe: Keyframe, cam_from_map: np.ndarray, center: np.ndarray) -> Keyframe:
    """The keyframe with a rotation (3, 3) and a centre (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = cam_from_map
    pose[:3, 3] = -cam_from_map @ center
    return replace(keyframe, cam_from_map=pose)


def _wandering(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3), smooth along the path, of unit length where it ends."""
    end = _unit(rng.standard_normal((1, 3)))
    smooth = max(1.0, count / 6)
    walk = gaussian_filter1d(rng.standard_normal((count, 3)), smooth, axis=0) * np.sqrt(smooth)
    result: np.ndarray = end + 0.5 * (walk - walk[-1])
    return result


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Of vectors (n, 3); 0 stays 0."""
    result: np.ndarray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(min=1e-12)
    return result
