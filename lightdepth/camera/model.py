"""What all cameras have in common. Notation and conventions: see the package."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from lightdepth.camera.arrays import Array, floating, scaled
from lightdepth.camera.provenance import Provenance
from lightdepth.errors import InputError

MAX_THETA = np.pi / 2
LONGEST_SIDE = 65535
"""Pixels of the longest side of an image."""
LARGEST = 1e12
"""Magnitude of a parameter beyond which a camera is of a broken file: its products leave double precision."""
LEAST_FOCAL = 1e-6
"""Pixels of a focal length below which it is none: its inverse is a factor of every ray."""
TABLE = 2048  # entries of the tables from which Newton's method starts


@dataclass(frozen=True)
class CameraModel(ABC):
    """An image size and the intrinsics of one lens. Sizes and lengths in pixels."""

    width: int
    height: int
    provenance: Provenance | None = field(default=None, kw_only=True, compare=False, repr=False)
    """Where the camera is from, where its file says it: no part of what it is."""

    name: ClassVar[str]

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            size = f"{str(self.width)[:20]}x{str(self.height)[:20]}"
            raise InputError("camera size", size, "expected positive numbers of pixels")
        if max(self.width, self.height) > LONGEST_SIDE:
            digits = f"{str(self.width)[:20]}x{str(self.height)[:20]}"
            raise InputError("camera size", digits, f"expected sides of at most {LONGEST_SIDE} pixels")
        numbers = ("width", "height", *self.parameters())
        bad = [name for name in numbers if not np.isfinite(getattr(self, name))]
        if bad:
            raise InputError(f"{self.name} camera", f"{', '.join(bad)} not finite", "expected numbers")
        large = [name for name in numbers if abs(getattr(self, name)) > LARGEST]
        if large:
            raise InputError(f"{self.name} camera", f"{', '.join(large)} beyond {LARGEST:g}", "expected pixels")

    @abstractmethod
    def _pixels(self, points: Array) -> tuple[Array, Array]:
        """Pixels of points and whether the model holds there, whatever the image size."""

    @abstractmethod
    def _rays(self, pixels: Array) -> tuple[Array, Array]:
        """Unit rays through pixels, and where the model can be inverted."""

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

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) of points (..., 3), and whether each is seen: in the model's field and inside the image.

        Arrays are taken as float64. Tensors keep their device and type, float32 or float64 (any other raises
        TypeError), and can be differentiated through.
        """
        pixels, valid = self._pixels(floating(points))
        inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= self.width) & (pixels[..., 1] <= self.height)
        return pixels, valid & inside

    def unproject(self, pixels: Array) -> tuple[Array, Array]:
        """Unit rays (..., 3) through pixels (..., 2), and where the model can be inverted. Types as in project."""
        return self._rays(floating(pixels))

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
        return tuple(getattr(self, name) for name in self.parameters())

    @classmethod
    def parameters(cls) -> tuple[str, ...]:
        """Names of the intrinsics, in the order of `params`."""
        return tuple(f.name for f in fields(cls) if f.name not in ("width", "height", "provenance"))


@lru_cache(maxsize=16)
def _ray_map(camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays, valid = camera.unproject(np.stack([u, v], -1))
    rays.flags.writeable = valid.flags.writeable = False
    return rays, valid


@dataclass(frozen=True)
class FocalCamera(CameraModel):
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.fx >= LEAST_FOCAL and self.fy >= LEAST_FOCAL):
            raise InputError(f"{self.name} camera", f"focal lengths {self.fx}, {self.fy}", "expected positive pixels")

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

    def _to_pixels(self, plane: Array) -> Array:
        return scaled(plane, (self.fx, self.fy), (self.cx, self.cy))

    def _to_plane(self, pixels: Array) -> Array:
        return scaled(pixels, (1 / self.fx, 1 / self.fy), (-self.cx / self.fx, -self.cy / self.fy))
