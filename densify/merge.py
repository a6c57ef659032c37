"""Submaps that meet: those that see the same tissue are brought into one frame of reference and scale.

Notation: a join is the Sim(3) target_from_source, X_target = s R X_source + t. Each submap has its own unit; its
*reach* is a typical distance from its cameras to what they see, by which submaps of different units are compared.

What two submaps may have in common, the strongest first; each is tried between submaps that are not yet together:

points    map points that both know: seen at the same pixel of the same frame, or of the same id
frames    the same frame in both: its rays meet both surfaces
looks     map points that look alike: the descriptors of their surroundings in the images
surface   the shape of the surfaces alone: FPFH features, then ICP with scale, point to plane both ways

A join that chance could have made is refused: too few of the correspondences agree, shared cameras look elsewhere, or
the surfaces do not lie on each other where they should, or bear other colours. What is joined becomes a submap like any
other, and is made dense like any other: one surface, fused anew from all keyframes, with one scale for each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from densify.dense_map import DenseMap
from densify.evaluation import Similarity
from densify.pipeline import DensifyConfig, KeyframeView, Model, SubmapResult, densify, typical_distance
from densify.similarity import robust_similarity
from lightdepth import native
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.sparse_map import Keyframe, SparseMap, Submap

_CHANCE = 4.5
"""Standard deviations of the correlation of unrelated points, 1 / sqrt(n), that a likeness must exceed: many poses are
tried, and the best of them is looked at."""


@dataclass(frozen=True)
class MergeConfig:
    """When two submaps are one. Lengths on the surface are shares of the reach."""

    # What to join by, in this order. "surface", by shape alone, has to be asked for: chance can join what is apart.
    by: tuple[str, ...] = ("points", "frames", "looks")
    min_agreeing: int = 12  # correspondences
    min_share: float = 0.2  # of the correspondences of points and frames; 30 % wrong points in both maps leave 40 %
    min_alike_share: float = 0.1  # of the points that look alike, most of which only do so
    tolerance: float = 0.05  # correspondences agree within this share of the distance from the camera
    trials: int = 5000  # triples of correspondences tried
    same_pixel: float = 1.0  # px between two observations of one point
    max_turn_deg: float = 5.0  # between the two poses of a shared frame, median
    max_shift: float = 0.1  # the same for their places
    max_size_ratio: float = 3.0  # of the reaches, where no frame is shared
    size_ratios: tuple[float, ...] = (1.0, 0.7, 1.4)  # of the reaches, tried in turn by surface
    max_pairs: int = 60  # submaps compared by looks, and by surface; the nearest in time first
    grain: float = 0.06  # spacing of the points by which shapes are compared
    feature_radius: float = 0.25  # of an FPFH feature
    max_gap: float = 0.2  # between joined surfaces along common rays, median; their own errors are in it
    max_shape_gap: float = 0.05  # the same after joining by shape, which leaves less
    max_through: float = 0.15  # share of rays to one surface in whose way the other stands
    min_overlap: float = 0.3  # share of the rays of a camera that must meet both surfaces
    min_shape_share: float = 0.15  # of the features that must agree after joining by shape; chance gives 5 % at most
    # Or else the correlation of the finer colours; chance gives 0.06 at most, 2 degrees off no more.
    min_likeness: float = 0.1

    def __post_init__(self) -> None:
        unknown = set(self.by) - set(_FINDERS)
        if unknown:
            raise InputError(f"merging.by {', '.join(sorted(unknown))}; expected some of {', '.join(_FINDERS)}")


@dataclass(frozen=True)
class Agreement:
    """Two joined surfaces along the rays of the cameras that see both: the median gap over the distance, the share of
    a camera's rays that meet both, and the share on which the other surface stands in front."""

    gap: float
    overlap: float
    through: float


@dataclass(frozen=True)
class Join:
    """How one submap comes to another, or `reason`: why it does not. `agreeing` of `matches` correspondences are within
    the tolerance; `error` is their median distance over that from the camera."""

    target: int
    source: int
    by: str
    target_from_source: Similarity | None = None
    matches: int = 0
    agreeing: int = 0
    error: float = 0.0
    surfaces: Agreement | None = None
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason


