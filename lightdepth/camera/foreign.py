"""Lenses of other programs that none of ours is exactly: the nearest of ours, and by how many pixels it is off.

Notation: a lens bends unit rays (n, 3) to points (n, 2) of the plane, on which pixel = focal * point + principal point.
Ours are fitted to it in least squares over the image, each pixel counting alike, as far as the lens goes: to where its
polynomial is about to turn over, or 90 degrees from the axis.

Formulas: OpenCV (calib3d), COLMAP (camera models), Usenko et al. 2018 (double sphere, EUCM), Mei 2007 (omni).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lightdepth.camera.fisheye import KannalaBrandt
from lightdepth.camera.perspective import FullBrown
from lightdepth.errors import InputError

LARGEST_ERROR_PX = 1.0
"""A lens is refused where the nearest of ours is farther off than this anywhere in the image, pixels."""

_FITTED = 800  # rays, of all that the residual is over
_LEAST_SLOPE = 0.25  # of pixels over angle, against the axis: next to its turn a polynomial holds no calibration

Bend = Callable[[np.ndarray], np.ndarray]
_Fitted = FullBrown | KannalaBrandt


@dataclass(frozen=True)
class ForeignLens:
    """pixel = focal * bend(ray) + principal point, in the pixel convention of its file."""

    name: str
    width: int
    height: int
    focal: tuple[float, ...]
    """fx, fy, cx, cy, pixels."""
    bend: Bend

    def pixels(self, rays: np.ndarray) -> np.ndarray:
        """(n, 2) pixels of rays (n, 3), whether inside the image or not."""
        fx, fy, cx, cy = self.focal
        result: np.ndarray = self.bend(rays) * (fx, fy) + (cx, cy)
        return result


def nearest(lens: ForeignLens, where: str) -> _Fitted:
    """The camera of ours that is nearest to the lens, its residual said in a warning.

    Raises InputError where it is more than `LARGEST_ERROR_PX` off somewhere in the image; `where` names the source.
    """
    rays, pixels, weights = _samples(lens, where)
    fitted = [_fit(model, lens, rays, pixels, weights) for model in (FullBrown, KannalaBrandt)]
    found = [(camera, off) for camera, off in fitted if camera is not None]
    if not found:
        raise InputError(where, f"{lens.name} lens: its nearest lens models here fold inside the image", _UNDISTORT)
    camera, off = min(found, key=lambda pair: float(pair[1].max()))
    residual = f"off by {np.median(off):.2g} pixels (median), {off.max():.2g} (largest)"
    if off.max() > LARGEST_ERROR_PX:
        raise InputError(
            where,
            f"{lens.name} lens: the nearest of ours, {camera.name}, is {residual}",
            f"expected {LARGEST_ERROR_PX:g} at most. {_UNDISTORT}",
        )
    warnings.warn(f"{where}: {lens.name} lens read as {camera.name}, the nearest of ours: {residual}", stacklevel=4)
    return camera


_UNDISTORT = "Undistort the images with the program that calibrated them, or calibrate for OPENCV_FISHEYE"


def _samples(lens: ForeignLens, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays (n, 3) that the lens sees in its image, their pixels (n, 2), and the area that each stands for (n,)."""
    _, _, cx, cy = lens.focal
    corners = [np.arctan2(y - cy, x - cx) for x in (0, lens.width) for y in (0, lens.height)]
    theta, azimuth = np.radians(np.linspace(0, 89.5, 500)), np.radians([*np.arange(0, 360, 5.0), *np.degrees(corners)])
    side = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)[None] * np.sin(theta)[:, None, None]
    height = np.broadcast_to(np.cos(theta)[:, None, None], (*side.shape[:2], 1))
    rays = np.concatenate([side, height], -1)
    with np.errstate(all="ignore"):
        pixels = lens.pixels(rays.reshape(-1, 3)).reshape(*side.shape[:2], 2)
        radius = np.linalg.norm(pixels - pixels[:1], axis=-1)
        slope = np.diff(radius, axis=0)
        grows = np.vstack([np.ones((1, len(azimuth)), bool), slope > _LEAST_SLOPE * slope[:1]])
    before_turn = np.logical_and.accumulate(grows & np.isfinite(radius), axis=0)
    inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= lens.width) & (pixels[..., 1] <= lens.height)
    seen = before_turn & inside
    if seen.sum() < 100:
        raise InputError(
            where, f"{lens.name} lens: hardly any ray falls into its image", "expected focal lengths in pixels"
        )
    area = radius * np.gradient(radius, axis=0)
    return rays[seen], pixels[seen], np.clip(area[seen], 0, None) + 1e-3


