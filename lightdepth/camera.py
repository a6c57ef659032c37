"""Camera models: which ray of light fell on which pixel.

Notation: pixels (..., 2) as (u right, v down), the centre of the first pixel at (0.5, 0.5); points (..., 3) in camera
axes x right, y down, z into the scene; theta angle between a ray and the optical axis; rho distance from the principal
point.

Every model maps its whole field of view natively; nothing is undistorted. What lies outside the field on which the
model can be inverted (where a distortion polynomial turns over, or 90 degrees from the axis and beyond, where no
endoscope's light reaches) is reported as invalid, with finite numbers in its place.

Parameters are in COLMAP's order; SCARAMUZZA's are `cx cy a0 a1 a2 a3 a4 c d e`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from lightdepth.errors import InputError

_MAX_THETA = np.pi / 2
_TABLE = 2048


@dataclass(frozen=True)
class CameraModel(ABC):
    """An image size and the intrinsics of one lens. Sizes and lengths in pixels."""

    width: int
    height: int

    name: ClassVar[str]

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera size {self.width}x{self.height}; expected positive numbers of pixels")
        bad = [f.name for f in fields(self) if not np.isfinite(getattr(self, f.name))]
        if bad:
            raise InputError(f"{self.name} camera: {', '.join(bad)} not finite")

    @abstractmethod
    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of points and whether the model holds there, whatever the image size."""

    @abstractmethod
    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit rays (..., 3) through pixels (..., 2), and where the model can be inverted (...)."""

    @property
    @abstractmethod
    def focal_length(self) -> float:
        """Pixels per radian on the optical axis: the resolution of the lens."""

    @abstractmethod
    def resized(self, width: int, height: int) -> Self:
        """The same lens sampled on another pixel grid. Exact: the grid's corner stays at (0, 0)."""

    @abstractmethod
    def _shifted(self, x: float, y: float) -> Self:
        """The same camera with the pixel origin moved by (x, y)."""

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2) of points (..., 3), and whether each is seen: in the model's field and inside the image."""
        points = np.asarray(points, dtype=np.float64)
        pixels, valid = self._pixels(points)
        inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= self.width) & (pixels[..., 1] <= self.height)
        return pixels, valid & inside

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit rays (H, W, 3) through the pixel centres and their validity (H, W). Read-only: they are kept."""
        return _ray_map(self)

    def cropped(self, x: int, y: int, width: int, height: int) -> Self:
        """The camera of the image cut out at column x, row y."""
        return replace(self._shifted(-x, -y), width=width, height=height)

    def with_pixel_center(self, found: float) -> Self:
        """This camera in our convention, its numbers having been given with the first pixel's centre at `found`."""
        return self._shifted(0.5 - found, 0.5 - found)

    @property
    def params(self) -> tuple[float, ...]:
        """Intrinsics in the order of the file formats."""
        return tuple(getattr(self, f.name) for f in fields(self)[2:])


