"""A monocular SLAM's view of a synthetic colon: submaps with noise and known wrong points.

Two kinds. "tracked" errs as stella_vslam does on such colons (lightdepth.tube.tracked): a keyframe every 10 to 20
frames, short tracks, errors that neighbours share, few wrong points, a scale that drifts. "independent" is a stress
test that no SLAM is: thousands of observations a keyframe, each point wrong on its own, three in ten altogether.

Notation: a submap's frame is related to the world [mm] by X_map = scale · R X_world + t. Distances in mm unless "map".
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.ranges import BELOW_ONE, COUNT, SHARE, above, at_least, checked
from lightdepth.sparse_map import Keyframe, SparseMap, Submap
from lightdepth.tube.breathing import Breathing
from lightdepth.tube.map_errors import scale_drift
from lightdepth.tube.observed import points_at_corners, projected, sees, true_pose
from lightdepth.tube.tracked import at, distance_factors, tracks, wrong_factors

Kind = Literal["tracked", "independent"]


@dataclass(frozen=True)
@checked
class SlamConfig:
    """How good the simulated SLAM is; the values of settings that are left out depend on its kind."""

    kind: Kind = "tracked"
    """Which SLAM is simulated: tracked errs as a real one does (short tracks, errors that neighbouring points share),
    independent is a stress test with many points, each wrong on its own."""
    keyframe_every: Annotated[int | None, COUNT] = None
    """Number of frames from one keyframe to the next; left out, drawn from 10 to 20 each time (tracked), or 2
    (independent). More make fewer keyframes."""
    maps: Annotated[int, at_least(1, up_to=10_000)] = 2
    """Number of submaps, each a stretch of the path with a scale and origin of its own. More make shorter submaps."""
    shared_keyframes: Annotated[int, at_least(0, up_to=10_000)] = 2
    """Number of keyframes at its beginning that a submap has in common with the one before it. More make submaps easier
    to join."""
    points_per_keyframe: Annotated[int | None, COUNT] = None
    """Largest number of points that each keyframe observes (tracked; left out, 250 to 1500, drawn for each submap) or
    adds to those before (independent; left out, 250). More make a denser map."""
    spurious: Annotated[float | None, BELOW_ONE] = None
    """Share of the map points, in [0, 1), that are wrong: at least 1.3 times too far, or with tracked also too near;
    left out, 0.03 (tracked) or 0.3 (independent). A larger one makes the map harder to densify."""
    point_noise: Annotated[float | None, at_least(0, up_to=10)] = None
    """Error of the other points' distance, as a share of it: the median size (tracked; left out, 0.035), or the
    standard deviation at 20 mm, which grows in proportion to distance (independent; left out, 0.01). A larger one makes
    a noisier map."""
    shared_noise: Annotated[float, SHARE] = 0.3
    """Share, in [0, 1], of the variance of point_noise that neighbouring points have in common; only with tracked. A
    larger one makes whole pieces of wall wrong together."""
    shared_length_mm: Annotated[float, above(0)] = 6.0
    """Distance, mm, at which the error that points have in common (shared_noise) is still correlated by 0.6; only with
    tracked. A larger one makes larger pieces of wall wrong together."""
    drift: Annotated[float | None, at_least(0, up_to=10)] = None
    """Change of a submap's scale from one end of its path to the other, as a share, at random growing or shrinking;
    left out, 0.04 (tracked) or 0 (independent). A larger one makes the two ends more unlike in size."""
    pixel_noise: Annotated[float, at_least(0)] = 0.5
    """Standard deviation of the error of where a point is observed in the image, along each axis, pixels. A larger one
    makes noisier observations."""
    pose_noise_mm: Annotated[float, at_least(0)] = 0.05
    """Standard deviation of the error of a keyframe's place, along each axis, mm. A larger one makes noisier poses."""
    pose_noise_deg: Annotated[float, at_least(0)] = 0.05
    """Standard deviation of the error of a keyframe's rotation, about each axis, degrees. A larger one makes noisier
    poses."""


class _Settings(NamedTuple):
    """What a kind takes for what is left out; None is drawn."""

    keyframe_every: int | None
    points: int | None
    spurious: float
    point_noise: float
    drift: float

    @classmethod
    def of(cls, config: SlamConfig) -> _Settings:
        usual = _USUAL[config.kind]
        return cls(
            usual.keyframe_every if config.keyframe_every is None else config.keyframe_every,
            usual.points if config.points_per_keyframe is None else config.points_per_keyframe,
            usual.spurious if config.spurious is None else config.spurious,
            usual.point_noise if config.point_noise is None else config.point_noise,
            usual.drift if config.drift is None else config.drift,
        )