def _fit(
    model: type[FullBrown] | type[KannalaBrandt],
    lens: ForeignLens,
    rays: np.ndarray,
    pixels: np.ndarray,
    weights: np.ndarray,
) -> tuple[_Fitted | None, np.ndarray]:
    """The closest camera of a model, or None, and how far each pixel is off."""
    from scipy.optimize import least_squares

    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    if model is FullBrown and theta.max() > np.radians(80):
        return None, np.zeros(0)
    some = slice(None, None, max(1, len(rays) // _FITTED))
    root = np.sqrt(weights[some] / weights.mean())[:, None]

    def projected(rays: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy, *terms = numbers
        plane = (_brown if model is FullBrown else _kannala)(rays, *terms)
        result: np.ndarray = plane * (fx, fy) + (cx, cy)
        return result

    middle = theta <= max(np.radians(5), theta.min())  # an image cut out of a larger one may not hold its axis
    base = lens.pixels(rays[middle]) - lens.pixels(np.array([[0, 0, 1.0]]))
    slope = np.linalg.norm(base, axis=1).sum() / np.linalg.norm(rays[middle, :2], axis=1).sum()
    fx, fy, cx, cy = lens.focal
    terms = 5 if model is FullBrown else 4
    start = [slope * fx / np.sqrt(fx * fy), slope * fy / np.sqrt(fx * fy), cx, cy, *[0.0] * terms]
    scale = [*[slope] * 4, *[0.1] * terms]
    solved = least_squares(
        lambda numbers: (root * (projected(rays[some], numbers) - pixels[some])).ravel(),
        start,
        x_scale=scale,
        max_nfev=60,
    )
    if not (solved.x[:2] > 0).all():
        return None, np.zeros(0)
    camera = model(lens.width, lens.height, *solved.x.tolist(), *[0.0] * (3 if model is FullBrown else 0))
    _, valid = camera._pixels(rays)
    if not valid.all():  # its polynomial turns over inside the image
        return None, np.zeros(0)
    return camera, np.linalg.norm(projected(rays, solved.x) - pixels, axis=1)


# ---- the formulas


def _plane(rays: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        result: np.ndarray = rays[:, :2] / rays[:, 2:]
    return result


def _brown(rays: np.ndarray, k1: float, k2: float, p1: float, p2: float, k3: float) -> np.ndarray:
    return opencv_bend((k1, k2, p1, p2, k3))(rays)


def _kannala(rays: np.ndarray, *terms: float) -> np.ndarray:
    point = _equidistant(rays)
    t2 = (point * point).sum(-1, keepdims=True)
    result: np.ndarray = point * _series(t2, terms)
    return result


def _series(t: np.ndarray, terms: Sequence[float]) -> np.ndarray:
    """1 + k1 t + k2 t² + ..."""
    result: np.ndarray = np.polynomial.polynomial.polyval(t, [1.0, *terms])
    return result


def _equidistant(rays: np.ndarray) -> np.ndarray:
    """(n, 2) as far from the middle as the angle from the axis."""
    side = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.arctan2(side, rays[:, 2])
    result: np.ndarray = rays[:, :2] * (theta / np.maximum(side, 1e-12))[:, None]
    return result


def _tangential(
    point: np.ndarray,
    radial: Callable[[np.ndarray], np.ndarray],
    p1: float,
    p2: float,
    prism: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
) -> np.ndarray:
    """OpenCV's distortion of points (n, 2): radial, tangential and thin-prism terms s1 s2 s3 s4."""
    x, y = point[:, 0], point[:, 1]
    r2 = x * x + y * y
    s1, s2, s3, s4 = prism
    factor = radial(r2)
    return np.stack(
        [
            x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2 * r2,
            y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2 * r2,
        ],
        -1,
    )


def opencv_bend(coefficients: Sequence[float]) -> Bend:
    """OpenCV's distortion: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]."""
    k1, k2, p1, p2, k3, k4, k5, k6, *prism = [*coefficients, *[0.0] * (12 - len(coefficients))]

    def radial(r2: np.ndarray) -> np.ndarray:
        return (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))

    return lambda rays: _tangential(_plane(rays), radial, p1, p2, prism)


def radial_bend(*terms: float, p1: float = 0.0, p2: float = 0.0) -> Bend:
    """x (1 + k1 r² + k2 r⁴ + k3 r⁶ + ...) and two tangential terms."""

    return lambda rays: _tangential(_plane(rays), lambda r2: _series(r2, terms), p1, p2)


def division_bend(k: float) -> Bend:
    """Fitzgibbon's division: the point of the plane is distorted / (1 + k |distorted|²)."""

    def bend(rays: np.ndarray) -> np.ndarray:
        side, z = np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]
        result: np.ndarray = rays[:, :2] * (2 / (z + np.sqrt(z * z - 4 * k * side * side)))[:, None]
        return result

    return bend


def fov_bend(omega: float) -> Bend:
    """Devernay's field of view: distorted radius = atan(2 r tan(omega / 2)) / omega."""
    if not abs(omega) < np.pi:
        raise InputError("FOV lens", f"omega {omega:g}", "expected radians, below pi")

    def bend(rays: np.ndarray) -> np.ndarray:
        side = np.hypot(rays[:, 0], rays[:, 1])
        if abs(omega) < 1e-9:
            return _plane(rays)
        radius = np.arctan2(2 * side * np.tan(omega / 2), rays[:, 2]) / omega
        on_axis = np.maximum(side, 1e-12)
        result: np.ndarray = rays[:, :2] * np.where(side > 1e-12, radius / on_axis, 1.0)[:, None]
        return result

    return bend


def _check_alpha(where: str, alpha: float) -> None:
    if not 0 <= alpha <= 1:
        raise InputError(where, f"alpha {alpha:g}", "expected 0 to 1: are the numbers in another order?")


def eucm_bend(alpha: float, beta: float) -> Bend:
    """Khomutenko's extended unified model."""
    _check_alpha("EUCM lens", alpha)

    def bend(rays: np.ndarray) -> np.ndarray:
        x, y, z = rays.T
        result: np.ndarray = rays[:, :2] / (alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z)[:, None]
        return result

    return bend


def double_sphere_bend(xi: float, alpha: float) -> Bend:
    """Usenko's double sphere, of unit rays."""
    _check_alpha("double sphere lens", alpha)

    def bend(rays: np.ndarray) -> np.ndarray:
        x, y, z = rays.T
        shifted = xi + z
        result: np.ndarray = (
            rays[:, :2] / (alpha * np.sqrt(x * x + y * y + shifted * shifted) + (1 - alpha) * shifted)[:, None]
        )
        return result

    return bend


def omni_bend(xi: float, coefficients: Sequence[float]) -> Bend:
    """Mei's unified model, of unit rays, with OpenCV's distortion behind it."""
    behind = opencv_bend(coefficients)
    return lambda rays: behind(rays + (0.0, 0.0, xi))


def fisheye_prism_bend(terms: Sequence[float], p1: float, p2: float, prism: tuple[float, float]) -> Bend:
    """COLMAP's THIN_PRISM_FISHEYE: everything acts on the equidistant point."""

    sides = (prism[0], 0.0, prism[1], 0.0)
    return lambda rays: _tangential(_equidistant(rays), lambda r2: _series(r2, terms), p1, p2, sides)


def fisheye_radtan_prism_bend(terms: Sequence[float], p0: float, p1: float, prism: Sequence[float]) -> Bend:
    """COLMAP's RAD_TAN_THIN_PRISM_FISHEYE (Meta's Project Aria): radial first, then the rest on the bent point."""

    def ones(r2: np.ndarray) -> np.ndarray:
        return np.ones_like(r2)

    return lambda rays: _tangential(_kannala(rays, *terms), ones, p1, p0, prism)
