"""One camera model in place of another: the closest camera of a wanted model, and how close it is.

For programs that know fewer lenses than we do: COLMAP has no Scaramuzza camera, vicalib's XML has no tangential
distortion. The rays through the pixels of the first camera are the data; least squares is over pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lightdepth.camera import CAMERA_MODELS, Brown, CameraModel, FullBrown, KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.errors import InputError

LARGEST_ERROR_SHARE = 0.005
"""A camera stands in for another where no pixel is farther off than this part of the image's longer side: 7 pixels of
an endoscope's 1350 (its Scaramuzza lens as a fisheye is 2 to 3 off)."""

_FITTED = 5000  # pixels, of all that count
_PLANE_LIMIT = np.cos(np.radians(75))  # beyond this angle x/z runs away, and would be all that is fitted

_Residuals = Callable[[CameraModel, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Conversion:
    """The closest camera of another model: pixel = camera(rotation @ ray).

    The rotation (3, 3) is about the optical axis, and the identity unless a roll was allowed. Residuals in pixels, over
    the valid pixels that both cameras can see; `seen_share` is how many of the valid pixels these are.
    """

    camera: CameraModel
    rotation: np.ndarray
    median_px: float
    max_px: float
    seen_share: float

    def close_enough(self, where: str, most_px: float | None = None) -> Conversion:
        """Itself, or InputError where it is more than `most_px` off somewhere; None is `LARGEST_ERROR_SHARE`."""
        side = max(self.camera.width, self.camera.height)
        most = LARGEST_ERROR_SHARE * side if most_px is None else most_px
        if self.max_px > most:
            off = f"{self.median_px:.2g} pixels (median), {self.max_px:.2g} (largest)"
            raise InputError(
                where,
                f"the nearest {self.camera.name} is off by {off}",
                f"expected {most:.2g} at most: choose another lens model, a mask of what counts, or a larger --most-px "
                "of convert-camera",
            )
        return self


def convert_camera(
    camera: CameraModel, model_name: str, valid: np.ndarray | None = None, roll: bool = False
) -> Conversion:
    """The camera of `model_name` that puts the rays of `camera` closest to their pixels, in least squares.

    valid (H, W): the pixels that count, as a mask has them; all that the camera can see where left out. PINHOLE and
    OPENCV are fitted up to 75 degrees from the axis. `roll` lets the new camera turn about its axis, which takes up
    what another model's skew hides of such a turn: poses have to turn with it. Raises InputError for an unknown
    model, and where no pixel counts.
    """
    from scipy.optimize import least_squares

    if model_name not in CAMERA_MODELS:
        raise InputError("camera model", f"{model_name!r} is not known", f"expected one of {', '.join(CAMERA_MODELS)}")
    model = CAMERA_MODELS[model_name]
    all_rays, seen = camera.rays()
    counted = seen if valid is None else valid & seen
    rows, columns = np.nonzero(counted)
    if not len(rows):
        raise InputError("the mask", "no valid pixel in it: no camera can be fitted", "is it inverted?")
    rays, pixels = all_rays[rows, columns], np.stack([columns, rows], -1) + 0.5
    fitted = np.flatnonzero(rays[:, 2] > _PLANE_LIMIT) if issubclass(model, Pinhole | Brown) else np.arange(len(rays))
    if not len(fitted):
        raise InputError(
            "the mask",
            f"no valid pixel within 75 degrees of the axis: no {model_name} camera can be fitted",
            "choose a fisheye model",
        )
    fitted = fitted[:: max(1, len(fitted) // _FITTED)]

    start, scale = _start(camera, model, rays[fitted], pixels[fitted])
    count = len(start)
    rolls = roll and model is not Scaramuzza  # whose stretch can turn by itself

    def candidate(parameters: np.ndarray) -> tuple[CameraModel, np.ndarray]:
        angle = parameters[count] if rolls else 0.0
        sine, cosine = np.sin(angle), np.cos(angle)
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
        numbers = parameters[:count].tolist()
        if model is Scaramuzza:
            numbers.insert(3, 0.0)  # a1 would put the tip of a cone on the axis
        return model(camera.width, camera.height, *numbers), rotation

    residuals = _RESIDUALS[model]

    def errors(parameters: np.ndarray) -> np.ndarray:
        try:
            trial, rotation = candidate(parameters)
        except InputError:  # a step to where no such camera exists, as to a negative focal length: too far
            return np.full(2 * len(fitted) if model is not Scaramuzza else 3 * len(fitted), 1e6)
        return residuals(trial, rays[fitted] @ rotation.T, pixels[fitted]).ravel()

    solved = least_squares(
        errors, [*start, *[0.0] * rolls], x_scale=[*scale, *[0.01] * rolls], ftol=1e-12, max_nfev=100
    )
    found, rotation = candidate(solved.x)
    projected, both = found.project(rays @ rotation.T)
    if not both.any():
        raise InputError(f"{camera.name} camera", f"no {model_name} camera sees what it sees", "choose another model")
    error = np.linalg.norm(projected - pixels, axis=1)[both]
    return Conversion(found, rotation, float(np.median(error)), float(error.max()), float(both.mean()))


def _start(
    camera: CameraModel, model: type[CameraModel], rays: np.ndarray, pixels: np.ndarray
) -> tuple[list[float], list[float]]:
    """First parameters, with the same axis and focal length, and the size of a step in each."""
    focal = camera.focal_length
    x, y = camera.project(np.array([0, 0, 1.0]))[0].tolist()
    if model is Scaramuzza:
        rho = np.linalg.norm(pixels - (x, y), axis=1)
        side = np.hypot(rays[:, 0], rays[:, 1])
        off_axis = side > 1e-6
        rho, height = rho[off_axis], rho[off_axis] * rays[off_axis, 2] / side[off_axis]
        reach = float(rho.max(initial=1.0))
        powers = np.array([0, 2, 3, 4])
        shape = np.linalg.lstsq((rho[:, None] / reach) ** powers, height)[0] / reach**powers
        return [x, y, *shape.tolist(), 1, 0, 0], [focal, focal, *(focal / reach**powers).tolist(), 0.1, 0.1, 0.1]
    distortion = len(model.parameters()) - 4
    return [focal, focal, x, y, *[0.0] * distortion], [*[focal] * 4, *[0.1] * distortion]


# Not `project`: a residual has to exist for every ray, also where a trial's polynomial turns over.


def _pixel_residuals(trial: CameraModel, rays: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    if isinstance(trial, KannalaBrandt):
        side = np.hypot(rays[:, 0], rays[:, 1])
        radius = trial._radius(np.arctan2(side, rays[:, 2]))
        plane = rays[:, :2] * (radius / np.maximum(side, 1e-12))[:, None]
    else:
        plane = rays[:, :2] / rays[:, 2:]
        if isinstance(trial, Brown):
            plane = trial._distort(plane)
    assert isinstance(trial, Pinhole | Brown | KannalaBrandt)
    result: np.ndarray = trial._to_pixels(plane) - pixels
    return result


def _ray_residuals(trial: CameraModel, rays: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """In ray space, where Scaramuzza's model is a formula, scaled to pixels at the axis."""
    result: np.ndarray = (trial.unproject(pixels)[0] - rays) * trial.focal_length
    return result


_RESIDUALS: dict[type[CameraModel], _Residuals] = {
    Pinhole: _pixel_residuals,
    Brown: _pixel_residuals,
    FullBrown: _pixel_residuals,
    KannalaBrandt: _pixel_residuals,
    Scaramuzza: _ray_residuals,
}


def without_k3(camera: Brown, k3: float) -> tuple[Brown, float]:
    """The Brown camera closest to `camera` with OpenCV's third radial term k3 added, and by how many pixels it is off.

    The focal lengths and the principal point stay, so that the fit is linear. The second number is the largest
    difference in the image.
    """
    steps = np.linspace(0, 1, 33)
    border = np.array([p for t in steps for p in ((t, 0), (t, 1), (0, t), (1, t))])
    rays, _ = camera.unproject(border * (camera.width, camera.height))
    reach = 1.05 * np.abs(rays[:, :2] / rays[:, 2:]).max(0)
    x, y = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-r, r, 81) for r in reach)))
    r2 = x * x + y * y
    plane = np.stack([x, y], -1)
    wanted = camera._distort(plane) + plane * (k3 * r2**3)[:, None]
    pixels = camera._to_pixels(wanted)
    inside = (pixels >= 0).all(-1) & (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height)
    across = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x], -1)
    down = np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y], -1)
    terms = np.concatenate([across[inside], down[inside]])
    k1, k2, p1, p2 = np.linalg.lstsq(terms, (wanted - plane)[inside].T.ravel())[0].tolist()
    found = replace(camera, k1=k1, k2=k2, p1=p1, p2=p2)
    off = np.linalg.norm(camera._to_pixels(found._distort(plane)) - pixels, axis=1)
    return found, float(off[inside].max())
