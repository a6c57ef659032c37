"""Cameras from the name of their model and its parameters, as files have them."""

from __future__ import annotations

from collections.abc import Callable

from lightdepth.camera.fisheye import KannalaBrandt, Scaramuzza
from lightdepth.camera.foreign import (
    Bend,
    ForeignLens,
    division_bend,
    eucm_bend,
    fisheye_prism_bend,
    fisheye_radtan_prism_bend,
    fov_bend,
    nearest,
    opencv_bend,
)
from lightdepth.camera.model import CameraModel
from lightdepth.camera.perspective import Brown, FullBrown, Pinhole
from lightdepth.errors import InputError

CAMERA_MODELS: dict[str, type[CameraModel]] = {
    m.name: m for m in (Pinhole, Brown, FullBrown, KannalaBrandt, Scaramuzza)
}

_Build = Callable[[int, int, list[float]], CameraModel | ForeignLens]


def opencv_camera(width: int, height: int, numbers: list[float]) -> CameraModel | ForeignLens:
    """fx fy cx cy k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]: the shortest of our models that it is, else OpenCV's
    longest lens, to be fitted."""
    focal, terms = numbers[:4], numbers[4:]
    if any(terms[8:]):
        return ForeignLens("OpenCV's thin-prism", width, height, (*focal,), opencv_bend(terms))
    if any(terms[4:]):
        return FullBrown(width, height, *focal, *terms[:8], *[0.0] * (8 - len(terms)))
    return Brown(width, height, *focal, *terms[:4]) if any(terms) else Pinhole(width, height, *focal)


def _fisheye(width: int, height: int, numbers: list[float]) -> KannalaBrandt:
    fx, fy, cx, cy, k1, k2 = [*numbers, *[0.0] * (6 - len(numbers))]
    return KannalaBrandt(width, height, fx, fy, cx, cy, k1, k2, 0.0, 0.0)


def _single(build: _Build) -> _Build:
    """Of a model with one focal length, by what its model with two is."""
    return lambda w, h, p: build(w, h, [p[0], *p])


def _brown(w: int, h: int, p: list[float]) -> Brown:
    return Brown(w, h, *p, *[0.0] * (8 - len(p)))


def _prism(w: int, h: int, p: list[float]) -> CameraModel | ForeignLens:
    k1, k2, p1, p2, k3, k4, s1, s2 = p[4:]
    if not any((p1, p2, s1, s2)):
        return KannalaBrandt(w, h, p[0], p[1], p[2], p[3], k1, k2, k3, k4)
    bend = fisheye_prism_bend((k1, k2, k3, k4), p1, p2, (s1, s2))
    return ForeignLens("THIN_PRISM_FISHEYE", w, h, (*p[:4],), bend)


def _radtan_prism(w: int, h: int, p: list[float]) -> CameraModel | ForeignLens:
    if not any(p[8:]):
        return KannalaBrandt(w, h, *p[:8])
    bend = fisheye_radtan_prism_bend(p[4:10], p[10], p[11], p[12:])
    return ForeignLens("RAD_TAN_THIN_PRISM_FISHEYE", w, h, (*p[:4],), bend)


def _bent(name: str, bend: Callable[..., Bend], straight: Callable[[list[float]], bool]) -> _Build:
    """A lens fx fy cx cy and what `bend` takes; a pinhole where its terms are `straight`."""

    def build(w: int, h: int, p: list[float]) -> CameraModel | ForeignLens:
        if straight(p[4:]):
            return Pinhole(w, h, *p[:4])
        return ForeignLens(name, w, h, (*p[:4],), bend(*p[4:]))

    return build


_division = _bent("DIVISION", division_bend, lambda terms: terms[0] == 0)

_OTHERS: dict[str, tuple[int, _Build]] = {  # COLMAP's models that are none of ours: number of parameters, translation
    "SIMPLE_PINHOLE": (3, _single(lambda w, h, p: Pinhole(w, h, *p))),
    "SIMPLE_RADIAL": (4, _single(_brown)),
    "RADIAL": (5, _single(_brown)),
    "FISHEYE": (4, _fisheye),
    "SIMPLE_FISHEYE": (3, _single(_fisheye)),
    "SIMPLE_RADIAL_FISHEYE": (4, _single(_fisheye)),
    "RADIAL_FISHEYE": (5, _single(_fisheye)),
    "FULL_OPENCV": (12, opencv_camera),
    "THIN_PRISM_FISHEYE": (12, _prism),
    "RAD_TAN_THIN_PRISM_FISHEYE": (16, _radtan_prism),
    "FOV": (5, _bent("FOV", fov_bend, lambda terms: terms[0] == 0)),
    "DIVISION": (5, _division),
    "SIMPLE_DIVISION": (4, _single(_division)),
    "EUCM": (6, _bent("EUCM", eucm_bend, lambda terms: terms[0] == 0)),
}


def camera_from_params(model: str, width: int, height: int, params: list[float], where: str = "camera") -> CameraModel:
    """A camera from its file form, in the pixel convention of the file (see with_pixel_center).

    A lens that none of ours is exactly becomes the nearest of ours, which is said (`foreign.nearest`). `where` names
    the source in errors.
    """
    build: _Build
    if model in _OTHERS:
        count, build = _OTHERS[model]
    elif model in CAMERA_MODELS:
        cls = CAMERA_MODELS[model]
        count, build = len(cls.parameters()), lambda w, h, p: cls(w, h, *p)
    else:
        known = ", ".join([*CAMERA_MODELS, *_OTHERS])
        raise InputError(where, f"unknown camera model {model!r}", f"expected one of {known}")
    if len(params) != count:
        names = f": {' '.join(cls.parameters())}" if model in CAMERA_MODELS else ""
        raise InputError(where, f"{len(params)} parameters of {model}", f"expected {count}{names}")
    return camera_of(lambda: build(int(width), int(height), [float(p) for p in params]), where)


def camera_of(build: Callable[[], CameraModel | ForeignLens], where: str) -> CameraModel:
    """What `build` gives, or the nearest camera of ours to it; its errors name `where`."""
    try:
        found = build()
    except InputError as error:
        raise error.within(where) from error
    return nearest(found, where) if isinstance(found, ForeignLens) else found
