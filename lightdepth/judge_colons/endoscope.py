"""The lens, the way that it takes, and what the sensor makes of the light.

    code = clip( noisy( g · blurred(L · vignetting) )^(1/gamma) , 0, 1)   in 8 bits

The noise is the shot noise of so many electrons at white, and that of reading them out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole
from lightdepth.judge_colons.transport import Scene
from lightdepth.judge_colons.wall import Colon

LensKind = Literal["narrow", "plain", "barrel", "circle", "fisheye"]
Exposure = Literal["dark", "even", "bright", "clipped"]

_AIM: dict[Exposure, tuple[float, float]] = {  # this quantile of the brightest channel's codes comes to this code
    "dark": (0.99, 0.38),
    "even": (0.99, 0.93),
    "bright": (0.94, 1.0),
    "clipped": (0.78, 1.0),
}


@dataclass(frozen=True)
class Sensor:
    """`exposure`, gamma of the response, deviation of the blur [px], electrons at white, deviation of reading them out,
    share of each frame's own brightness that the automatic exposure takes away."""

    exposure: Exposure
    gamma: float
    blur: float
    electrons: float
    reading: float
    automatic: float = 0.5


def make_lens(kind: LensKind, width: int, height: int, rng: np.random.Generator) -> CameraModel:
    """A lens of this kind: narrow (about 62 degrees across), plain (85), barrel (110, distorted), circle (95,
    distorted, its image a circle cut at two sides) or fisheye (150, a whole circle); its centre is a bit off."""
    cx, cy = width / 2 + rng.normal() * 0.015 * width, height / 2 + rng.normal() * 0.015 * height
    if kind == "fisheye":
        f = 0.475 * height / np.radians(rng.uniform(70, 78))
        k1, k2 = rng.uniform([-0.03, -0.01], [0.02, 0.0]).tolist()
        return KannalaBrandt(width, height, f, f, width / 2, height / 2, k1, k2, 0.0, 0.0)
    focal = {"narrow": 0.82, "plain": 0.545, "barrel": 0.44, "circle": 0.5}[kind] * width * rng.uniform(0.96, 1.04)
    if kind in ("narrow", "plain"):
        return Pinhole(width, height, focal, focal * 1.004, cx, cy)
    k1 = -0.22 if kind == "barrel" else -0.17
    return Brown(width, height, focal, focal * 0.997, cx, cy, k1 * rng.uniform(0.9, 1.1), 0.028, 6e-4, -4e-4)


def image_circle(kind: LensKind, camera: CameraModel) -> np.ndarray | None:
    """(H, W) bool, where light falls on the sensor; None where it does everywhere."""
    if kind not in ("fisheye", "circle"):
        return None
    radius = (0.475 if kind == "fisheye" else 0.585) * camera.height
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    inside: np.ndarray = np.hypot(u - camera.width / 2, v - camera.height / 2) < radius
    return inside


def draw_way(rng: np.random.Generator, colon: Colon, scene: Scene, frames: int) -> np.ndarray:
    """Poses (frames, 4, 4), world_from_cam [mm]: along the lumen, off its middle, looking about. Forth or back."""
    start, travel = rng.uniform(75, 100), rng.uniform(35, 60)
    places = np.linspace(start, start + travel, frames)
    forth = rng.random() < 0.5
    waves = rng.uniform(0, 2 * np.pi, 6)
    poses = []
    for i, s in enumerate(places):
        middle, axes = colon.line.at(float(s))
        t = 2 * np.pi * i / frames
        aside = np.array([np.sin(t + waves[0]), np.sin(1.7 * t + waves[1])]) * 0.3
        look = np.array([np.sin(1.3 * t + waves[2]), np.sin(2.1 * t + waves[3])]) * rng.uniform(0.1, 0.55)
        free = float(colon.free[min(round(s / 0.5), len(colon.free) - 1)])
        centre = middle + axes[:, :2] @ aside * free
        for _ in range(8):  # lamps stand up to 4.5 mm beside the lens
            if scene.clearance(centre[None])[0] > 6.0:
                break
            centre = middle + 0.6 * (centre - middle)
        view = axes[:, 2] if forth else -axes[:, 2]
        view = view + axes[:, :2] @ look
        view /= np.linalg.norm(view)
        roll = waves[4] + 0.4 * np.sin(t + waves[5])
        up = axes[:, 0] * np.cos(roll) + axes[:, 1] * np.sin(roll)
        right = np.cross(up, view)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(view, right), view], 1)
        pose[:3, 3] = centre
        poses.append(pose)
    return np.stack(poses)


def exposed(
    radiance: Sequence[np.ndarray], inside: np.ndarray, sensor: Sensor, rng: np.random.Generator
) -> tuple[list[np.ndarray], float]:
    """Codes (H, W, 3) in [0, 1] of images of linear radiance, and the mean gain. `inside` (H, W) bool is where light
    falls; it is black elsewhere."""
    quantile, aim = _AIM[sensor.exposure]
    blurred = [cv2.GaussianBlur(r.astype(np.float32), (0, 0), sensor.blur) for r in radiance]
    level = np.array([np.quantile(b[inside].max(-1), quantile) for b in blurred])
    gains = aim**sensor.gamma / (level**sensor.automatic * np.exp(np.log(level).mean()) ** (1 - sensor.automatic))
    images = []
    for gain, image in zip(gains, blurred, strict=True):
        linear = np.maximum(gain * image, 0)
        deviation = np.sqrt(linear / sensor.electrons + sensor.reading**2)
        noisy = np.clip(linear + deviation * rng.normal(size=linear.shape), 0, 1)
        images.append(np.where(inside[..., None], noisy ** (1 / sensor.gamma), 0).astype(np.float32))
    return images, float(np.exp(np.log(gains).mean()))