_USUAL: dict[Kind, _Settings] = {
    "tracked": _Settings(None, None, 0.03, 0.035, 0.04),
    "independent": _Settings(2, 250, 0.3, 0.01, 0.0),
}
_GAPS, _POINTS = (10, 20), (250, 1500)


@dataclass(frozen=True)
class SimulatedSlam:
    """The map, and what only the simulation knows: map_from_world (scale, rotation (3, 3), translation (3,)) and the
    ids of the wrong points, both by submap id. Where scale drifts, map_from_world has that of the path's middle."""

    map: SparseMap
    map_from_world: dict[int, tuple[float, np.ndarray, np.ndarray]]
    spurious_ids: dict[int, np.ndarray]


def simulate_slam(
    frames: Sequence[Frame], config: SlamConfig, seed: int, breathing: Breathing | None = None
) -> SimulatedSlam:
    """Keyframes of frames with truth, corners as points, and each submap in a frame and scale of its own.

    A wrong point is moved along the ray of the keyframe that made it, by a factor of 1.3 + Exp(4) (independent), or of
    the mean ray of those that observed it, by one beyond 1.3 either way (tracked). A wall that is `breathing` carries
    its points along, and the map has them where they were in the mean of the keyframes that observed them; an
    independent SLAM knows no such wall.
    """
    if breathing is not None and config.kind == "independent":
        raise InputError("--breathing.amplitude", "an independent SLAM", "expected --slam.kind tracked")
    check_enough_frames(len(frames), config, seed)
    settings = _Settings.of(config)
    rng = np.random.default_rng([seed, 1])
    keyframes = [frames[i] for i in _places(len(frames), settings.keyframe_every, rng)]
    submaps, sims, wrong = [], {}, {}
    for map_id, part in enumerate(_parts(len(keyframes), config.maps, config.shared_keyframes)):
        chosen = [keyframes[i] for i in part]
        submap, sims[map_id], wrong[map_id] = _submap(map_id, chosen, config, settings, rng, breathing)
        if settings.drift > 0:
            submap, sims[map_id] = _drifting(submap, chosen, sims[map_id], settings.drift, rng)
        submaps.append(submap)
    return SimulatedSlam(SparseMap(tuple(submaps), "simulated SLAM"), sims, wrong)


def least_frames(config: SlamConfig, seed: int) -> int:
    """The number of frames from which on there are two keyframes for each submap."""
    every, needed = _Settings.of(config).keyframe_every, 2 * config.maps

    def enough(count: int) -> bool:
        return len(_places(count, every, np.random.default_rng([seed, 1]))) >= needed

    return bisect_left(range((needed - 1) * (every or _GAPS[1]) + 1), True, key=enough)  # the last one always is


def check_enough_frames(count: int, config: SlamConfig, seed: int) -> None:
    """Raises InputError where `count` frames are too few, and says how many do."""
    least = least_frames(config, seed)
    if count < least:
        raise InputError(
            f"{count} frames",
            f"too few for {config.maps} submaps of two keyframes each",
            f"expected at least {least} (--frames {least}), keyframes closer together (--slam.keyframe-every), "
            "or fewer submaps (--slam.maps)",
        )