@dataclass(frozen=True)
class Meeting:
    """What came of it: groups of submaps, each {id: group_from_submap} in the unit of its largest, which comes first;
    the joins that hold them together; and those refused between submaps that stayed apart."""

    groups: tuple[dict[int, Similarity], ...]
    joins: tuple[Join, ...]
    refused: tuple[Join, ...]

    def alone(self) -> dict[int, str]:
        """Submaps that found no other, with the reasons."""
        reasons = {}
        for group in self.groups:
            if len(group) == 1:
                (own,) = group
                tried = [j for j in self.refused if own in (j.target, j.source)]
                texts = [f"map {j.source if j.target == own else j.target} by {j.by}: {j.reason}" for j in tried]
                reasons[own] = "; ".join(texts) or "it has nothing that could be compared with another map"
        return reasons


def join_maps(
    maps: Sequence[DenseMap], frames: FrameSequence | None, config: MergeConfig, rng: np.random.Generator
) -> Meeting:
    """Brings together the submaps that see the same tissue. Without frames, or without surfaces, what needs them is
    not tried."""
    sides = {m.submap.id: _Side(m, frames, config) for m in maps}
    order = sorted(sides, key=lambda i: (-len(sides[i].submap.keyframes), i))
    group_of = {i: {i: Similarity.identity()} for i in order}
    joins: list[Join] = []
    refused: list[Join] = []
    for by in config.by:
        pairs = sorted(combinations(order, 2), key=lambda pair: _apart(sides[pair[0]], sides[pair[1]]))
        tried = 0
        for target, source in pairs:
            if group_of[target] is group_of[source]:
                continue
            tried += by in ("looks", "surface")
            if tried > config.max_pairs:
                refused.append(Join(target, source, by, reason=f"not compared, beyond max_pairs {config.max_pairs}"))
                continue
            join: Join | None
            try:
                join = _FINDERS[by](sides[target], sides[source], rng)
            except InputError as error:  # a map without observations, say: the others go on
                join = Join(target, source, by, reason=str(error))
            if join is None:
                continue
            if not join.ok:
                refused.append(join)
                continue
            joins.append(join)
            assert join.target_from_source is not None
            first, second = group_of[target], group_of[source]
            link = first[target] @ join.target_from_source @ second[source].inverse()
            first.update({i: link @ own for i, own in second.items()})
            group_of.update(dict.fromkeys(second, first))
    groups = list({id(g): g for g in group_of.values()}.values())
    apart = [j for j in refused if group_of[j.target] is not group_of[j.source]]
    return Meeting(tuple(_to_largest(g, order) for g in groups), tuple(joins), tuple(apart))


def _to_largest(group: dict[int, Similarity], order: Sequence[int]) -> dict[int, Similarity]:
    first = next(i for i in order if i in group)
    back = group[first].inverse()
    return {first: Similarity.identity(), **{i: back @ s for i, s in group.items() if i != first}}


@dataclass(frozen=True)
class Merged:
    """How the submaps met, and the surface of each group of several, its submap numbered by its place in `results`."""

    meeting: Meeting
    results: tuple[SubmapResult, ...]

    @property
    def groups(self) -> list[dict[int, Similarity]]:
        return [g for g in self.meeting.groups if len(g) > 1]

    def record(self, unit: float = 1.0) -> dict[str, Any]:
        """For run.json. A transform is as `evaluate --join` reads it: X_second = scale · rotation X_first +
        translation, where a map's unit is written as `unit`."""
        joined = []
        for result, group in zip(self.results, self.groups, strict=True):
            first = next(iter(group))
            transforms = [{"first": i, "second": first, **_numbers(s, unit)} for i, s in group.items() if i != first]
            joined.append({"folder": joined_name(result), "maps": list(group), "unit_of": first})
            joined[-1]["transforms"] = transforms
        joins = [{**asdict(replace(j, target_from_source=None)), "ok": j.ok} for j in self.tried]
        return {"joined": joined, "joins": joins, "alone": self.meeting.alone()}

    @property
    def tried(self) -> tuple[Join, ...]:
        return *self.meeting.joins, *self.meeting.refused


def joined_name(result: SubmapResult) -> str:
    return f"joined_{result.dense.submap.id:03d}"


def _numbers(s: Similarity, unit: float) -> dict[str, Any]:
    return {"scale": s.scale, "rotation": s.rotation.tolist(), "translation": (unit * s.translation).tolist()}


