"""The four ways to find a join: by points and frames that both have, by points that look alike, by shape alone.

Each gives the join of two sides, one that says why they do not join, or None where there is nothing to compare.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from densify.joining.join import WAYS, Join
from densify.joining.keyframes import moved_keyframe, same_pixels
from densify.joining.looks import alike
from densify.joining.shape import correlation, icp, meeting_points
from densify.joining.side import Side
from densify.joining.surfaces import checked, ray_grid
from densify.similarity import Similarity, robust_similarity

_CHANCE = 4.5
"""Standard deviations of the correlation of unrelated points, 1 / sqrt(n), that a likeness must exceed: many poses are
tried, and the best of them is looked at."""


def by_points(target: Side, source: Side, rng: np.random.Generator) -> Join | None:
    shared = sorted(set(target.by_number) & set(source.by_number))
    pairs: set[tuple[int, int]] = set()
    for number in shared:
        a, b = target.by_number[number], source.by_number[number]
        if a.camera == b.camera:
            rows_a, rows_b = same_pixels(a.pixels, b.pixels, target.config.same_pixel)
            pairs |= set(zip(a.point_ids[rows_a].tolist(), b.point_ids[rows_b].tolist(), strict=True))
    if not shared:
        common = np.intersect1d(target.submap.point_ids, source.submap.point_ids).tolist()
        pairs = set(zip(common, common, strict=True))
    if not pairs:
        return None
    ids = np.array(sorted(pairs))
    (rows_a, held_a), (rows_b, held_b) = target.submap.rows_of(ids[:, 0]), source.submap.rows_of(ids[:, 1])
    rows_a, rows_b = rows_a[held_a & held_b], rows_b[held_a & held_b]
    join = _fitted(
        target,
        source,
        "points",
        target.submap.points[rows_a],
        source.submap.points[rows_b],
        target.distance[rows_a],
        rng,
        target.config.min_share,
    )
    if not shared and not join.ok:
        return None  # ids of maps that number their points alike mean nothing
    return _seen_alike(join, target, source, shared)


def by_frames(target: Side, source: Side, rng: np.random.Generator) -> Join | None:
    shared = sorted(set(target.by_number) & set(source.by_number))
    if not shared or not len(target.dense.triangles) or not len(source.dense.triangles):
        return None
    hits: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number in shared:
        a, b = target.by_number[number], source.by_number[number]
        rays = ray_grid(a.camera, 12)
        along_a, along_b = rays @ a.cam_from_map[:3, :3], rays @ b.cam_from_map[:3, :3]
        one, two = target.dense.surface.cast(a.center, along_a), source.dense.surface.cast(b.center, along_b)
        both = np.isfinite(one) & np.isfinite(two)
        on_a, on_b = a.center + one[both, None] * along_a[both], b.center + two[both, None] * along_b[both]
        hits.append((on_a, on_b, one[both]))
    on_a, on_b, distance = (np.concatenate(part) for part in zip(*hits, strict=True))
    join = _fitted(target, source, "frames", on_a, on_b, distance, rng, target.config.min_share)
    return _seen_alike(join, target, source, shared)


def by_looks(target: Side, source: Side, rng: np.random.Generator) -> Join | None:
    if target.frames is None:
        return None
    (rows_a, looks_a), (rows_b, looks_b) = target.looks, source.looks
    if min(len(looks_a), len(looks_b)) < 2:
        return None
    a, b = alike(rows_a, looks_a, rows_b, looks_b)
    ratio, size = target.reach / source.reach, target.config.max_size_ratio
    join = _fitted(
        target,
        source,
        "looks",
        target.submap.points[a],
        source.submap.points[b],
        target.distance[a],
        rng,
        target.config.min_alike_share,
        (ratio / size, ratio * size),
    )
    return checked(join, target, source, target.config.max_gap)


def by_surface(target: Side, source: Side, rng: np.random.Generator) -> Join | None:
    config = target.config
    join = Join(target.submap.id, source.submap.id, "surface")
    if min(len(s.dense.triangles) for s in (target, source)) < 500:
        return None
    to = target.shape(1.0)
    join = replace(join, reason="no pose in which the shapes fit")
    for ratio in config.size_ratios:
        own = source.shape(ratio)
        there, back = cKDTree(to.features).query(own.features)[1], cKDTree(own.features).query(to.features)[1]
        rows = np.flatnonzero(back[there] == np.arange(len(own.points)))
        near = np.full(len(rows), config.feature_radius / 2.5)
        found = robust_similarity(own.points[rows], to.points[there[rows]], near, rng, 4 * config.trials, (0.5, 2.0))
        if found is None:
            continue
        similarity = icp(found[0], to, own)
        met_to, met_own = meeting_points(similarity, to, own, config.grain)
        if len(met_to) < 20:
            continue
        unit, own_unit = (Similarity(s, np.eye(3), np.zeros(3)) for s in (target.reach, ratio / source.reach))
        join = replace(join, matches=len(rows), agreeing=int(found[1].sum()), reason="")
        join = replace(join, target_from_source=unit @ similarity @ own_unit)
        join = checked(join, target, source, config.max_shape_gap)
        likeness = correlation(to.tone[met_to], own.tone[met_own])
        least = max(config.min_likeness, _CHANCE / np.sqrt(len(met_to)))
        if join.ok and likeness < least and join.agreeing < config.min_shape_share * join.matches:
            reason = (
                f"{join.agreeing} of {join.matches} features agree, at least {config.min_shape_share:.0%}; nor do the"
            )
            reason += f" colours, with a correlation of {likeness:.2f}, at least {least:.2f}"
            join = replace(join, reason=reason)
        if join.ok:
            break
    return join


def _fitted(
    target: Side,
    source: Side,
    by: str,
    on_target: np.ndarray,
    on_source: np.ndarray,
    distance: np.ndarray,
    rng: np.random.Generator,
    min_share: float,
    scales: tuple[float, float] = (0.0, np.inf),
) -> Join:
    """The join of corresponding points (n, 3), `distance` (n,) from the target's camera."""
    config, n = target.config, len(on_target)
    join = Join(target.submap.id, source.submap.id, by, matches=n)
    if n < config.min_agreeing:
        return replace(join, reason=f"{n} correspondences; at least {config.min_agreeing}")
    found = robust_similarity(on_source, on_target, config.tolerance * distance, rng, config.trials, scales)
    agreeing = int(found[1].sum()) if found else 0
    if found is None or agreeing < config.min_agreeing or agreeing < min_share * n:
        needed = f"at least {config.min_agreeing} and {min_share:.0%}"
        return replace(join, agreeing=agreeing, reason=f"{agreeing} of {n} correspondences agree; {needed}")
    similarity, agrees = found
    error = np.linalg.norm(similarity.apply(on_source) - on_target, axis=1)[agrees] / distance[agrees]
    return replace(join, target_from_source=similarity, agreeing=agreeing, error=float(np.median(error)))


