"""A camera matrix K with OpenCV's distortion coefficients D, under whatever keys people write them.

OpenCV and ROS say `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients` and perhaps
`distortion_model`; others K, D, mtx, dist, resolution, fx. The lens is the one that any of the keys for it names; with
`fisheye` or `equidistant` the 4 coefficients are cv2.fisheye's k1..k4, else OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 ...]].
The first pixel's centre is at (0, 0).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.calibration.other_programs import FISHEYE_WORDS, letters, needed_size
from lightdepth.camera import CameraModel, KannalaBrandt, camera_from_params, camera_of, opencv_camera
from lightdepth.errors import InputError
from lightdepth.files.text import to_numbers

Fields = dict[str, Any]

_BROWN = (
    "plumbbob",
    "radtan",
    "radialtangential",
    "opencv",
    "brown",
    "brownconrady",
    "rational",
    "rationalpolynomial",
    "thinprism",
    "pinhole",
    "perspective",
    "none",
    "",
)
_OTHER_LENSES = ("omni", "omnidir", "mei", "unified", "ucm", "eucm", "ds", "doublesphere", "scaramuzza", "ocam", "fov")
# Keys in small letters, `_` and `-` left out; the first one that a file has counts.
_WIDTHS = ("imagewidth", "width", "imgwidth", "w", "cols")
_HEIGHTS = ("imageheight", "height", "imgheight", "h", "rows")
_SIZES = ("imagesize", "imgsize", "resolution", "size", "dims", "dim")
_SHAPES = ("imageshape", "imgshape", "shape")  # rows before columns, as numpy has it
_MATRICES = ("cameramatrix", "k", "mtx", "intrinsicmatrix", "intrinsics", "intrinsic", "cameraintrinsics", "m")
_COEFFICIENTS = (
    "distortioncoefficients",
    "d",
    "dist",
    "distortion",
    "distcoeffs",
    "distcoeff",
    "distcoefs",
    "distortioncoeffs",
    "distortioncoeff",
    "distortionparameters",
    "distortionparams",
    "distcoefficients",
    "coefficients",
    "coeffs",
    "coefs",
)
_MODELS = (
    "distortionmodel",
    "cameramodel",
    "model",
    "modeltype",
    "cameratype",
    "distortiontype",
    "lensmodel",
    "lenstype",
    "projectionmodel",
    "projection",
    "lens",
    "type",
)


def matrix_and_distortion(content: Fields, path: Path, size: tuple[int, int] | None) -> CameraModel:
    """The camera of a file's K and D. Raises InputError, naming what is missing or cannot be."""
    fields = {key.replace("_", "").replace("-", ""): value for key, value in content.items()}
    matrix = _matrix(fields, path)
    width, height = _size_of(fields, path, size)
    matrix = _in_pixels(matrix, width, height, path)
    focal = [matrix[0], matrix[4], matrix[2], matrix[5]]
    terms, fisheye = _coefficients(fields, path), _is_fisheye(fields, path)
    where = f"{path}: distortion_coefficients"
    if fisheye:
        if len(terms) != 4:
            raise InputError(where, f"{len(terms)} numbers", "the model fisheye has 4: k1 k2 k3 k4")
        camera = camera_from_params(KannalaBrandt.name, width, height, [*focal, *terms], str(path))
    else:
        opencv = [*focal, *_opencv_terms(terms, where)]
        camera = camera_of(lambda: opencv_camera(width, height, opencv), str(path))
        if len(terms) == 4 and any(terms) and not any(letters(fields.get(key)) in _BROWN[:-1] for key in _MODELS):
            warnings.warn(
                f"{where}: 4 numbers and no distortion_model: read as k1 k2 p1 p2. If cv2.fisheye made them, add the "
                "line `distortion_model: fisheye`",
                stacklevel=4,
            )
    return camera.with_pixel_center(0.0)


def matrix_numbers(fields: Fields, key: str, path: Path) -> list[float]:
    """The numbers of a matrix, row by row, written with rows, cols and data or as nested lists."""
    return _flat(_field(fields, key, path), f"{path}: {key}")


def _field(fields: Fields, key: str, path: Path) -> Any:
    if fields.get(key) is None:
        raise _missing(key, path)
    return fields[key]


def _missing(key: str, path: Path) -> InputError:
    return InputError(
        path,
        f"{key} missing",
        "expected image_width, image_height, camera_matrix, distortion_coefficients (zeros for none)",
    )


def _first(fields: Fields, keys: Sequence[str]) -> str | None:
    return next((key for key in keys if fields.get(key) is not None), None)


def _first_of_many(fields: Fields, keys: Sequence[str]) -> str | None:
    """The first of the keys whose value is several: a square's `size` is none of an image, nor `distortion: none`."""
    return next((key for key in keys if isinstance(fields.get(key), list | dict)), None)


def _flat(value: Any, where: str) -> list[float]:
    if isinstance(value, dict):
        data = value.get("data")
        if not isinstance(data, list):
            raise InputError(where, "data missing", "expected rows, cols and data: [...]")
        shape = [str(value[k]) for k in ("rows", "cols") if k in value]
        if len(shape) == 2 and np.prod(to_numbers(shape, where, "rows and cols")) != len(data):
            raise InputError(
                where, f"{len(data)} numbers for {shape[0]} rows of {shape[1]}", "expected a number for each place"
            )
        value = data
    if not isinstance(value, list):
        raise InputError(where, f"found {str(value)[:40]!r}", "expected a matrix")
    flat = [v for row in value for v in (row if isinstance(row, list) else [row])]
    return to_numbers([str(v) for v in flat], where, "numbers")


