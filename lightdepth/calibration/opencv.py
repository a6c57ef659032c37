"""OpenCV's FileStorage YAML, and ROS's camera_info YAML, which has the same keys.

`image_width`, `image_height`, `camera_matrix`, `distortion_coefficients` and, where there is one, `distortion_model`.
With the model `fisheye` or `equidistant` the 4 coefficients are cv2.fisheye's k1..k4; else they are k1 k2 p1 p2 and
perhaps k3, which must be 0. The first pixel's centre is at (0, 0). Read with a safe YAML loader: nothing is executed.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lightdepth.calibration.plain_text import cannot_hold
from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole, camera_from_params
from lightdepth.errors import InputError
from lightdepth.files.text import read_text, to_numbers
from lightdepth.files.writing import write_whole

_FISHEYE = ("fisheye", "equidistant")
_BROWN = ("plumb_bob", "radtan", "opencv", "brown", "")


class _Loader(yaml.SafeLoader):
    """A safe loader that takes OpenCV's matrices for the mappings they are."""


def _mapping(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):  # the second is OpenCV 5's for a vector
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _mapping)


def read_opencv(path: Path) -> CameraModel:
    """The camera of an OpenCV YAML. Keys in any case; what is not about the camera is passed over."""
    fields = _fields(path)
    width, height = (_size(fields, key, path) for key in ("image_width", "image_height"))
    matrix = _numbers(fields, "camera_matrix", path)
    if len(matrix) != 9 or matrix[3] or matrix[6:] != [0, 0, 1] or abs(matrix[1]) > 1e-9:
        raise InputError(
            path, f"camera_matrix: found {' '.join(f'{v:g}' for v in matrix)}", "expected fx 0 cx / 0 fy cy / 0 0 1"
        )
    coefficients = _numbers(fields, "distortion_coefficients", path)
    model = str(fields.get("distortion_model") or "").lower()
    kind, coefficients = _distortion(model, coefficients, path)
    params = [matrix[0], matrix[4], matrix[2], matrix[5], *coefficients]
    return camera_from_params(kind, width, height, params, str(path)).with_pixel_center(0.0)


def read_matrices(path: Path, names: tuple[str, ...]) -> dict[str, list[float]]:
    """The numbers of named matrices in an OpenCV YAML, row by row: a stereo calibration's M1, D1, T."""
    fields = _fields(path)
    missing = [name for name in names if fields.get(name.lower()) is None]
    if missing:
        raise InputError(path, f"{', '.join(missing)} missing", f"expected the matrices {', '.join(names)}")
    return {name: _numbers(fields, name.lower(), path) for name in names}


def _fields(path: Path) -> dict[str, Any]:
    """Everything in the file, by its key in small letters."""
    text = read_text(path, "expected an OpenCV YAML").lstrip("\ufeff")
    # OpenCV's first line, `%YAML:1.0`, is no YAML.
    text = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
    try:
        data = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(path, f"not valid YAML ({' '.join(str(error).split())[:200]})", "correct it there") from error
    if not isinstance(data, dict):
        raise InputError(path, "no keys in it", "expected camera_matrix, distortion_coefficients and the image size")
    return {str(key).lower(): value for key, value in data.items()}


def _distortion(model: str, found: list[float], path: Path) -> tuple[str, list[float]]:
    """Our model's name, and its coefficients."""
    where = f"{path}: distortion_coefficients"
    if model in _FISHEYE:
        if len(found) != 4:
            raise InputError(where, f"{len(found)} numbers", f"the model {model} has 4: k1 k2 k3 k4")
        return KannalaBrandt.name, found
    if model not in _BROWN:
        raise InputError(
            path,
            f"distortion_model {model!r} is not known",
            "expected plumb_bob (k1 k2 p1 p2), or fisheye or equidistant (k1 k2 k3 k4)",
        )
    if len(found) not in (4, 5):
        raise InputError(
            where,
            f"{len(found)} numbers",
            "expected k1 k2 p1 p2, or with k3 = 0 after them. Calibrate without the rational, thin-prism and tilted "
            "terms",
        )
    if len(found) == 5 and found[4]:
        raise InputError(where, f"k3 = {found[4]:g}", "expected 0: calibrate with cv2.CALIB_FIX_K3")
    if not any(found):
        return Pinhole.name, []
    if len(found) == 4 and not model:
        warnings.warn(
            f"{where}: 4 numbers and no distortion_model: read as k1 k2 p1 p2. If cv2.fisheye made them, add the line "
            "`distortion_model: fisheye`",
            stacklevel=4,
        )
    return Brown.name, found[:4]


def _field(fields: dict[str, Any], key: str, path: Path) -> Any:
    if fields.get(key) is None:
        raise InputError(
            path,
            f"{key} missing",
            "expected image_width, image_height, camera_matrix, distortion_coefficients (zeros for none)",
        )
    return fields[key]


def _size(fields: dict[str, Any], key: str, path: Path) -> int:
    (value,) = to_numbers([str(_field(fields, key, path))], f"{path}: {key}", "a number of pixels")
    if value != int(value):
        raise InputError(path, f"{key} {value:g}", "expected whole pixels")
    return int(value)


def _numbers(fields: dict[str, Any], key: str, path: Path) -> list[float]:
    """The numbers of a matrix, row by row, written with rows, cols and data or as nested lists."""
    value = _field(fields, key, path)
    if isinstance(value, dict):
        data = value.get("data")
        if not isinstance(data, list):
            raise InputError(f"{path}: {key}", "data missing", "expected rows, cols and data: [...]")
        shape = [str(value[k]) for k in ("rows", "cols") if k in value]
        if len(shape) == 2 and np.prod(to_numbers(shape, f"{path}: {key}", "rows and cols")) != len(data):
            raise InputError(
                f"{path}: {key}",
                f"{len(data)} numbers for {shape[0]} rows of {shape[1]}",
                "expected a number for each place",
            )
        value = data
    if not isinstance(value, list):
        raise InputError(f"{path}: {key}", f"found {str(value)[:40]!r}", "expected a matrix")
    flat = [v for row in value for v in (row if isinstance(row, list) else [row])]
    return to_numbers([str(v) for v in flat], f"{path}: {key}", "numbers")


def write_opencv(camera: CameraModel, path: Path) -> None:
    """An OpenCV YAML, which cv2.FileStorage reads too."""
    if isinstance(camera, Pinhole):
        model, coefficients = "plumb_bob", [0.0] * 5
    elif isinstance(camera, Brown):
        model, coefficients = "plumb_bob", [*camera.params[4:], 0.0]
    elif isinstance(camera, KannalaBrandt):
        model, coefficients = "fisheye", list(camera.params[4:])
    else:
        raise cannot_hold(path, "OpenCV", f"{camera.name} camera", "OPENCV_FISHEYE", "OPENCV", "PINHOLE")
    fx, fy, cx, cy = camera.with_pixel_center(1.0).params[:4]  # half a pixel back, to OpenCV's

    def matrix(name: str, height: int, numbers: list[float]) -> str:
        data = ", ".join(repr(float(v)) for v in numbers)
        shape = f"   rows: {height}\n   cols: {len(numbers) // height}\n   dt: d\n"
        return f"{name}: !!opencv-matrix\n{shape}   data: [ {data} ]\n"

    write_whole(
        path,
        f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        + matrix("camera_matrix", 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1])
        + f"distortion_model: {model}\n"
        + matrix("distortion_coefficients", 1, coefficients),
    )
