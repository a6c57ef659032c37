"""A monocular SLAM's view of a synthetic colon: submaps with noise and known wrong points.

Notation: a submap's frame is related to the world [mm] by X_map = scale · R X_world + t. Distances in mm unless "map".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.sparse_map import Keyframe, SparseMap, Submap


@dataclass(frozen=True)
class SlamConfig:
    """How good the simulated SLAM is."""

    keyframe_every: int = 2
    """Number of frames from one keyframe to the next. More make fewer keyframes."""
    maps: int = 2
    """Number of submaps that the keyframes are divided among. More make shorter submaps."""
    shared_keyframes: int = 2
    """Number of keyframes that a submap shares with the one before it. More make submaps easier to join."""
    points_per_keyframe: int = 250
    """Largest number of points that each keyframe makes anew. More make a denser map."""
    spurious: float = 0.3
    """Share of the map points that are wrong. A larger one makes the map harder to densify."""
    point_noise: float = 0.01
    """Deviation of a point's distance, as a share of it, at 20 mm; it grows in proportion to the distance (error ~
    distance²). A larger one makes a noisier map."""
    pixel_noise: float = 0.5
    """Deviation of where a point is observed in the image along each axis, pixels. A larger one makes noisier
    observations."""
    pose_noise_mm: float = 0.05
    """Deviation of a keyframe's place along each axis, mm. A larger one makes noisier poses."""
    pose_noise_deg: float = 0.05
    """Deviation of a keyframe's rotation about each axis, degrees. A larger one makes noisier poses."""


@dataclass(frozen=True)
class SimulatedSlam:
    """The map, and what only the simulation knows: map_from_world (scale, rotation (3, 3), translation (3,)) and the
    ids of the wrong points, both by submap id."""

    map: SparseMap
    map_from_world: dict[int, tuple[float, np.ndarray, np.ndarray]]
    spurious_ids: dict[int, np.ndarray]


def simulate_slam(frames: Sequence[Frame], config: SlamConfig, seed: int) -> SimulatedSlam:
    """Keyframes of frames with truth, corners as points, and each submap in a frame and scale of its own.

    A wrong point is moved along the ray of the keyframe that made it, by a factor of 1.3 + Exp(4).
    """
    rng = np.random.default_rng([seed, 1])
    keyframes = list(frames)[:: config.keyframe_every]
    if len(keyframes) < 2 * config.maps:
        raise InputError(
            f"{config.maps} maps", f"{len(keyframes)} keyframes cannot be shared among them", "render more frames"
        )
    submaps, sims, wrong = [], {}, {}
    for map_id, part in enumerate(_parts(len(keyframes), config.maps, config.shared_keyframes)):
        submap, sims[map_id], wrong[map_id] = _submap(map_id, [keyframes[i] for i in part], config, rng)
        submaps.append(submap)
    return SimulatedSlam(SparseMap(tuple(submaps), "simulated SLAM"), sims, wrong)


def _parts(count: int, maps: int, shared: int) -> list[range]:
    bounds = np.linspace(0, count, maps + 1).astype(int)
    return [range(max(0, a - (shared if a else 0)), b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]


def _submap(
    map_id: int, frames: list[Frame], config: SlamConfig, rng: np.random.Generator
) -> tuple[Submap, tuple[float, np.ndarray, np.ndarray], np.ndarray]:
    points, origins = [], []
    for index, frame in enumerate(frames):
        found = _new_points(frame, config.points_per_keyframe, rng)
        points.append(found)
        origins.append(np.full(len(found), index))
    world, made_by = np.concatenate(points), np.concatenate(origins)
    seen = np.stack([_sees(frame, world) for frame in frames])  # (frames, points)
    seen &= rng.random(seen.shape) < 0.85
    seen[made_by, np.arange(len(world))] = True
    keep = seen.sum(0) >= min(3, len(frames))
    world, made_by, seen = world[keep], made_by[keep], seen[:, keep]
    if not len(world):
        raise InputError(
            "the simulated map", "no point is seen by enough keyframes", "use a shorter travel or more frames"
        )

    pixels = [_project(frame, world) + rng.normal(0, config.pixel_noise, (len(world), 2)) for frame in frames]
    centers = np.stack([_pose(frame)[:3, 3] for frame in frames])[made_by]
    distance = np.linalg.norm(world - centers, axis=1)
    factor = 1 + config.point_noise * distance / 20 * rng.standard_normal(len(world))
    wrong = rng.random(len(world)) < config.spurious
    factor[wrong] = 1.3 + rng.exponential(4, int(wrong.sum()))
    noisy = centers + np.clip(factor, 0.2, None)[:, None] * (world - centers)

    scale = float(np.exp(rng.uniform(np.log(0.02), np.log(0.5))))
    rotation = Rotation.random(rng=rng).as_matrix()
    translation = rng.normal(0, 2, 3)
    ids = np.arange(len(world))
    keyframes = []
    for frame, row, pixel in zip(frames, seen, pixels, strict=True):
        world_from_cam = _pose(frame).copy()
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


def _pose(frame: Frame) -> np.ndarray:
    if frame.true_world_from_cam is None or frame.true_distance is None:
        raise InputError(
            frame.name, "no true distance or no true pose", "a SLAM can only be simulated on frames with both"
        )
    return frame.true_world_from_cam


def _new_points(frame: Frame, count: int, rng: np.random.Generator) -> np.ndarray:
    """World points (n, 3) at corners of the image, where the wall is known."""
    pose, truth = _pose(frame), frame.true_distance
    assert truth is not None
    usable = cv2.erode((frame.valid & (truth > 0)).astype(np.uint8), np.ones((7, 7), np.uint8))
    grey = cv2.cvtColor((frame.image * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(grey, count, 0.001, 3, mask=usable)
    if corners is None:
        return np.zeros((0, 3))
    pixels = corners.reshape(-1, 2) + 0.5
    column, row = pixels.astype(int).T
    rays, valid = frame.camera.unproject(np.stack([column, row], -1) + 0.5)
    points = rays * truth[row, column, None]
    result: np.ndarray = (points @ pose[:3, :3].T + pose[:3, 3])[valid]
    return result


def _project(frame: Frame, world: np.ndarray) -> np.ndarray:
    pose = _pose(frame)
    result: np.ndarray = frame.camera.project((world - pose[:3, 3]) @ pose[:3, :3])[0]
    return result


def _sees(frame: Frame, world: np.ndarray) -> np.ndarray:
    """(n,) bool: in the image, inside the mask, and not behind the wall."""
    pose, truth = _pose(frame), frame.true_distance
    assert truth is not None
    in_cam = (world - pose[:3, 3]) @ pose[:3, :3]
    pixels, valid = frame.camera.project(in_cam)
    column = np.clip(pixels[:, 0].astype(int), 0, frame.camera.width - 1)
    row = np.clip(pixels[:, 1].astype(int), 0, frame.camera.height - 1)
    at_wall = np.abs(truth[row, column] / np.linalg.norm(in_cam, axis=1).clip(min=1e-9) - 1) < 0.03
    result: np.ndarray = valid & frame.valid[row, column] & at_wall
    return result
