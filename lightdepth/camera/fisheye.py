"""Cameras that bend the angle from the axis: Kannala-Brandt and Scaramuzza."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from lightdepth.camera.arrays import (
    NEAR_AXIS,
    Array,
    angle_from_axis,
    at_radius,
    detached,
    first_positive_root,
    interpolated,
    length,
    namespace,
    unit,
)
from lightdepth.camera.model import LEAST_FOCAL, MAX_THETA, TABLE, CameraModel, FocalCamera
from lightdepth.errors import InputError


@dataclass(frozen=True)
class KannalaBrandt(FocalCamera):
    """Fisheye, rho / f = theta + k1 theta³ + k2 theta⁵ + k3 theta⁷ + k4 theta⁹ (OPENCV_FISHEYE, vicalib's kb4)."""

    k1: float
    k2: float
    k3: float
    k4: float

    name: ClassVar[str] = "OPENCV_FISHEYE"

    def max_theta(self) -> float:
        """Half the field on which the model can be inverted, radians."""
        turn = np.sqrt(first_positive_root(9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0))
        return float(min(turn, MAX_THETA))

    def _radius(self, theta: Array) -> Array:
        t2 = theta * theta
        result: Array = theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        return result

    def _slope(self, theta: Array) -> Array:
        t2 = theta * theta
        result: Array = 1 + t2 * (3 * self.k1 + t2 * (5 * self.k2 + t2 * (7 * self.k3 + t2 * 9 * self.k4)))
        return result

    def _pixels(self, points: Array) -> tuple[Array, Array]:
        theta, side, exists = angle_from_axis(points)
        limit = self.max_theta()
        radius = self._radius(namespace(points).clip(theta, None, limit))
        return self._to_pixels(at_radius(points, side, radius, 1.0)), exists & (theta < limit)

    def _rays(self, pixels: Array) -> tuple[Array, Array]:
        plane, limit = self._to_plane(pixels), self.max_theta()
        xp, radius = namespace(plane), length(plane[..., 0], plane[..., 1])
        table = np.linspace(0, limit, TABLE)
        theta = interpolated(radius, self._radius(table), table)
        for target in [detached(radius)] * 5 + [radius]:
            theta = theta - (self._radius(theta) - target) / xp.clip(self._slope(theta), 1e-6, None)
            theta = xp.clip(theta, 0, limit)
        near = radius < NEAR_AXIS
        scale = xp.where(near, 1.0, xp.sin(theta) / xp.where(near, 1.0, radius))
        rays = xp.concatenate([plane * scale[..., None], xp.cos(theta)[..., None]], -1)
        return rays, radius < float(self._radius(np.asarray(limit)))


@dataclass(frozen=True)
class Scaramuzza(CameraModel):
    """Omnidirectional polynomial (ocamcalib): sensor point (x', y') has the ray (x', y', a0 + a1 rho + ... + a4 rho⁴).

    (u - cx, v - cy) = [[c, d], [e, 1]] (x', y').
    """

    cx: float
    cy: float
    a0: float
    a1: float
    a2: float
    a3: float
    a4: float
    c: float
    d: float
    e: float

    name: ClassVar[str] = "SCARAMUZZA"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.a0 >= LEAST_FOCAL:
            raise InputError("SCARAMUZZA camera", f"a0 = {self.a0}", "expected positive pixels (z into the scene)")
        if abs(self.c - self.d * self.e) < 1e-9:
            raise InputError(
                "SCARAMUZZA camera", "the stretch [[c, d], [e, 1]] is singular", "expected c about 1, d and e about 0"
            )

    @property
    def focal_length(self) -> float:
        return self.a0

    def _sensor(self, pixels: Array) -> Array:
        """(x', y') of pixels."""
        u, v, det = pixels[..., 0] - self.cx, pixels[..., 1] - self.cy, self.c - self.d * self.e
        result: Array = namespace(pixels).stack([(u - self.d * v) / det, (self.c * v - self.e * u) / det], -1)
        return result

    def _height(self, rho: Array) -> Array:
        return self.a0 + rho * (self.a1 + rho * (self.a2 + rho * (self.a3 + rho * self.a4)))

    def _height_slope(self, rho: Array) -> Array:
        return self.a1 + rho * (2 * self.a2 + rho * (3 * self.a3 + rho * 4 * self.a4))

    def max_theta(self) -> float:
        """Half the field on which the model can be inverted, radians."""
        return float(_theta_over_rho(self)[1][-1])

    def _pixels(self, points: Array) -> tuple[Array, Array]:
        xp = namespace(points)
        theta, side, exists = angle_from_axis(points)
        table_rho, table_theta = _theta_over_rho(self)
        limit = float(table_theta[-1])
        valid = exists & (theta < limit)
        theta = xp.clip(theta, None, limit)
        rho = interpolated(theta, table_theta, table_rho)
        sines = xp.sin(theta), xp.cos(theta)
        fixed = detached(sines[0]), detached(sines[1])
        for sine, cosine in [fixed] * 5 + [sines]:  # rho cos(theta) = height(rho) sin(theta)
            error = rho * cosine - self._height(rho) * sine
            slope = cosine - self._height_slope(rho) * sine
            rho = rho - error / xp.where(abs(slope) < 1e-9, 1e-9, slope)
        sensor = at_radius(points, side, rho, self.a0)
        x, y = sensor[..., 0], sensor[..., 1]
        return xp.stack([self.c * x + self.d * y + self.cx, self.e * x + y + self.cy], -1), valid

    def _rays(self, pixels: Array) -> tuple[Array, Array]:
        sensor = self._sensor(pixels)
        rho = length(sensor[..., 0], sensor[..., 1])
        rays = unit(namespace(sensor).concatenate([sensor, self._height(rho)[..., None]], -1))
        return rays, rho < float(_theta_over_rho(self)[0][-1])

    def resized(self, width: int, height: int) -> Self:
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            cx=self.cx * sx,
            cy=self.cy * sy,
            a0=self.a0 * sy,
            a2=self.a2 / sy,
            a3=self.a3 / sy**2,
            a4=self.a4 / sy**3,
            c=self.c * sx / sy,
            d=self.d * sx / sy,
        )

    def _shifted(self, x: float, y: float) -> Self:
        return replace(self, cx=self.cx + x, cy=self.cy + y)


@lru_cache(maxsize=64)
def _theta_over_rho(camera: Scaramuzza) -> tuple[np.ndarray, np.ndarray]:
    """(rho, theta), as far as theta grows and stays below 90 degrees."""
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
    # By the lens, not by the image size: a crop has the field of the whole image
    reach = max(4 * camera.a0, 2 * float(np.linalg.norm(camera._sensor(corners), axis=-1).max()))
    rho = np.linspace(0, reach, TABLE * 2)
    theta = np.arctan2(rho, camera._height(rho))
    stop = np.flatnonzero((np.diff(theta) <= 0) | (theta[1:] >= MAX_THETA))
    end = int(stop[0]) + 1 if len(stop) else len(rho)
    return rho[:end], theta[:end]
