"""One submap of several that were joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from densify.joining.join import MergeConfig
from densify.joining.keyframes import moved_keyframe, same_pixels
from densify.similarity import Similarity
from lightdepth.sparse_map import Keyframe, Submap


def joined_submap(
    submaps: Sequence[Submap], to_first: Mapping[int, Similarity], joined_id: int, config: MergeConfig
) -> Submap:
    """One submap of several, in the frame and unit of the first. Points are numbered anew; those that two submaps saw
    at the same pixel of a shared frame, and have at the same place, become one. A frame is a keyframe once, with the
    pose of the first submap that has it and the observations of all."""
    keyframes: dict[int, Keyframe] = {}
    points = np.zeros((0, 3))
    for submap in submaps:
        own = submap.rows_of(np.concatenate([k.point_ids for k in submap.keyframes]))
        rows, held = (np.split(part, np.cumsum([len(k.point_ids) for k in submap.keyframes])[:-1]) for part in own)
        moved = to_first[submap.id].apply(submap.points)
        mine = [
            replace(moved_keyframe(k, to_first[submap.id]), pixels=k.pixels[h], point_ids=r[h])
            for k, r, h in zip(submap.keyframes, rows, held, strict=True)
        ]
        new_ids = len(points) + np.arange(len(moved))
        known = {k.number: keyframes[k.number] for k in mine if k.number in keyframes}
        for keyframe in mine:
            if keyframe.number in known:
                _take_over(new_ids, keyframe, moved, known[keyframe.number], points, config)
        points = np.concatenate([points, moved])
        for keyframe in mine:
            keyframe = replace(keyframe, point_ids=new_ids[keyframe.point_ids])
            keyframes[keyframe.number] = _together(known.get(keyframe.number), keyframe)
    kept = np.unique(np.concatenate([k.point_ids for k in keyframes.values()]))
    ordered = tuple(keyframes[number] for number in sorted(keyframes))
    weak = any(s.weak_visibility for s in submaps)
    return Submap(joined_id, ordered, kept, points[kept], weak, submaps[0].origin)


def _take_over(
    new_ids: np.ndarray, mine: Keyframe, moved: np.ndarray, other: Keyframe, points: np.ndarray, config: MergeConfig
) -> None:
    """Gives the points of one submap, rows of `moved`, the ids of those of another that a shared frame saw at the same
    pixel and that lie at the same place; no two of them the same."""
    if mine.camera != other.camera:
        return
    a, b = same_pixels(other.pixels, mine.pixels, config.same_pixel)
    theirs, ours = other.point_ids[a], mine.point_ids[b]
    distance = np.linalg.norm(other.in_camera(points[theirs]), axis=1)
    close = np.linalg.norm(points[theirs] - moved[ours], axis=1) <= config.tolerance * distance
    taken = set(new_ids[new_ids < len(points)].tolist())
    for row, new in zip(ours[close].tolist(), theirs[close].tolist(), strict=True):
        if new_ids[row] >= len(points) and new not in taken:
            new_ids[row] = new
            taken.add(new)


def _together(first: Keyframe | None, second: Keyframe) -> Keyframe:
    """The first, with what only the second observed; where the lenses differ, the first alone."""
    if first is None:
        return second
    fresh = ~np.isin(second.point_ids, first.point_ids) & (first.camera == second.camera)
    pixels, ids = (
        np.concatenate([getattr(first, part), getattr(second, part)[fresh]]) for part in ("pixels", "point_ids")
    )
    return replace(first, pixels=pixels, point_ids=ids)