def merge(
    results: Sequence[SubmapResult],
    frames: FrameSequence,
    model: Model,
    recipe: DensifyConfig,
    config: MergeConfig,
    on_keyframe: Callable[[KeyframeView], None] | None = None,
) -> Merged:
    """Joins the submaps of a run, and makes each group of several dense as one."""
    rng = np.random.default_rng([recipe.seed, 2])
    by_id = {r.dense.submap.id: r.dense.submap for r in results}
    meeting = join_maps([r.dense for r in results], frames, config, rng)
    groups = [g for g in meeting.groups if len(g) > 1]
    submaps = tuple(joined_submap([by_id[i] for i in g], g, k, config) for k, g in enumerate(groups))
    if not submaps:
        return Merged(meeting, ())
    joined = densify(frames, SparseMap(submaps, "joined maps"), model, recipe, on_keyframe)
    return Merged(meeting, tuple(joined))


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
    return Submap(joined_id, ordered, kept, points[kept], any(s.weak_visibility for s in submaps))


def _take_over(
    new_ids: np.ndarray, mine: Keyframe, moved: np.ndarray, other: Keyframe, points: np.ndarray, config: MergeConfig
) -> None:
    """Gives the points of one submap, rows of `moved`, the ids of those of another that a shared frame saw at the same
    pixel and that lie at the same place; no two of them the same."""
    if mine.camera != other.camera:
        return
    a, b = _same_pixels(other.pixels, mine.pixels, config.same_pixel)
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


def moved_keyframe(keyframe: Keyframe, similarity: Similarity) -> Keyframe:
    """The keyframe in the frame and unit that the similarity leads to: what it sees stays where it was in its image."""
    pose = np.eye(4)
    pose[:3, :3] = keyframe.cam_from_map[:3, :3] @ similarity.rotation.T
    pose[:3, 3] = similarity.scale * keyframe.cam_from_map[:3, 3] - pose[:3, :3] @ similarity.translation
    return replace(keyframe, cam_from_map=pose)


# ---- one submap, as it is compared


@dataclass(frozen=True, eq=False)
class _Side:
    """A submap with its surface and images; what is compared of it is worked out once, when first asked for."""

    dense: DenseMap
    frames: FrameSequence | None
    config: MergeConfig

    @property
    def submap(self) -> Submap:
        return self.dense.submap

    @cached_property
    def reach(self) -> float:
        return typical_distance(self.submap)

    @cached_property
    def by_number(self) -> dict[int, Keyframe]:
        return {k.number: k for k in self.submap.keyframes}

    @cached_property
    def distance(self) -> np.ndarray:
        """Of each point (n,) from the nearest camera that observed it; from the nearest of all where none did."""
        result = np.full(len(self.submap.points), np.inf)
        for keyframe in self.submap.keyframes:
            ids, points, _ = self.submap.observed_points(keyframe)
            rows = self.submap.rows_of(ids)[0]
            np.minimum.at(result, rows, np.linalg.norm(points - keyframe.center, axis=1))
        centers = np.array([k.center for k in self.submap.keyframes])
        return np.where(np.isfinite(result), result, cKDTree(centers).query(self.submap.points)[0])

    @cached_property
    def some_keyframes(self) -> list[Keyframe]:
        chosen = np.unique(np.linspace(0, len(self.submap.keyframes) - 1, 8).astype(int))
        return [self.submap.keyframes[i] for i in chosen]

    @cached_property
    def looks(self) -> tuple[np.ndarray, np.ndarray]:
        return _descriptors(self)

    def shape(self, ratio: float) -> _Shape:
        if ratio not in self._shapes:
            self._shapes[ratio] = _shape(self.dense, self.reach / ratio, self.config)
        return self._shapes[ratio]

    @cached_property
    def _shapes(self) -> dict[float, _Shape]:
        return {}


def _apart(one: _Side, other: _Side) -> int:
    """Frames between two submaps; 0 where their times overlap."""
    (a0, a1), (b0, b1) = ((min(s.by_number), max(s.by_number)) for s in (one, other))
    return max(0, b0 - a1, a0 - b1)


# ---- points and frames that both have


def _by_points(target: _Side, source: _Side, rng: np.random.Generator) -> Join | None:
    shared = sorted(set(target.by_number) & set(source.by_number))
    pairs: set[tuple[int, int]] = set()
    for number in shared:
        a, b = target.by_number[number], source.by_number[number]
        if a.camera == b.camera:
            rows_a, rows_b = _same_pixels(a.pixels, b.pixels, target.config.same_pixel)
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


