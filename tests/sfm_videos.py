"""Synthetic endoscopy for structure from motion: blur, highlights, pauses and cuts, through several lenses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.frame import Frame
from lightdepth.tube import SensorConfig, TextureConfig, Tube, TubeConfig, camera_path, octagon

SENSORS = {
    "blur": SensorConfig(motion=(0.015, 0.03)),
    "specular": SensorConfig(specular=(0.8, 1.0), sparkle=(0.1, 0.2), bright_share=(0.15, 0.25)),
}


def video(
    seed: int, camera: CameraModel, effect: str, count: int = 24, speed: float = 0.8, config: TubeConfig | None = None
) -> list[Frame]:
    """Frames along `speed` mm each. Effects: "" none; "blur" and "specular", all along; "pause", where the camera
    stands for a third of the time; "cut", where another colon goes on in the middle; "dark", where nothing is lit."""
    if effect == "cut":
        half = count // 2
        first, second = (video(s, camera, "", n, speed, config) for s, n in ((seed, half), (seed + 50, count - half)))
        return [replace(f, name=f"{i:06d}") for i, f in enumerate([*first, *second])]
    rng = np.random.default_rng(seed)
    config = config or TubeConfig(texture=TextureConfig(resolution=0.2))
    tube = Tube(replace(config, sensor=SENSORS.get(effect, config.sensor)), rng)
    mask = octagon(camera)
    moving = np.arange(count)
    if effect == "pause":
        third = count // 3
        moving = np.concatenate([np.arange(third), np.full(third, third), third + np.arange(count - 2 * third)])
    poses = camera_path(tube.shape, count, speed * (count - 1), rng)[moving]
    frames = []
    for i, pose in enumerate(poses):
        view = tube.view(pose, camera, mask, rng)
        image = 0.05 * view.image if effect == "dark" else view.image
        light = replace(tube.light, gain=1.0)
        frames.append(
            Frame(f"{i:06d}", image, camera, light, mask, true_distance=view.distance, true_world_from_cam=pose)
        )
    return frames
