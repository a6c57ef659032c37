"""MATLAB's .mat files: Bouguet's Calib_Results.mat, and cameraParameters or fisheyeParameters as structures.

An object of a class is kept in a form that only MATLAB reads: `toStruct` makes a structure of it. MATLAB counts pixels
from 1, Bouguet's toolbox from 0. MATLAB's fisheye (Scaramuzza's) is ours: (u, v) = stretch (x, y) + centre, and the ray
is (x, y, a0 + a2 rho² + a3 rho³ + a4 rho⁴), z into the scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.calibration.mat_file import OBJECT, mat_variables
from lightdepth.camera import CameraModel, camera_from_params, camera_of, opencv_camera
from lightdepth.errors import InputError
from lightdepth.files.reading import MOST_TEXT, check_bytes, reading

_AS_STRUCTURE = "in MATLAB: s = toStruct(params); save('camera.mat', '-struct', 's', '-v7')"
_EXPECTED = (
    "Bouguet's fc, cc, kc, nx, ny; or K, RadialDistortion, TangentialDistortion, ImageSize; or a fisheye's "
    f"MappingCoefficients, StretchMatrix, DistortionCenter, ImageSize ({_AS_STRUCTURE})"
)
Variables = Mapping[str, Any]


def read_matlab(path: Path) -> CameraModel:
    """The camera of a .mat file. Raises InputError, saying what to save, where it holds objects or anything else."""
    variables = _variables(path)
    for found in _structures(variables):
        if "MappingCoefficients" in found:
            return _fisheye(found, path)
        if "ImageSize" in found and ("IntrinsicMatrix" in found or "K" in found):
            return _parameters(found, path)
        if {"fc", "cc", "kc", "nx", "ny"} <= set(found):
            return _bouguet(found, path)
    names = ", ".join(sorted(name for name in variables if not name.startswith("__"))) or "nothing"
    raise InputError(path, f"a MATLAB file with {names}", f"expected {_EXPECTED}")


def _variables(path: Path) -> Variables:
    with reading(path, "a MATLAB file that can be read", "save it again"):
        check_bytes(path.stat().st_size, MOST_TEXT, path, "calibration")
        try:
            variables = mat_variables(path)
        except NotImplementedError as error:
            raise InputError(
                path, "a MATLAB file of version 7.3 (HDF5)", f"save it as version 7: {_AS_STRUCTURE}"
            ) from error
    if any(value is OBJECT for value in variables.values()):
        raise InputError(path, "a MATLAB object, which only MATLAB can read", f"save a structure: {_AS_STRUCTURE}")
    return variables


def _structures(variables: Variables) -> list[Variables]:
    """The variables themselves, and the fields of each structure among them, two deep."""
    found, level = [variables], list(variables.values())
    for _ in range(2):
        below = [v for v in level if isinstance(v, dict)]
        found += below
        level = [v for fields in below for v in fields.values()]
    return found


def _numbers(fields: Variables, name: str, counts: tuple[int, ...], path: Path) -> list[float]:
    try:
        found: list[float] = np.asarray(fields.get(name, []), float).ravel().tolist()
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {name}", "not numbers", f"expected {_EXPECTED}") from error
    if len(found) not in counts or not np.isfinite(found).all():
        raise InputError(
            f"{path}: {name}", f"{len(found)} numbers", f"expected {' or '.join(map(str, counts))} finite ones"
        )
    return found


def _size(fields: Variables, path: Path) -> tuple[int, int]:
    height, width = _numbers(fields, "ImageSize", (2,), path)
    return int(width), int(height)


def _fisheye(fields: Variables, path: Path) -> CameraModel:
    a0, *rest = _numbers(fields, "MappingCoefficients", (4,), path)
    c, d, e, one = _numbers(fields, "StretchMatrix", (4,), path)
    if abs(one - 1) > 1e-9:
        raise InputError(f"{path}: StretchMatrix", f"its last number is {one:g}", "expected [c d; e 1]")
    centre = _numbers(fields, "DistortionCenter", (2,), path)
    params = [*centre, a0, 0.0, *rest, c, d, e]
    return camera_from_params("SCARAMUZZA", *_size(fields, path), params, str(path)).with_pixel_center(1.0)


def _parameters(fields: Variables, path: Path) -> CameraModel:
    matrix = np.array(_numbers(fields, "K" if "K" in fields else "IntrinsicMatrix", (9,), path)).reshape(3, 3)
    if abs(matrix[2, :2]).max() > 0:
        matrix = matrix.T  # IntrinsicMatrix, for points as rows
    radial = _numbers(fields, "RadialDistortion", (2, 3), path)
    tangential = _numbers(fields, "TangentialDistortion", (2,), path)
    return _camera(matrix, [*radial[:2], *tangential, *radial[2:]], _size(fields, path), path).with_pixel_center(1.0)


def _bouguet(fields: Variables, path: Path) -> CameraModel:
    (fx, fy), (cx, cy) = _numbers(fields, "fc", (2,), path), _numbers(fields, "cc", (2,), path)
    skew = _numbers(fields, "alpha_c", (0, 1), path) or [0.0]
    (width,), (height,) = _numbers(fields, "nx", (1,), path), _numbers(fields, "ny", (1,), path)
    matrix = np.array([[fx, skew[0] * fx, cx], [0, fy, cy], [0, 0, 1.0]])
    terms = _numbers(fields, "kc", (4, 5), path)
    return _camera(matrix, terms, (int(width), int(height)), path).with_pixel_center(0.0)


def _camera(matrix: np.ndarray, terms: list[float], size: tuple[int, int], path: Path) -> CameraModel:
    (fx, skew, cx), (_, fy, cy), _ = matrix.tolist()
    if abs(skew) > 1e-9:
        raise InputError(path, f"skew {skew:g}", "expected 0: calibrate without skew (EstimateSkew false)")
    return camera_of(lambda: opencv_camera(*size, [fx, fy, cx, cy, *terms]), str(path))