def _by_frames(target: _Side, source: _Side, rng: np.random.Generator) -> Join | None:
    shared = sorted(set(target.by_number) & set(source.by_number))
    if not shared or not len(target.dense.triangles) or not len(source.dense.triangles):
        return None
    hits: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number in shared:
        a, b = target.by_number[number], source.by_number[number]
        rays = _rays(a.camera, 12)
        along_a, along_b = rays @ a.cam_from_map[:3, :3], rays @ b.cam_from_map[:3, :3]
        one, two = target.dense.surface.cast(a.center, along_a), source.dense.surface.cast(b.center, along_b)
        both = np.isfinite(one) & np.isfinite(two)
        on_a, on_b = a.center + one[both, None] * along_a[both], b.center + two[both, None] * along_b[both]
        hits.append((on_a, on_b, one[both]))
    on_a, on_b, distance = (np.concatenate(part) for part in zip(*hits, strict=True))
    join = _fitted(target, source, "frames", on_a, on_b, distance, rng, target.config.min_share)
    return _seen_alike(join, target, source, shared)


def _same_pixels(one: np.ndarray, other: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of pixels (n, 2) and (m, 2) that are each other's nearest, at most `reach` apart."""
    if not len(one) or not len(other):
        return np.zeros(0, int), np.zeros(0, int)
    distance, there = cKDTree(other).query(one)
    back = cKDTree(one).query(other)[1]
    rows = np.flatnonzero((back[there] == np.arange(len(one))) & (distance <= reach))
    return rows, there[rows]


def _fitted(
    target: _Side,
    source: _Side,
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


def _seen_alike(join: Join, target: _Side, source: _Side, shared: Sequence[int]) -> Join:
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
    return _checked(join, target, source, config.max_gap)


# ---- points that look alike


def _by_looks(target: _Side, source: _Side, rng: np.random.Generator) -> Join | None:
    if target.frames is None:
        return None
    (rows_a, looks_a), (rows_b, looks_b) = target.looks, source.looks
    if min(len(looks_a), len(looks_b)) < 2:
        return None
    a, b = _alike(rows_a, looks_a, rows_b, looks_b)
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
    return _checked(join, target, source, target.config.max_gap)


def _descriptors(side: _Side, per_point: int = 3, window: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points (n,) and SIFT descriptors (n, 128) of their surroundings, in up to per_point of their keyframes.

    The distance of a point tells how large its surroundings are in the image, and their brightness which way is up, so
    that neither has to be guessed: `window` is the feature's size, in shares of the reach.
    """
    assert side.frames is not None
    seen = np.zeros(len(side.submap.points), int)
    rows, looks = [], []
    sift = cv2.SIFT.create()
    for keyframe in side.submap.keyframes[::2] if len(side.submap.keyframes) > 8 else side.submap.keyframes:
        ids, points, pixels = side.submap.observed_points(keyframe)
        own = side.submap.rows_of(ids)[0]
        wanted = seen[own] < per_point
        try:
            frame = side.frames.by_number(keyframe.number)
            frame = None if frame is None else replace(frame, camera=keyframe.camera)
        except InputError:  # unreadable, or of another size: its reason is in keyframes.csv
            continue
        if frame is None or not wanted.any():
            continue
        own, points, pixels = own[wanted], points[wanted], pixels[wanted]
        grey = cv2.cvtColor((frame.image * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        distance = np.linalg.norm(keyframe.in_camera(points), axis=1)
        sizes = (window * keyframe.camera.focal_length * side.reach / distance.clip(min=1e-9)).clip(2, 40)
        wished = [
            cv2.KeyPoint(float(x - 0.5), float(y - 0.5), float(size), _upwards(grey, x, y, 3 * size), 1, 0, i)
            for i, ((x, y), size) in enumerate(zip(pixels, sizes, strict=True))
        ]
        features, found = sift.compute(grey, wished)
        if found is None:
            continue
        index = [f.class_id for f in features]
        seen[own[index]] += 1
        rows.append(own[index])
        looks.append(np.sqrt(found / found.sum(1, keepdims=True).clip(min=1e-9)))  # RootSIFT
    if not rows:
        return np.zeros(0, int), np.zeros((0, 128), np.float32)
    return np.concatenate(rows), np.concatenate(looks).astype(np.float32)


def _upwards(grey: np.ndarray, x: float, y: float, radius: float) -> float:
    """Direction [degrees] from the pixel (x, y) to the centre of brightness of the disc around it (Rosin 1999)."""
    x0, x1 = max(0, int(x - radius)), min(grey.shape[1], int(x + radius) + 1)
    y0, y1 = max(0, int(y - radius)), min(grey.shape[0], int(y + radius) + 1)
    part = grey[y0:y1, x0:x1].astype(np.float32)
    dx, dy = np.arange(x0, x1) + 0.5 - x, np.arange(y0, y1)[:, None] + 0.5 - y
    part = part * (dx**2 + dy**2 <= radius**2)
    return float(np.rad2deg(np.arctan2((part * dy).sum(), (part * dx).sum())) % 360)


def _alike(
    rows_a: np.ndarray, looks_a: np.ndarray, rows_b: np.ndarray, looks_b: np.ndarray, ratio: float = 0.9
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points of either side that look alike, each the other's likeliest, and clearly so."""

    def likeliest(
        looks: np.ndarray, others: np.ndarray, rows: np.ndarray, other_rows: np.ndarray
    ) -> dict[int, tuple[float, int]]:
        best: dict[int, tuple[float, int]] = {}
        for matches in cv2.BFMatcher(cv2.NORM_L2).knnMatch(looks, others, k=6):
            first = matches[0]
            point = int(other_rows[first.trainIdx])
            rival = next((m.distance for m in matches[1:] if other_rows[m.trainIdx] != point), np.inf)
            row = int(rows[first.queryIdx])
            if first.distance < ratio * rival and first.distance < best.get(row, (np.inf, 0))[0]:
                best[row] = (first.distance, point)
        return best

    forward, back = likeliest(looks_a, looks_b, rows_a, rows_b), likeliest(looks_b, looks_a, rows_b, rows_a)
    pairs = [(a, b) for a, (_, b) in sorted(forward.items()) if back.get(b, (0.0, -1))[1] == a]
    found = np.array(pairs, int).reshape(-1, 2)
    return found[:, 0], found[:, 1]


# ---- shape


@dataclass(frozen=True)
class _Shape:
    """A surface in units of its reach: points (n, 3), normals (n, 3), FPFH features (n, 33), and the tone (n,), which
    is how much brighter a point is than its surroundings."""

    points: np.ndarray
    normals: np.ndarray
    features: np.ndarray
    tone: np.ndarray
    tree: cKDTree


def _shape(dense: DenseMap, unit: float, config: MergeConfig) -> _Shape:
    o3d = native.open3d()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(dense.vertices / unit), o3d.utility.Vector3iVector(dense.triangles)
    )
    mesh.compute_vertex_normals()
    cloud = o3d.geometry.PointCloud(mesh.vertices)
    cloud.normals, cloud.colors = mesh.vertex_normals, o3d.utility.Vector3dVector(dense.colors)
    brightness = np.log(dense.colors.mean(1) + 0.02)
    fine = cKDTree(dense.vertices / unit)
    cloud = cloud.voxel_down_sample(config.grain)
    points = np.asarray(cloud.points)
    search = o3d.geometry.KDTreeSearchParamHybrid(config.feature_radius, 100)
    features = np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data).T
    normals = np.asarray(cloud.normals)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-9)
    near = fine.query(points, k=min(64, len(dense.vertices)))[1]
    tone = brightness[near[:, :4]].mean(1) - brightness[near].mean(1)
    return _Shape(points, normals, features, tone, cKDTree(points))


