"""YAML, and OpenCV's FileStorage in YAML or XML: read safely (nothing is executed), and OpenCV's YAML written.

What the keys mean is told by `matrix` (a camera matrix and OpenCV's coefficients) and `other_programs`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from lightdepth import plain_yaml
from lightdepth.calibration.matrix import matrix_and_distortion, matrix_numbers
from lightdepth.calibration.other_programs import other_program
from lightdepth.calibration.plain_text import cannot_hold
from lightdepth.calibration.xml_text import opencv_fields
from lightdepth.camera import Brown, CameraModel, FullBrown, KannalaBrandt, Pinhole
from lightdepth.errors import InputError
from lightdepth.files.reading import reading
from lightdepth.files.text import read_text
from lightdepth.files.writing import write_whole


class _Loader(plain_yaml.Loader):
    """A safe loader that takes OpenCV's matrices for the mappings they are."""


def _mapping(loader: plain_yaml.Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):  # the second is OpenCV 5's for a vector
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _mapping)


def read_opencv(path: Path, size: tuple[int, int] | None = None) -> CameraModel:
    """The camera of a YAML, or of OpenCV's XML. Keys in any case; what is not about the camera is passed over. `size`
    (width, height) is that of the images, for files that hold none."""
    with reading(path, "a calibration in YAML or XML"):
        return camera_of_keys(_fields(path), path, size)


def camera_of_keys(fields: dict[str, Any], path: Path, size: tuple[int, int] | None = None) -> CameraModel:
    """The camera of a file's content, by its keys in small letters, of OpenCV's or another program's making."""
    other = other_program(fields, str(path), size)
    return matrix_and_distortion(fields, path, size) if other is None else other


def read_matrices(path: Path, names: tuple[str, ...]) -> dict[str, list[float]]:
    """The numbers of named matrices in an OpenCV YAML, row by row: a stereo calibration's M1, D1, T."""
    with reading(path, "a calibration in YAML or XML"):
        return _matrices(path, names)


def _matrices(path: Path, names: tuple[str, ...]) -> dict[str, list[float]]:
    fields = _fields(path)
    missing = [name for name in names if fields.get(name.lower()) is None]
    if missing:
        raise InputError(path, f"{', '.join(missing)} missing", f"expected the matrices {', '.join(names)}")
    return {name: matrix_numbers(fields, name.lower(), path) for name in names}


def _fields(path: Path) -> dict[str, Any]:
    """Everything in the file, by its key in small letters."""
    text = read_text(path, "expected an OpenCV YAML").lstrip("\ufeff")
    if text.lstrip().startswith("<"):
        stored = opencv_fields(path)
        if stored is None:
            raise InputError(path, "XML of another program's", "expected OpenCV's, an <opencv_storage>")
        return stored
    # OpenCV's first line, `%YAML:1.0`, is no YAML.
    text = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
    try:
        data = plain_yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise InputError(path, f"not valid YAML ({' '.join(str(error).split())[:200]})", "correct it there") from error
    if not isinstance(data, dict):
        raise InputError(path, "no keys in it", "expected camera_matrix, distortion_coefficients and the image size")
    return {str(key).lower(): value for key, value in data.items()}


def write_opencv(camera: CameraModel, path: Path) -> None:
    """An OpenCV YAML, which cv2.FileStorage reads too."""
    if isinstance(camera, Pinhole):
        model, coefficients = "plumb_bob", [0.0] * 5
    elif isinstance(camera, FullBrown):
        model, coefficients = "rational_polynomial", list(camera.params[4:])
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
