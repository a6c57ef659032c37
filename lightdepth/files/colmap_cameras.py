"""COLMAP's cameras files, text and binary, and the bytes of its binary files."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.camera import CameraModel, camera_from_params
from lightdepth.errors import InputError
from lightdepth.files.reading import reading
from lightdepth.files.text import numbered_lines, parse_integer, parse_numbers

_BINARY_MODELS = {  # model number in cameras.bin -> name, number of parameters
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}


def read_cameras_text(path: Path) -> dict[int, CameraModel]:
    """Cameras by id, in the file's own pixel convention."""
    with reading(path, "COLMAP's cameras"):
        return _cameras_text(path)


def _cameras_text(path: Path) -> dict[int, CameraModel]:
    expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
    cameras = {}
    for number, line in numbered_lines(path):
        where, tokens = f"{path}, line {number}", line.split()
        if len(tokens) < 5:
            raise InputError(where, f"found {line.strip()[:60]!r}", f"expected {expected}")
        camera_id, width, height = (parse_integer(tokens[k], where, expected) for k in (0, 2, 3))
        params = parse_numbers(tokens[4:], where, expected).tolist()
        cameras[camera_id] = camera_from_params(tokens[1], width, height, params, where)
    if not cameras:
        raise InputError(path, "no camera in it", f"expected a line {expected}")
    return cameras


class BinaryFile:
    """A file's bytes, taken in order; little-endian."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        with reading(path, "a COLMAP binary file"):
            self.data = path.read_bytes()

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        return struct.unpack("<" + layout, self._next(size))

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        return np.frombuffer(self._next(dtype.itemsize * count), dtype)

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self._short()
        name = self._next(end + 1 - self.at)[:-1]
        try:
            return name.decode()
        except UnicodeDecodeError as error:
            raise InputError(
                self.path, f"an image name is not text at byte {self.at}", "is it a COLMAP binary file?"
            ) from error

    def end(self) -> None:
        if self.at != len(self.data):
            raise InputError(
                self.path, f"{len(self.data) - self.at} bytes too many", "is it a COLMAP binary file of this kind?"
            )

    def _next(self, size: int) -> bytes:
        if self.at + size > len(self.data):
            raise self._short()
        self.at += size
        return self.data[self.at - size : self.at]

    def _short(self) -> InputError:
        return InputError(
            self.path, f"ends too early, at byte {len(self.data)}", "copied incompletely, or not COLMAP's?"
        )


def read_cameras_binary(path: Path) -> dict[int, CameraModel]:
    """Cameras by id, in the file's own pixel convention."""
    with reading(path, "COLMAP's cameras"):
        return _cameras_binary(path)


def _cameras_binary(path: Path) -> dict[int, CameraModel]:
    data, cameras = BinaryFile(path), {}
    for _ in range(data.take("Q")[0]):
        camera_id, model, width, height = data.take("IiQQ")
        if model not in _BINARY_MODELS:
            known = ", ".join(name for name, _ in _BINARY_MODELS.values())
            raise InputError(path, f"camera {camera_id} has the unknown model number {model}", f"known are {known}")
        name, count = _BINARY_MODELS[model]
        cameras[camera_id] = camera_from_params(name, width, height, list(data.take(f"{count}d")), str(path))
    data.end()
    return cameras