def _by_surface(target: _Side, source: _Side, rng: np.random.Generator) -> Join | None:
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
        similarity = _closest(found[0], to, own)
        met_to, met_own = _meeting_points(similarity, to, own, config.grain)
        if len(met_to) < 20:
            continue
        unit, own_unit = (Similarity(s, np.eye(3), np.zeros(3)) for s in (target.reach, ratio / source.reach))
        join = replace(join, matches=len(rows), agreeing=int(found[1].sum()), reason="")
        join = replace(join, target_from_source=unit @ similarity @ own_unit)
        join = _checked(join, target, source, config.max_shape_gap)
        likeness = _correlation(to.tone[met_to], own.tone[met_own])
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


def _closest(similarity: Similarity, to: _Shape, own: _Shape) -> Similarity:
    """ICP with scale: the Sim(3) near the given one with the least robust distance between points of either surface
    and the tangent planes of the other. Both ways, since one way alone would shrink."""
    for reach in (0.2, 0.1, 0.05):
        for _ in range(15):
            moved, turned = similarity.apply(own.points), own.normals @ similarity.rotation.T
            there = to.tree.query(moved, distance_upper_bound=reach)
            back = own.tree.query(similarity.inverse().apply(to.points), distance_upper_bound=reach / similarity.scale)
            met, met_back = np.isfinite(there[0]), np.isfinite(back[0])
            i, j = there[1][met], back[1][met_back]
            p, q = np.concatenate([moved[met], moved[j]]), np.concatenate([to.points[i], to.points[met_back]])
            n = np.concatenate([to.normals[i], turned[j]])
            facing = (n * np.concatenate([turned[met], to.normals[met_back]])).sum(1) > 0.5
            p, q, n = p[facing], q[facing], n[facing]
            if len(p) < 20:
                return similarity
            off = ((q - p) * n).sum(1)
            weight = 1 / (1 + (4 * off / reach) ** 2) ** 2  # Geman and McClure
            middle = p.mean(0)
            arms = p - middle
            slopes = np.concatenate([np.cross(arms, n), n, (arms * n).sum(1)[:, None]], 1)
            normal = (slopes * weight[:, None]).T @ slopes
            step = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(7), (slopes * weight[:, None]).T @ off)
            turn, grow = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
            similarity = Similarity(grow, turn, middle + step[3:6] - grow * turn @ middle) @ similarity
            if np.abs(step).max() < 1e-4:
                break
    return similarity


