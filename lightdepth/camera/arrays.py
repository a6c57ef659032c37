"""What the camera models need of arrays, for numpy and torch alike.

Each formula of a lens stands once, in the names that numpy and torch share; `namespace` tells which of the two an array
is of. Here is what they do not share, and what needs care for gradients: 0/0 on the axis, and overflow beside it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

Array = TypeVar("Array", np.ndarray, Tensor)

NEAR_AXIS = 1e-6  # radians; the lenses are linear there to 1e-12 of the distance from the axis
_FLATTEST = 1e-5  # z over the distance from the axis, at which x/z ends: the powers of more overflow float32
_NO_COEFFICIENT = 1e-100


def namespace(array: np.ndarray | Tensor) -> Any:
    """torch for a tensor, else numpy."""
    return torch if isinstance(array, Tensor) else np


def floating(array: Array) -> Array:
    if not isinstance(array, Tensor):
        return np.asarray(array, dtype=np.float64)
    if array.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"camera: a tensor of {array.dtype}; expected float32 or float64")
    return array


def detached(array: Array) -> Array:
    return array.detach() if isinstance(array, Tensor) else array


def length(x: Array, y: Array) -> Array:
    """sqrt(x² + y²), with gradient 0 at 0."""
    if not isinstance(x, Tensor):
        result: Array = np.hypot(x, y)
        return result
    zero = (x == 0) & (y == 0)
    return torch.where(zero, 0.0, torch.hypot(torch.where(zero, 1.0, x), y))


def interpolated(at: Array, knots: np.ndarray, values: np.ndarray) -> Array:
    """np.interp, without gradient: the first guess of a root."""
    if not isinstance(at, Tensor):
        result: Array = np.interp(at, knots, values)
        return result
    at = at.detach().contiguous()
    x, y = (torch.as_tensor(table, dtype=at.dtype, device=at.device) for table in (knots, values))
    i = torch.searchsorted(x, at).clamp(1, len(x) - 1)
    return torch.lerp(y[i - 1], y[i], ((at - x[i - 1]) / (x[i] - x[i - 1])).clamp(0, 1))


def unit(vectors: Array) -> Array:
    result: Array = vectors / namespace(vectors).linalg.norm(vectors, axis=-1, keepdims=True)
    return result


def scaled(points: Array, scale: tuple[float, float], offset: tuple[float, float]) -> Array:
    """points (..., 2) * scale + offset."""
    x, y = points[..., 0] * scale[0] + offset[0], points[..., 1] * scale[1] + offset[1]
    result: Array = namespace(points).stack([x, y], -1)
    return result


def to_plane(points: Array) -> tuple[Array, Array]:
    """(x/z, y/z) of points, and where they are in front of the camera."""
    xp, z = namespace(points), points[..., 2]
    front = z > _FLATTEST * xp.hypot(points[..., 0], points[..., 1])
    return points[..., :2] / xp.where(front, z, 1.0)[..., None], front


def rays_through_plane(plane: Array) -> Array:
    """Unit rays through (x/z, y/z)."""
    xp = namespace(plane)
    result: Array = unit(xp.concatenate([plane, xp.ones_like(plane[..., :1])], -1))
    return result


def angle_from_axis(points: Array) -> tuple[Array, Array, Array]:
    """Angle theta of points from the axis, their distance from it, and where there is an angle (not at 0)."""
    xp, z = namespace(points), points[..., 2]
    side = length(points[..., 0], points[..., 1])
    exists = (side > 0) | (z != 0)
    return xp.arctan2(side, xp.where(exists, z, 1.0)), side, exists


def at_radius(points: Array, side: Array, rho: Array, focal: float) -> Array:
    """The (x, y) of points, `side` from the axis, moved to rho from it; near the axis rho = focal side / z."""
    xp, z = namespace(points), points[..., 2]
    near = side < NEAR_AXIS * z
    far = side > 1e-12 * abs(z)
    scale = xp.where(near, focal / xp.where(near, z, 1.0), rho / xp.where(far, side, 1.0))
    result: Array = points[..., :2] * scale[..., None]
    return result


@lru_cache(maxsize=256)
def first_positive_root(*coefficients: float) -> float:
    """Smallest positive real root of a polynomial (highest power first); infinity when there is none."""
    # Of a coefficient without size the root lies beyond any image, and the others divided by it overflow.
    roots = np.roots([0.0 if abs(c) < _NO_COEFFICIENT else c for c in coefficients])
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots.real))].real
    return float(min(real[real > 0], default=np.inf))