@lru_cache(maxsize=16)
def _ray_map(camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays, valid = camera.unproject(np.stack([u, v], -1))
    rays.flags.writeable = valid.flags.writeable = False
    return rays, valid


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x/z, y/z) of points, and where z > 0."""
    front = points[..., 2] > 0
    return points[..., :2] / np.where(front, points[..., 2], 1.0)[..., None], front


@dataclass(frozen=True)
class _FocalCamera(CameraModel):
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(f"{self.name} camera: focal lengths {self.fx}, {self.fy}; expected positive pixels")

    @property
    def focal_length(self) -> float:
        return float(np.sqrt(self.fx * self.fy))

    def resized(self, width: int, height: int) -> Self:
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def _shifted(self, x: float, y: float) -> Self:
        return replace(self, cx=self.cx + x, cy=self.cy + y)

    @property
    def matrix(self) -> np.ndarray:
        """K (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def _to_pixels(self, plane: np.ndarray) -> np.ndarray:
        return plane * (self.fx, self.fy) + (self.cx, self.cy)

    def _to_plane(self, pixels: np.ndarray) -> np.ndarray:
        return (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)


@dataclass(frozen=True)
class Pinhole(_FocalCamera):
    """No distortion: u = fx x/z + cx."""

    name: ClassVar[str] = "PINHOLE"

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        plane, front = _plane(points)
        return self._to_pixels(plane), front

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        plane = self._to_plane(pixels)
        return _unit(np.concatenate([plane, np.ones_like(plane[..., :1])], -1)), np.ones(plane.shape[:-1], bool)


@dataclass(frozen=True)
class Brown(_FocalCamera):
    """Brown-Conrady distortion with two radial and two tangential terms (COLMAP's and OpenCV's OPENCV)."""

    k1: float
    k2: float
    p1: float
    p2: float

    name: ClassVar[str] = "OPENCV"

    def _max_radius(self) -> float:
        """Where r (1 + k1 r² + k2 r⁴) stops growing; infinity when it never does."""
        return float(np.sqrt(_first_positive_root([5 * self.k2, 3 * self.k1, 1.0])))

    def _distort(self, plane: np.ndarray) -> np.ndarray:
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + self.k2 * r2)
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            -1,
        )

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        plane, front = _plane(points)
        inside = np.hypot(plane[..., 0], plane[..., 1]) < self._max_radius()
        return self._to_pixels(self._distort(np.where(inside[..., None], plane, 0.0))), front & inside

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distorted = self._to_plane(pixels)
        limit = self._max_radius()
        # Start from the radial part alone, inverted by table over the field that the image needs.
        far = 1.5 * np.linalg.norm(distorted, axis=-1).max(initial=1.0) + 1.0
        radius = np.linspace(0, min(limit, far), _TABLE)
        table = radius * (1 + radius**2 * (self.k1 + self.k2 * radius**2))
        r = np.linalg.norm(distorted, axis=-1, keepdims=True)
        plane = distorted / np.maximum(r, 1e-12) * np.interp(r, table, radius)
        for _ in range(20):
            x, y = plane[..., 0], plane[..., 1]
            r2 = x * x + y * y
            radial, slope = 1 + r2 * (self.k1 + self.k2 * r2), 2 * self.k1 + 4 * self.k2 * r2
            xx = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
            xy = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y
            yy = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
            error = self._distort(plane) - distorted
            det = xx * yy - xy * xy
            det = np.where(np.abs(det) < 1e-9, 1e-9, det)
            step = np.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], -1)
            plane = plane - step / det[..., None]
            plane = plane * np.minimum(1.0, far / np.maximum(np.linalg.norm(plane, axis=-1, keepdims=True), 1e-12))
        solved = np.linalg.norm(self._distort(plane) - distorted, axis=-1) * self.focal_length < 1e-6
        valid = solved & (np.linalg.norm(plane, axis=-1) < limit)
        return _unit(np.concatenate([plane, np.ones_like(plane[..., :1])], -1)), valid


@dataclass(frozen=True)
class KannalaBrandt(_FocalCamera):
    """Fisheye, rho / f = theta + k1 theta³ + k2 theta⁵ + k3 theta⁷ + k4 theta⁹ (OPENCV_FISHEYE, vicalib's kb4)."""

    k1: float
    k2: float
    k3: float
    k4: float

    name: ClassVar[str] = "OPENCV_FISHEYE"

    def max_theta(self) -> float:
        """Half the field on which the model can be inverted, radians."""
        turn = np.sqrt(_first_positive_root([9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0]))
        return float(min(turn, _MAX_THETA))

    def _radius(self, theta: np.ndarray) -> np.ndarray:
        t2 = theta * theta
        return theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))

    def _slope(self, theta: np.ndarray) -> np.ndarray:
        t2 = theta * theta
        return 1 + t2 * (3 * self.k1 + t2 * (5 * self.k2 + t2 * (7 * self.k3 + t2 * 9 * self.k4)))

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        side = np.hypot(points[..., 0], points[..., 1])
        theta = np.arctan2(side, points[..., 2])
        limit = self.max_theta()
        valid = (theta < limit) & (np.linalg.norm(points, axis=-1) > 0)
        scale = self._radius(np.minimum(theta, limit)) / np.maximum(side, 1e-12)
        return self._to_pixels(points[..., :2] * scale[..., None]), valid

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        plane = self._to_plane(pixels)
        radius = np.hypot(plane[..., 0], plane[..., 1])
        limit = self.max_theta()
        table = np.linspace(0, limit, _TABLE)
        theta = np.interp(radius, self._radius(table), table)
        for _ in range(6):
            theta = theta - (self._radius(theta) - radius) / np.maximum(self._slope(theta), 1e-6)
            theta = np.clip(theta, 0, limit)
        return _ray_at(theta, plane, radius), radius < self._radius(np.asarray(limit))


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
        if self.a0 <= 0:
            raise InputError(f"SCARAMUZZA camera: a0 = {self.a0}; expected positive pixels (z into the scene)")
        if abs(self.c - self.d * self.e) < 1e-9:
            raise InputError("SCARAMUZZA camera: the stretch [[c, d], [e, 1]] is singular")

    @property
    def focal_length(self) -> float:
        return self.a0

    @property
    def _stretch(self) -> np.ndarray:
        return np.array([[self.c, self.d], [self.e, 1.0]])

    def _sensor(self, pixels: np.ndarray) -> np.ndarray:
        """(x', y') of pixels."""
        return (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) @ np.linalg.inv(self._stretch).T

    def _height(self, rho: np.ndarray) -> np.ndarray:
        return self.a0 + rho * (self.a1 + rho * (self.a2 + rho * (self.a3 + rho * self.a4)))

    def _height_slope(self, rho: np.ndarray) -> np.ndarray:
        return self.a1 + rho * (2 * self.a2 + rho * (3 * self.a3 + rho * 4 * self.a4))

    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        """theta over rho, as far as it grows and stays below 90 degrees."""
        corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]])
        # By the lens, not by the image size: a crop has the field of the whole image
        reach = max(4 * self.a0, 2 * float(np.linalg.norm(self._sensor(corners), axis=-1).max()))
        rho = np.linspace(0, reach, _TABLE * 2)
        theta = np.arctan2(rho, self._height(rho))
        stop = np.flatnonzero((np.diff(theta) <= 0) | (theta[1:] >= _MAX_THETA))
        end = int(stop[0]) + 1 if len(stop) else len(rho)
        return rho[:end], theta[:end]

    def max_theta(self) -> float:
        """Half the field on which the model can be inverted, radians."""
        return float(self._table()[1][-1])

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        side = np.hypot(points[..., 0], points[..., 1])
        theta = np.arctan2(side, points[..., 2])
        table_rho, table_theta = self._table()
        valid = (theta < table_theta[-1]) & (np.linalg.norm(points, axis=-1) > 0)
        theta = np.minimum(theta, table_theta[-1])
        rho = np.interp(theta, table_theta, table_rho)
        sine, cosine = np.sin(theta), np.cos(theta)
        for _ in range(6):  # rho cos(theta) = height(rho) sin(theta)
            error = rho * cosine - self._height(rho) * sine
            slope = cosine - self._height_slope(rho) * sine
            rho = rho - error / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        sensor = points[..., :2] * (rho / np.maximum(side, 1e-12))[..., None]
        return sensor @ self._stretch.T + (self.cx, self.cy), valid

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sensor = self._sensor(pixels)
        rho = np.hypot(sensor[..., 0], sensor[..., 1])
        limit = self._table()[0][-1]
        return _unit(np.concatenate([sensor, self._height(rho)[..., None]], -1)), rho < limit

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


