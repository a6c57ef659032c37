"""Small synthetic colons, which render in a fraction of a second, and the models that know their truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from lightdepth.camera import Pinhole
from lightdepth.datasets import FrameSequence
from lightdepth.frame import Frame
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Submap
from lightdepth.tube import ShapeConfig, TextureConfig, TubeConfig, TubeSequence, render_sequence
from lightdepth.tube.slam import SimulatedSlam, SlamConfig, simulate_slam

SMALL = TubeConfig(ShapeConfig(length=90.0, step=1.2), TextureConfig(resolution=0.4))
CAMERA = Pinhole(96, 80, 52.0, 52.0, 47.0, 41.0)
INDEPENDENT = SlamConfig("independent")
EXACT = replace(INDEPENDENT, spurious=0.0, point_noise=0.0, pixel_noise=0.0, pose_noise_mm=0.0, pose_noise_deg=0.0)


@cache
def colon(seed: int = 0, count: int = 10, travel: float = 12.0, camera=CAMERA) -> TubeSequence:
    """A rendered sequence; the same object every time, so never change it."""
    return render_sequence(seed, count, camera, travel, SMALL)


def slam(frames, seed: int = 0, config: SlamConfig = INDEPENDENT, **changes) -> SimulatedSlam:
    """A simulated SLAM of every frame, in one map, with `changes` to its configuration."""
    return simulate_slam(frames, replace(config, **{"keyframe_every": 1, "maps": 1, **changes}), seed)


def in_world(found: SimulatedSlam, submap: Submap) -> np.ndarray:
    """Points (n, 3) of a submap in the colon's own frame, mm."""
    scale, rotation, translation = found.map_from_world[submap.id]
    result: np.ndarray = (submap.points - translation) @ rotation / scale
    return result


def sequence(frames: list[Frame], source: str = "frames in memory") -> FrameSequence:
    return FrameSequence([f.name for f in frames], frames.__getitem__, source)


def truth(frame: Frame) -> DepthPrediction:
    """A model that is right."""
    assert frame.true_distance is not None
    valid = frame.valid & (frame.true_distance > 0)
    distance = np.where(valid, frame.true_distance, 1).astype(np.float32)
    return DepthPrediction(frame.name, distance, valid, frame.camera, "truth")