def _matrix(fields: Fields, path: Path) -> list[float]:
    """K row by row: a matrix, fx fy cx cy in a list, or one key each."""
    if all(fields.get(key) is not None for key in ("fx", "fy", "cx", "cy")):
        fx, fy, cx, cy = to_numbers([str(fields[key]) for key in ("fx", "fy", "cx", "cy")], str(path), "fx fy cx cy")
        return [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    key = _first(fields, _MATRICES)
    if key is None:
        raise _missing("camera_matrix", path)
    if isinstance(fields[key], dict) and {"fx", "fy", "cx", "cy"} <= {str(k).lower() for k in fields[key]}:
        return _matrix({str(k).lower(): v for k, v in fields[key].items()}, path)
    matrix = _flat(fields[key], f"{path}: camera_matrix")
    if len(matrix) == 4:
        fx, fy, cx, cy = matrix
        matrix = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    if len(matrix) != 9 or matrix[3] or matrix[6:] != [0, 0, 1] or abs(matrix[1]) > 1e-9:
        raise InputError(
            path, f"camera_matrix: found {' '.join(f'{v:g}' for v in matrix)}", "expected fx 0 cx / 0 fy cy / 0 0 1"
        )
    return matrix


def _in_pixels(matrix: list[float], width: int, height: int, path: Path) -> list[float]:
    """K in pixels; said where it was in parts of width and height, as all of its two upper rows below 2 tell."""
    fx, _, cx, _, fy, cy, *_ = matrix
    if max(abs(v) for v in (fx, fy, cx, cy)) >= 2 or min(width, height) < 16:
        return matrix
    scaled = [fx * width, 0, cx * width, 0, fy * height, cy * height, 0, 0, 1]
    warnings.warn(
        f"{path}: camera_matrix is in fractions of the image's sides: scaled by {width} and {height} to "
        f"fx {scaled[0]:g}, fy {scaled[4]:g}, cx {scaled[2]:g}, cy {scaled[5]:g} pixels",
        stacklevel=5,
    )
    return scaled


def _size_of(fields: Fields, path: Path, size: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height: one key each, both in one, or those of the images."""
    wide, high = _first(fields, _WIDTHS), _first(fields, _HEIGHTS)
    if wide is not None and high is not None:
        found = [fields[wide], fields[high]]
    elif (key := _first_of_many(fields, _SIZES)) is not None:
        found = _pair(fields[key], f"{path}: {key}")
    elif (key := _first_of_many(fields, _SHAPES)) is not None:
        found = _pair(fields[key], f"{path}: {key}")[::-1]
    else:
        missing = "image_width" if wide is None else "image_height"
        if wide is not None or high is not None:
            raise _missing(missing, path)
        return needed_size(size, str(path), "image_width and image_height")
    width, height = (
        _whole(value, f"{path}: {name}") for value, name in zip(found, ("image_width", "image_height"), strict=True)
    )
    return width, height


def _pair(value: Any, where: str) -> list[Any]:
    if isinstance(value, dict):
        keys = {str(k).lower(): v for k, v in value.items()}
        value = keys.get("data") or [keys.get("width"), keys.get("height")]
    if not isinstance(value, list) or len(value) < 2:
        raise InputError(where, f"found {str(value)[:40]!r}", "expected two numbers of pixels")
    return value[:2]


def _whole(value: Any, where: str) -> int:
    (number,) = to_numbers([str(value)], where, "a number of pixels")
    if number != int(number):
        raise InputError(where, f"{number:g}", "expected whole pixels")
    return int(number)


def _is_fisheye(fields: Fields, path: Path) -> bool:
    """Whether any key for the lens names the fisheye. One for distortion has to name a lens that is known."""
    named = {key: letters(fields[key]) for key in _MODELS if isinstance(fields.get(key), str)}
    if fields.get("fisheye") is True or fields.get("isfisheye") is True:
        return True
    if any(word in FISHEYE_WORDS or "fisheye" in word for word in named.values()):
        return True
    told = named.get("distortionmodel", "")
    other = [key for key, word in named.items() if word in _OTHER_LENSES]
    if told not in _BROWN or other:
        key = "distortionmodel" if told not in _BROWN else other[0]
        raise InputError(
            path,
            f"{'distortion_model' if key == 'distortionmodel' else key} {fields[key]!r} is not known",
            "expected plumb_bob (k1 k2 p1 p2), or fisheye or equidistant (k1 k2 k3 k4)",
        )
    return False


def _coefficients(fields: Fields, path: Path) -> list[float]:
    """D as a matrix, or in one key each."""
    key = _first_of_many(fields, _COEFFICIENTS)
    if key is not None:
        value = fields[key]
        if isinstance(value, dict) and "data" not in value and any(str(k).lower() == "k1" for k in value):
            return _coefficients({str(k).lower(): v for k, v in value.items()}, path)
        return _flat(value, f"{path}: distortion_coefficients")
    if fields.get("k1") is None:
        raise _missing("distortion_coefficients", path)
    brown = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    order = ("k1", "k2", "k3", "k4") if _is_fisheye(fields, path) else brown
    return to_numbers([str(fields.get(k, 0.0)) for k in order], f"{path}: k1", "numbers")


def _opencv_terms(terms: list[float], where: str) -> list[float]:
    """4 to 12 coefficients; the tilted sensor's two have to be 0."""
    if len(terms) == 0:
        return [0.0] * 4
    if len(terms) not in (4, 5, 8, 12, 14):
        raise InputError(
            where, f"{len(terms)} numbers", "expected OpenCV's 4, 5, 8, 12 or 14: k1 k2 p1 p2 [k3 [k4 k5 k6]]"
        )
    if any(terms[12:]):
        raise InputError(
            where,
            f"a tilted sensor ({terms[12]:g}, {terms[13]:g})",
            "expected 0: calibrate without cv2.CALIB_TILTED_MODEL",
        )
    return terms[:12]