def _seen_alike(join: Join, target: Side, source: Side, shared: Sequence[int]) -> Join:
    """The join, unless the two poses of the shared frames contradict it, or the surfaces do."""
    if not join.ok:
        return join
    assert join.target_from_source is not None
    turns, shifts = [], []
    for number in shared:
        a = target.by_number[number]
        b = moved_keyframe(source.by_number[number], join.target_from_source)
        turns.append(np.rad2deg(Rotation.from_matrix(a.cam_from_map[:3, :3] @ b.cam_from_map[:3, :3].T).magnitude()))
        shifts.append(np.linalg.norm(a.center - b.center) / target.reach)
    config = target.config
    if shared and np.median(turns) > config.max_turn_deg:
        reason = f"the shared frames' poses differ by {np.median(turns):.1f} degrees; at most {config.max_turn_deg:g}"
        return replace(join, reason=reason)
    if shared and np.median(shifts) > config.max_shift:
        reason = f"the shared frames' places differ by {np.median(shifts):.0%} of the distance to the wall"
        return replace(join, reason=f"{reason}; at most {config.max_shift:.0%}")
    return checked(join, target, source, config.max_gap)


FINDERS: dict[str, Callable[[Side, Side, np.random.Generator], Join | None]] = dict(
    zip(WAYS, (by_points, by_frames, by_looks, by_surface), strict=True)
)