def _ray_at(theta: np.ndarray, plane: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Unit rays at angle theta from the axis, in the direction of plane (..., 2) whose norm is radius."""
    side = plane * (np.sin(theta) / np.maximum(radius, 1e-12))[..., None]
    return np.concatenate([side, np.cos(theta)[..., None]], -1)


def _first_positive_root(coefficients: list[float]) -> float:
    """Smallest positive real root of a polynomial (highest power first); infinity when there is none."""
    roots = np.roots(coefficients)
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots.real))].real
    return float(min(real[real > 0], default=np.inf))


def _fisheye_radial(w: int, h: int, f: float, cx: float, cy: float, k1: float, k2: float = 0.0) -> KannalaBrandt:
    return KannalaBrandt(w, h, f, f, cx, cy, k1, k2, 0.0, 0.0)


CAMERA_MODELS: dict[str, type[CameraModel]] = {m.name: m for m in (Pinhole, Brown, KannalaBrandt, Scaramuzza)}

_COLMAP_SPECIAL: dict[
    str, tuple[int, Callable[..., CameraModel]]
] = {  # COLMAP's models that are special cases of ours: number of parameters, translation
    "SIMPLE_PINHOLE": (3, lambda w, h, f, cx, cy: Pinhole(w, h, f, f, cx, cy)),
    "SIMPLE_RADIAL": (4, lambda w, h, f, cx, cy, k: Brown(w, h, f, f, cx, cy, k, 0.0, 0.0, 0.0)),
    "RADIAL": (5, lambda w, h, f, cx, cy, k1, k2: Brown(w, h, f, f, cx, cy, k1, k2, 0.0, 0.0)),
    "SIMPLE_RADIAL_FISHEYE": (4, _fisheye_radial),
    "RADIAL_FISHEYE": (5, _fisheye_radial),
}


def camera_from_params(model: str, width: int, height: int, params: list[float], where: str = "camera") -> CameraModel:
    """A camera from its file form, in the pixel convention of the file (see with_pixel_center).

    `where` names the source in errors.
    """
    count: int
    build: Callable[..., CameraModel]
    if model in _COLMAP_SPECIAL:
        count, build = _COLMAP_SPECIAL[model]
    elif model in CAMERA_MODELS:
        cls = CAMERA_MODELS[model]
        count, build = len(fields(cls)) - 2, cls
    else:
        known = ", ".join([*CAMERA_MODELS, *_COLMAP_SPECIAL])
        raise InputError(f"{where}: unknown camera model {model!r}; expected one of {known}")
    if len(params) != count:
        raise InputError(f"{where}: {model} has {count} parameters, found {len(params)}")
    try:
        return build(int(width), int(height), *map(float, params))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