def _meeting_points(similarity: Similarity, to: _Shape, own: _Shape, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points of either surface that lie on each other."""
    distance, there = to.tree.query(similarity.apply(own.points), distance_upper_bound=reach)
    met = np.isfinite(distance)
    return there[met], np.flatnonzero(met)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    a, b = one - one.mean(), other - other.mean()
    return float((a * b).sum() / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12))


# ---- whether the surfaces agree


def _rays(camera: CameraModel, stride: int) -> np.ndarray:
    """Unit rays (n, 3) of a grid of the camera's pixels."""
    rays, valid = camera.rays()
    return rays[stride // 2 :: stride, stride // 2 :: stride][valid[stride // 2 :: stride, stride // 2 :: stride]]


def surfaces_agree(target: _Side, source: _Side, similarity: Similarity) -> Agreement | None:
    """How two surfaces lie to each other, as some keyframes of both see them; None where no camera sees enough of
    both."""
    rays_seen = []
    own_from = {0: Similarity.identity(), 1: similarity.inverse()}
    for side, sim in ((target, Similarity.identity()), (source, similarity)):
        for keyframe in side.some_keyframes:
            posed = moved_keyframe(keyframe, sim)
            along = _rays(keyframe.camera, max(4, keyframe.camera.width // 40)) @ posed.cam_from_map[:3, :3]
            hits = []
            for k, other in enumerate((target, source)):
                to_other = own_from[k]
                origin = to_other.apply(posed.center[None])[0]
                hits.append(other.dense.surface.cast(origin, along @ to_other.rotation.T) / to_other.scale)
            own, far = hits if side is target else hits[::-1]
            rays_seen.append((own, far))
    return _agreement(rays_seen, target.config.min_overlap)


def _agreement(rays_seen: Sequence[tuple[np.ndarray, np.ndarray]], min_overlap: float) -> Agreement | None:
    overlap = [np.isfinite(far[np.isfinite(own)]).mean() if np.isfinite(own).any() else 0.0 for own, far in rays_seen]
    chosen = [r for r, share in zip(rays_seen, overlap, strict=True) if share >= min_overlap]
    if not chosen:
        return None
    own, far = (np.concatenate(part) for part in zip(*chosen, strict=True))
    both = np.isfinite(own) & np.isfinite(far)
    ratio = far[both] / own[both]
    return Agreement(float(np.median(np.abs(ratio - 1))), float(max(overlap)), float((ratio < 0.75).mean()))


def _checked(join: Join, target: _Side, source: _Side, max_gap: float) -> Join:
    """The join, unless the surfaces contradict it; where either map has none, they cannot."""
    if not join.ok or not len(target.dense.triangles) or not len(source.dense.triangles):
        return join
    assert join.target_from_source is not None
    config, found = target.config, surfaces_agree(target, source, join.target_from_source)
    if found is None:
        if join.by == "points":  # they may have met at their ends
            return join
        return replace(join, reason=f"no camera sees {config.min_overlap:.0%} of one surface on the other")
    join = replace(join, surfaces=found)
    if found.gap > max_gap:
        return replace(join, reason=f"the surfaces are {found.gap:.1%} of the distance apart; at most {max_gap:.0%}")
    if found.through > config.max_through:
        reason = f"one surface stands in the way of {found.through:.0%} of the rays to the other"
        return replace(join, reason=f"{reason}; at most {config.max_through:.0%}")
    return join


_FINDERS: dict[str, Callable[[_Side, _Side, np.random.Generator], Join | None]] = {
    "points": _by_points,
    "frames": _by_frames,
    "looks": _by_looks,
    "surface": _by_surface,
}