def _places(count: int, every: int | None, rng: np.random.Generator) -> list[int]:
    """Which of `count` frames are keyframes."""
    if every is not None:
        return list(range(0, count, every))
    (own,) = rng.spawn(1)
    places = np.cumsum([0, *own.integers(*_GAPS, count // _GAPS[0], endpoint=True)])
    return [i for i in places.tolist() if i < count]


def _parts(count: int, maps: int, shared: int) -> list[range]:
    bounds = np.linspace(0, count, maps + 1).astype(int)
    return [range(max(0, a - (shared if a else 0)), b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]


_Similarity = tuple[float, np.ndarray, np.ndarray]


def _submap(
    map_id: int,
    frames: list[Frame],
    config: SlamConfig,
    settings: _Settings,
    rng: np.random.Generator,
    breathing: Breathing | None,
) -> tuple[Submap, _Similarity, np.ndarray]:
    """The submap, map_from_world, and the ids of its wrong points."""
    if config.kind == "tracked":
        observed = _tracked(frames, config, settings, rng, breathing)
    else:
        observed = _independent(frames, config, settings, rng)
    world, seen, origin, factor, pixels, wrong = observed
    noisy = origin + factor[:, None] * (world - origin)

    scale = float(np.exp(rng.uniform(np.log(0.02), np.log(0.5))))
    rotation = Rotation.random(rng=rng).as_matrix()
    translation = rng.normal(0, 2, 3)
    ids = np.arange(len(world))
    keyframes = []
    for frame, row, pixel in zip(frames, seen, pixels, strict=True):
        world_from_cam = true_pose(frame).copy()
        turn = Rotation.from_rotvec(np.deg2rad(config.pose_noise_deg) * rng.standard_normal(3)).as_matrix()
        world_from_cam[:3, :3] = world_from_cam[:3, :3] @ turn
        world_from_cam[:3, 3] += config.pose_noise_mm * rng.standard_normal(3)
        map_from_cam = np.eye(4)
        map_from_cam[:3, :3] = rotation @ world_from_cam[:3, :3]
        map_from_cam[:3, 3] = scale * rotation @ world_from_cam[:3, 3] + translation
        cam_from_map = np.linalg.inv(map_from_cam)
        keyframes.append(Keyframe(f"{frame.number:06d}.png", frame.camera, cam_from_map, pixel[row], ids[row]))
    in_map = scale * noisy @ rotation.T + translation
    return Submap(map_id, tuple(keyframes), ids, in_map), (scale, rotation, translation), ids[wrong]


class _Observed(NamedTuple):
    """True points (n, 3), who observed them (frames, n), the centres (n, 3) from which their distance is wrong by a
    factor (n,), pixels (n, 2) for each frame, and which are wrong points (n,)."""

    world: np.ndarray
    seen: np.ndarray
    origin: np.ndarray
    factor: np.ndarray
    pixels: list[np.ndarray]
    wrong: np.ndarray


def _tracked(
    frames: list[Frame],
    config: SlamConfig,
    settings: _Settings,
    rng: np.random.Generator,
    breathing: Breathing | None,
) -> _Observed:
    count = settings.points or round(float(np.exp(rng.uniform(*np.log(_POINTS)))))
    rest, seen = tracks(frames, count, rng, breathing)
    _check_points(rest)
    there = [at(frame, rest, breathing) for frame in frames]
    pixels = [
        projected(f, p) + rng.normal(0, config.pixel_noise, (len(rest), 2)) for f, p in zip(frames, there, strict=True)
    ]
    world = rest if breathing is None else (seen[..., None] * np.stack(there)).sum(0) / seen.sum(0)[:, None]
    centers = np.stack([true_pose(frame)[:3, 3] for frame in frames])
    origin = (seen.T / seen.sum(0)[:, None]) @ centers
    factor = distance_factors(
        frames, world, seen, settings.point_noise, config.shared_noise, config.shared_length_mm, rng
    )
    wrong = rng.random(len(world)) < settings.spurious
    factor[wrong] = wrong_factors(int(wrong.sum()), rng)
    return _Observed(world, seen, origin, factor, pixels, wrong)


def _independent(frames: list[Frame], config: SlamConfig, settings: _Settings, rng: np.random.Generator) -> _Observed:
    points, origins = [], []
    assert settings.points is not None
    for index, frame in enumerate(frames):
        found = points_at_corners(frame, settings.points)
        points.append(found)
        origins.append(np.full(len(found), index))
    world, made_by = np.concatenate(points), np.concatenate(origins)
    seen = np.stack([sees(frame, world) for frame in frames])  # (frames, points)
    seen &= rng.random(seen.shape) < 0.85
    seen[made_by, np.arange(len(world))] = True
    keep = seen.sum(0) >= min(3, len(frames))
    world, made_by, seen = world[keep], made_by[keep], seen[:, keep]
    _check_points(world)

    pixels = [projected(frame, world) + rng.normal(0, config.pixel_noise, (len(world), 2)) for frame in frames]
    origin = np.stack([true_pose(frame)[:3, 3] for frame in frames])[made_by]
    distance = np.linalg.norm(world - origin, axis=1)
    factor = 1 + settings.point_noise * distance / 20 * rng.standard_normal(len(world))
    wrong = rng.random(len(world)) < settings.spurious
    factor[wrong] = 1.3 + rng.exponential(4, int(wrong.sum()))
    return _Observed(world, seen, origin, np.clip(factor, 0.2, None), pixels, wrong)


def _check_points(world: np.ndarray) -> None:
    if not len(world):
        raise InputError(
            "the simulated map", "no point is seen by enough keyframes", "use a shorter travel or more frames"
        )


def _drifting(
    submap: Submap, frames: list[Frame], true: _Similarity, size: float, rng: np.random.Generator
) -> tuple[Submap, _Similarity]:
    """The scale grows or shrinks by `size` along the path; map_from_world is that of its middle."""
    start = float((1 + size) ** rng.choice([-1, 1]))
    drifted = scale_drift(submap, start)
    scale, rotation = true[0] * np.sqrt(start), true[1]
    middle = np.mean([k.center for k in drifted.keyframes], axis=0)
    translation = middle - scale * rotation @ np.mean([true_pose(frame)[:3, 3] for frame in frames], axis=0)
    return drifted, (float(scale), rotation, translation)
