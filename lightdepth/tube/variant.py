"""Colons of another make, to judge networks on what they never trained on. No distance may be learnt or chosen on them;
the size of an uncertainty may be set on those of --data.tube.val-family variant, seeds 1,000,000 and up.

Other shape (cross-sections that are splines through uneven knots, folds that are arcs with one steep side), other
paint (cells of a Voronoi diagram with a network between them), other light (three lamps beside the lens, each fading as
cos^k), other tone curve (linear near black, a shoulder that never quite saturates). Ray casting, radiosity and truth
are those of lightdepth.tube.scene. Lengths in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from torch import Tensor

from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.photometry import LightTerms, PhotometricCalibration, light_distance
from lightdepth.tube.scene import Tube, TubeConfig
from lightdepth.tube.sensor import Sensor, SensorConfig, on_pixels, quantiles
from lightdepth.tube.sequence import render_sequence
from lightdepth.tube.shape import CLOSING, ShapeConfig, TubeShape, centreline, closed, swept
from lightdepth.tube.texture import TextureConfig

REFLECTANCE = {"weak": (0.0, 0.2), "strong": (0.5, 0.7)}
LAMPS_MM = ((3.24, 0.55, 0.0), (-2.77, 2.66, 0.0), (-1.27, -3.14, 0.0))
"""Where the light leaves a CF-H190L (EndoMapper)."""


def variant_frames(
    seed: int, count: int, camera: CameraModel, strength: Literal["weak", "strong"], travel: float = 60.0
) -> list[Frame]:
    """`count` views of one colon, with true distance and pose, under weak or strong light between the walls.

    Frames carry as their light the nearest calibration that the program knows: one lamp amid the three, its spread mu
    that of cos^k near the axis, and the response's power at mid grey. Raises InputError for another strength.
    """
    if strength not in REFLECTANCE:
        raise InputError("strength", f"{strength!r} is not known", "expected weak or strong")
    config = TubeConfig(sensor=SensorConfig(reflectance=REFLECTANCE[strength]), least_cosine=0.05)
    frames = render_sequence(seed, count, camera, travel, config, kind=VariantTube).frames
    return [replace(frame, name=f"variant{seed}_{frame.name}") for frame in frames]


class VariantTube(Tube):
    """A colon of the other make. `lamp_power` is k of cos^k."""

    def __init__(
        self,
        config: TubeConfig,
        rng: np.random.Generator,
        light: PhotometricCalibration | None = None,
        device: torch.device | str = "cpu",
    ):
        (own,) = rng.spawn(1)
        self.lamp_power = float(own.uniform(0.5, 3.0))
        known = PhotometricCalibration(
            gamma=2.2,
            mu=self.lamp_power,
            position_mm=tuple(np.mean(LAMPS_MM, axis=0)),
            reflectance=float(own.uniform(*config.sensor.reflectance)),
            source="published",
        )
        super().__init__(config, rng, light or known, device)

    def _direct(self, t: Tensor, normals: Tensor, rays: Tensor) -> Tensor:
        """The mean over the lamps of cos^k cos / |x - P|²."""
        total = torch.zeros_like(t)
        for lamp in LAMPS_MM:
            light = LightTerms(*(term.to(self.device) for term in replace(self.light, position_mm=lamp).terms()))
            reach, towards = light_distance(t[:, None, None], rays[:, :, None], light)
            cosine = (-towards * normals[:, :, None]).sum(1, keepdim=True).clamp(min=0)
            fading = towards[:, 2:].clamp(min=0) ** self.lamp_power
            total += (fading * cosine / reach.square().clamp(min=1e-12))[:, 0, 0]
        return total / len(LAMPS_MM)

    @staticmethod
    def _make_shape(config: ShapeConfig, rng: np.random.Generator) -> TubeShape:
        step, length = config.step, 170.0
        s = np.arange(round(length / step) + 1) * step
        mean = rng.uniform(13, 24)
        phi = np.linspace(0, 2 * np.pi, 8 * round(2 * np.pi * mean / step / 8), endpoint=False)
        turns = [
            sum(rng.normal(0, 0.5 / k) * np.sin(k * s / 40 + rng.uniform(0, 6.3)) for k in (1, 2)) for _ in range(2)
        ]
        centers, frames = centreline(s, *map(np.asarray, turns))

        stations = np.arange(0, length + 40, rng.uniform(18, 35))
        sections = np.stack([_section(phi, rng) for _ in stations])
        relative = CubicSpline(stations, sections)(s)
        position = rng.uniform(4, 12)
        while position < length:
            middle, half = rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 2.6)
            away = np.abs((phi - middle + np.pi) % (2 * np.pi) - np.pi)
            arc = rng.uniform(0.15, 0.5) / (1 + np.exp((away - half) / 0.18))
            course = position + rng.uniform(-5, 5) * np.cos(phi - rng.uniform(0, 2 * np.pi)) + rng.normal(0, 1) * away
            offset = s[:, None] - course
            ramp, steep = rng.uniform(3, 8), rng.uniform(0.8, 1.6)
            profile = np.where(offset < 0, 1 / (1 + (offset / ramp) ** 2), np.exp(-((offset / steep) ** 2)))
            relative -= arc * profile * np.exp(-((offset / 12) ** 2))
            position += rng.lognormal(np.log(11), 0.45)
        relative = gaussian_filter1d(relative.clip(0.35, 1.5), 1.0, axis=0)
        return swept(mean * closed(relative, CLOSING * mean, s, length), centers, frames, step)

    @staticmethod
    def _make_texture(
        length: float, circumference: float, config: TextureConfig, rng: np.random.Generator
    ) -> np.ndarray:
        texel = 2 * config.resolution
        rows, columns = round(length / texel), round(circumference / texel)
        place = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1).reshape(-1, 2) * texel
        shade, net = np.zeros(len(place)), np.zeros(len(place))
        for size, weight in ((rng.uniform(7, 12), 1.0), (rng.uniform(2, 4), 0.5)):
            count = round(length * circumference / size**2)
            seeds = rng.uniform(0, (length, circumference), (count, 2))
            around = np.concatenate([seeds + (0, shift) for shift in (-circumference, 0, circumference)])
            reach, nearest = cKDTree(around).query(place, 2)
            shade += weight * rng.normal(0, 1, count)[nearest[:, 0] % count]
            net += weight * np.exp(-(((reach[:, 1] - reach[:, 0]) / rng.uniform(0.3, 0.7)) ** 2))
        shade = gaussian_filter1d(gaussian_filter1d(shade.reshape(rows, columns), 4, axis=0), 4, axis=1, mode="wrap")
        colour = np.array([1.0, rng.uniform(0.3, 0.7), rng.uniform(0.2, 0.55)])
        tone = np.exp(0.12 * shade[..., None] * (0.3, 1, 1) - rng.uniform(0.1, 0.5) * net.reshape(rows, columns, 1))
        result: np.ndarray = (colour * tone).clip(0.02, 1).astype(np.float32)
        return result

    @staticmethod
    def _expose(
        linear: Tensor,
        seen: Tensor,
        ray_z: Tensor,
        flow: Tensor | None,
        sensor: Sensor,
        rng: np.random.Generator,
        owns: Sequence[np.random.Generator],
    ) -> np.ndarray:
        """Exposure on the mean, x / (1 + x), then sRGB's curve: linear near black, power 2.4 above; noise."""
        exposure = linear.new_tensor([own.uniform(0.5, 1.1) for own in owns]).reshape(-1, 1, 1, 1)
        pixels = linear * exposure / quantiles(linear.amax(1), seen, 0.75).clamp(min=1e-12)
        pixels = 1.9 * pixels / (1 + pixels)
        code = linear_rgb_to_rgb(pixels) + on_pixels(seen, lambda _, count: rng.normal(0, 0.006, (count, 3)))
        image = (code.clamp(0, 1) * 255).round() / 255 * seen[:, None]
        return image.permute(0, 2, 3, 1).cpu().numpy()


def _section(phi: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A closed curve of mean radius near 1 through 5 to 8 uneven knots, as a radius over phi."""
    knots = int(rng.integers(5, 9))
    at = (np.arange(knots) + rng.uniform(-0.3, 0.3, knots)) * 2 * np.pi / knots
    radius = rng.uniform(0.82, 1.15, knots)
    start = at[0]
    spline = CubicSpline(np.append(at, start + 2 * np.pi), np.append(radius, radius[0]), bc_type="periodic")
    result: np.ndarray = spline((phi - start) % (2 * np.pi) + start)
    return result
