"""Cameras from the name of their model and its parameters, as files have them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

from lightdepth.camera.fisheye import KannalaBrandt, Scaramuzza
from lightdepth.camera.model import CameraModel
from lightdepth.camera.perspective import Brown, Pinhole
from lightdepth.errors import InputError


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
        raise InputError(where, f"unknown camera model {model!r}", f"expected one of {known}")
    if len(params) != count:
        names = f": {' '.join(f.name for f in fields(cls)[2:])}" if model in CAMERA_MODELS else ""
        raise InputError(where, f"{len(params)} parameters of {model}", f"expected {count}{names}")
    try:
        return build(int(width), int(height), *map(float, params))
    except InputError as error:
        raise error.within(where) from error
