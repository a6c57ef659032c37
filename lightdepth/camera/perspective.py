"""Cameras that distort the plane z = 1: pinhole, Brown-Conrady, and OpenCV's longer form of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from lightdepth.camera.arrays import (
    Array,
    detached,
    first_positive_root,
    interpolated,
    namespace,
    rays_through_plane,
    to_plane,
)
from lightdepth.camera.model import TABLE, FocalCamera


@dataclass(frozen=True)
class Pinhole(FocalCamera):
    """No distortion: u = fx x/z + cx."""

    name: ClassVar[str] = "PINHOLE"

    def _pixels(self, points: Array) -> tuple[Array, Array]:
        plane, front = to_plane(points)
        return self._to_pixels(plane), front

    def _rays(self, pixels: Array) -> tuple[Array, Array]:
        plane = self._to_plane(pixels)
        return rays_through_plane(plane), namespace(plane).ones_like(plane[..., 0], dtype=bool)


@dataclass(frozen=True)
class Brown(FocalCamera):
    """Brown-Conrady distortion with two radial and two tangential terms (COLMAP's and OpenCV's OPENCV)."""

    k1: float
    k2: float
    p1: float
    p2: float

    name: ClassVar[str] = "OPENCV"

    def _max_radius(self) -> float:
        """The radius within which the distortion can be inverted; infinity where it can everywhere."""
        return _fold(self.k1, self.k2, float(np.hypot(self.p1, self.p2)))

    def _radial(self, r2: Array) -> tuple[Array, Array]:
        """The radial factor at squared radius r², and its slope over r²."""
        return 1 + r2 * (self.k1 + self.k2 * r2), self.k1 + 2 * self.k2 * r2

    def _distort(self, plane: Array) -> Array:
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial, _ = self._radial(r2)
        result: Array = namespace(plane).stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            -1,
        )
        return result

    def _newton(self, plane: Array, distorted: Array) -> Array:
        """One step towards distort(plane) = distorted."""
        xp, x, y = namespace(plane), plane[..., 0], plane[..., 1]
        radial, slope = self._radial(x * x + y * y)
        slope = 2 * slope
        xx = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
        xy = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y
        yy = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
        error = self._distort(plane) - distorted
        det = xx * yy - xy * xy
        det = xp.where(abs(det) < 1e-9, 1e-9, det)
        step = xp.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], -1)
        result: Array = plane - step / det[..., None]
        return result

    def _pixels(self, points: Array) -> tuple[Array, Array]:
        xp = namespace(points)
        plane, front = to_plane(points)
        inside = xp.hypot(plane[..., 0], plane[..., 1]) < self._max_radius()
        return self._to_pixels(self._distort(xp.where(inside[..., None], plane, 0.0))), front & inside

    def _rays(self, pixels: Array) -> tuple[Array, Array]:
        distorted, limit = self._to_plane(pixels), self._max_radius()
        xp, fixed = namespace(distorted), detached(distorted)
        # Start from the radial part alone, inverted by table over the field that the image needs.
        r = xp.linalg.norm(fixed, axis=-1, keepdims=True)
        far = 1.5 * max(1.0, 0.0 if 0 in r.shape else float(r.max())) + 1.0
        radius = np.linspace(0, min(limit, far), TABLE)
        table = radius * self._radial(radius**2)[0]
        plane = fixed / xp.clip(r, 1e-12, None) * interpolated(r, table, radius)
        for target in [fixed] * 9 + [distorted]:
            plane = self._newton(plane, target)
            reached = xp.linalg.norm(plane, axis=-1, keepdims=True)
            plane = plane * xp.clip(far / xp.clip(reached, 1e-12, None), None, 1.0)
        error = xp.linalg.norm(self._distort(plane) - distorted, axis=-1)
        rounding = 32 * float(xp.finfo(fixed.dtype).eps) * (1 + r[..., 0])
        solved = error < 1e-6 / self.focal_length + rounding
        return rays_through_plane(plane), solved & (xp.linalg.norm(plane, axis=-1) < limit)


@dataclass(frozen=True)
class FullBrown(Brown):
    """Brown-Conrady with OpenCV's further radial terms, (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    (COLMAP's FULL_OPENCV): what cv2.calibrateCamera gives unless it is told not to."""

    k3: float
    k4: float
    k5: float
    k6: float

    name: ClassVar[str] = "FULL_OPENCV"

    def _max_radius(self) -> float:
        return _full_fold(self)

    def _radial(self, r2: Array) -> tuple[Array, Array]:
        above, above_slope = _cubic(r2, self.k1, self.k2, self.k3)
        below, below_slope = _cubic(r2, self.k4, self.k5, self.k6)
        return above / below, (above_slope * below - above * below_slope) / (below * below)


def _cubic(t: Array, a: float, b: float, c: float) -> tuple[Array, Array]:
    """1 + a t + b t² + c t³ and its slope."""
    return 1 + t * (a + t * (b + t * c)), a + t * (2 * b + 3 * c * t)


@lru_cache(maxsize=64)
def _full_fold(camera: FullBrown) -> float:
    """As _fold, to a thousandth: its polynomials' degree is too high for roots that can be trusted."""
    r = np.linspace(0, 30, 30001)[1:]
    with np.errstate(all="ignore"):
        radial, slope = camera._radial(r * r)
    p, regular = float(np.hypot(camera.p1, camera.p2)), _cubic(r * r, camera.k4, camera.k5, camera.k6)[0] > 0
    for angle in np.linspace(0, np.pi, 91 if p else 1):
        a, b = p * np.cos(angle), p * np.sin(angle)
        along, across = radial + 2 * r * r * slope + 6 * a * r, radial + 2 * a * r
        regular &= (along > 0) & (along * across > 4 * b * b * r * r)
    return float(r[regular.argmin()]) if not regular.all() else float("inf")


@lru_cache(maxsize=64)
def _fold(k1: float, k2: float, p: float) -> float:
    """The smallest radius, over all directions, at which the Jacobian of Brown's distortion is singular.

    In axes along and across the direction, with (a, b) the tangential vector of length p in them, it is
    [[1 + 3 k1 r² + 5 k2 r⁴ + 6 a r, 2 b r], [2 b r, 1 + k1 r² + k2 r⁴ + 2 a r]].
    """

    def singular(angle: float) -> float:
        a, b = p * np.cos(angle), p * np.sin(angle)
        along, across = [5 * k2, 0.0, 3 * k1, 6 * a, 1.0], [k2, 0.0, k1, 2 * a, 1.0]
        return first_positive_root(*np.polysub(np.polymul(along, across), [4 * b * b, 0.0, 0.0]))

    return min(map(singular, np.linspace(0, np.pi, 91 if p else 1)))
