"""Text files, read and written whole; and cameras in plain text: COLMAP's cameras.txt, and intrinsics.txt with a bare
camera matrix.

COLMAP's first pixel has its centre at (0.5, 0.5), as ours. intrinsics.txt (Hamlyn, EndoSLAM and others) comes out of
OpenCV's calibration: there it is at (0, 0).
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from lightdepth.camera import CameraModel, Pinhole, Scaramuzza, camera_from_params
from lightdepth.errors import InputError
from lightdepth.files.colmap_cameras import read_cameras_text
from lightdepth.files.text import read_text, rows, to_numbers
from lightdepth.files.writing import write_whole


def cannot_hold(path: Path, program: str, what: str, *models: str) -> InputError:
    """The error for a camera that a format has no place for, with the models that it has."""
    return InputError(
        path,
        f"{program} has no {what}",
        f"it can be converted to {' or '.join(models)}: lightdepth convert-camera FILE -o OUT --model {models[0]}",
    )


def read_colmap_camera(path: Path) -> CameraModel:
    """The camera of a cameras.txt that holds exactly one."""
    return only_camera(read_cameras_text(path), path)


def only_camera(cameras: dict[int, CameraModel], path: Path) -> CameraModel:
    """The camera of a file that has to hold exactly one."""
    if len(cameras) > 1:
        raise InputError(
            path,
            f"{len(cameras)} cameras, with ids {', '.join(map(str, cameras))}",
            "expected exactly one: keep the line of the camera that took these images",
        )
    return next(iter(cameras.values()))


def write_colmap_camera(camera: CameraModel, path: Path) -> None:
    """cameras.txt with the camera as id 1."""
    if isinstance(camera, Scaramuzza):
        raise cannot_hold(path, "COLMAP", "SCARAMUZZA camera", "OPENCV_FISHEYE", "OPENCV", "PINHOLE")
    numbers = " ".join(repr(float(p)) for p in camera.params)
    write_whole(
        path, f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 {camera.name} {camera.width} {camera.height} {numbers}\n"
    )


def read_intrinsics(path: Path, size: tuple[int, int] | None) -> Pinhole:
    """A pinhole camera from its matrix, 3x3 or 4x4, row by row; `size` (width, height) is not in the file."""
    expected = "a camera matrix fx 0 cx / 0 fy cy / 0 0 1, as 9 numbers, or 16 with a fourth row and column 0 0 0 1"
    words = read_text(path, f"expected {expected}").translate(str.maketrans(",;[]", "    "))
    lines = rows(words)
    numbers = to_numbers([w for line in lines for w in line], str(path), expected)
    if (widths := {len(line) for line in lines}) in ({8}, {12}):
        what = "a TUM trajectory" if widths == {8} else "poses as KITTI has them"
        raise InputError(
            path, f"{what} ({len(lines)} lines of {widths.pop()} numbers), which hold no camera", f"expected {expected}"
        )
    if len(numbers) not in (9, 16):
        raise InputError(path, f"{len(numbers)} numbers", f"expected {expected}")
    side = 3 if len(numbers) == 9 else 4
    matrix = np.array(numbers).reshape(side, side)
    if size is not None and abs(matrix[:2, :3]).max() < 2 and min(size) >= 16:
        matrix[:2] *= np.array(size, float)[:, None]
        warnings.warn(
            f"{path}: the matrix is in fractions of the image's sides: scaled by {size[0]} and {size[1]} to fx "
            f"{matrix[0, 0]:g}, fy {matrix[1, 1]:g}, cx {matrix[0, 2]:g}, cy {matrix[1, 2]:g} pixels",
            stacklevel=4,
        )
    (fx, skew, cx), (zero, fy, cy) = matrix[:2, :3]
    if not np.array_equal(matrix, _intrinsics(fx, fy, cx, cy, skew, side)) or zero:
        hint = "; it looks transposed" if not matrix[0, 2] and matrix[2, 0] else ""
        raise InputError(path, f"not a camera matrix{hint}", f"expected {expected}")
    if abs(skew) > 1e-9:
        raise InputError(path, f"skew {skew:g} in the first row", "expected 0, no camera model here has one")
    if size is None:
        raise InputError(
            path,
            "holds no image size",
            'give it (`lightdepth convert-camera FILE --size`), or write a camera.json: {"model": "PINHOLE", '
            f'"width": W, "height": H, "params": [{fx:g}, {fy:g}, {cx:g}, {cy:g}], "pixel_center": 0.0}}',
        )
    camera = camera_from_params("PINHOLE", *size, [fx, fy, cx, cy], str(path)).with_pixel_center(0.0)
    assert isinstance(camera, Pinhole)
    return camera


def write_intrinsics(camera: CameraModel, path: Path, side: int = 3) -> None:
    """The camera matrix, side x side (3 or 4). The image size is lost."""
    if not isinstance(camera, Pinhole):
        raise cannot_hold(path, "intrinsics.txt", f"{camera.name} camera", "PINHOLE")
    fx, fy, cx, cy = camera.with_pixel_center(1.0).params  # half a pixel back, to OpenCV's
    matrix = _intrinsics(fx, fy, cx, cy, 0.0, side)
    write_whole(path, "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in matrix))


def _intrinsics(fx: float, fy: float, cx: float, cy: float, skew: float, side: int) -> np.ndarray:
    matrix = np.eye(side)
    matrix[:2, :3] = [[fx, skew, cx], [0, fy, cy]]
    return matrix
