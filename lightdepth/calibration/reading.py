"""read_camera and read_light: the format is told by looking at the file; the writers go by its suffix."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from lightdepth.calibration.json_files import (
    camera_from_fields,
    light_from_text,
    read_light_json,
    write_camera_json,
    write_light_json,
)
from lightdepth.calibration.matlab import read_matlab
from lightdepth.calibration.ocamcalib import is_ocamcalib, read_ocamcalib, write_ocamcalib
from lightdepth.calibration.opencv import camera_of_keys, read_opencv, write_opencv
from lightdepth.calibration.plain_text import (
    only_camera,
    read_colmap_camera,
    read_intrinsics,
    write_colmap_camera,
    write_intrinsics,
)
from lightdepth.calibration.vicalib import read_photometric, read_vicalib, write_photometric, write_vicalib
from lightdepth.camera import CameraModel, Scaramuzza
from lightdepth.errors import InputError
from lightdepth.files.colmap_cameras import read_cameras_binary
from lightdepth.files.reading import MOST_TEXT, check_bytes, reading
from lightdepth.files.schema import read_json
from lightdepth.files.text import read_text, rows
from lightdepth.photometry import PhotometricCalibration

CAMERA_FORMATS = (
    "camera.json, vicalib XML (EndoMapper), OpenCV's YAML or XML, ROS, Kalibr, ORB-SLAM or stella_vslam YAML, COLMAP "
    "cameras.txt or cameras.bin, nerfstudio's transforms.json, ocamcalib calib_results.txt, MATLAB .mat, or "
    "intrinsics.txt (3x3 or 4x4 numbers)"
)


_WRITERS: dict[str, Callable[[CameraModel, Path], None]] = {
    "json": write_camera_json,
    "vicalib": write_vicalib,
    "opencv": write_opencv,
    "colmap": write_colmap_camera,
    "ocamcalib": write_ocamcalib,
    "intrinsics": write_intrinsics,
    "intrinsics4x4": partial(write_intrinsics, side=4),
}
_SUFFIXES = {".json": "json", ".xml": "vicalib", ".yaml": "opencv", ".yml": "opencv", ".txt": "colmap"}


def read_camera(path: Path, size: tuple[int, int] | None = None) -> CameraModel:
    """The one camera of a calibration file, in our pixel convention.

    `size` (width, height) of the images is for files that do not hold it, as intrinsics.txt. A lens that none of ours
    is exactly becomes the nearest, which a warning says in pixels. Raises InputError, naming file and field, for what
    cannot be read.
    """
    with reading(path, "a camera calibration"):
        check_bytes(Path(path).stat().st_size if Path(path).is_file() else 0, MOST_TEXT, path, "calibration")
        return _in_pixels(_read(Path(path), size), path)


def _read(path: Path, size: tuple[int, int] | None) -> CameraModel:
    suffix = path.suffix.lower()
    if suffix == ".mat":
        return _plausible(read_matlab(path), path)
    if suffix == ".bin":
        return _plausible(only_camera(read_cameras_binary(path), path), path)
    if suffix == ".json":
        return _read_json(path, size)
    text = read_text(path, f"expected {CAMERA_FORMATS}")
    start = text.lstrip("\ufeff \t\r\n")
    if start.startswith("{") and suffix not in (".yaml", ".yml"):  # flow style is YAML, too
        return _read_json(path, size)
    stored = re.search(r"<opencv_storage\b", start[:2000]) is not None
    if start.startswith("<") and not stored:
        return _plausible(read_vicalib(path), path)
    if stored or start.startswith("%YAML") or suffix in (".yaml", ".yml"):
        return _plausible(read_opencv(path, size), path)
    lines = rows(text)
    if lines and len(lines[0]) > 2 and re.fullmatch(r"[A-Z][A-Z0-9_]+", lines[0][1]):
        return _plausible(read_colmap_camera(path), path)
    if is_ocamcalib(lines):
        return _plausible(read_ocamcalib(path), path)
    if lines and re.match(r"[-+\d.\[]", lines[0][0]):
        return _plausible(read_intrinsics(path, size), path)
    if lines and len(lines[0]) == 13 and re.fullmatch(r"[A-Za-z]\w*:", lines[0][0]):
        raise _kitti_cameras(path, lines)
    if re.search(r"^\s*(fc|KK|kc)\s*=\s*\[", text, re.MULTILINE):
        raise InputError(
            path, "a script of MATLAB's calibration toolbox", "give Calib_Results.mat, which lies beside it"
        )
    raise InputError(path, "not a camera calibration that is known", f"expected {CAMERA_FORMATS}")


def _read_json(path: Path, size: tuple[int, int] | None) -> CameraModel:
    """camera.json, or another program's: ours has `params`."""
    data = read_json(path)
    keys = {str(key).lower() for key in data} if isinstance(data, dict) else set()
    if keys & _OTHER_JSON and "params" not in keys:
        return camera_of_keys({str(key).lower(): value for key, value in data.items()}, path, size)
    return camera_from_fields(data, str(path))


_OTHER_JSON = {"fl_x", "camera_angle_x", "frames", "camera_matrix", "cameramatrix", "k", "mtx", "intrinsic_matrix"}
_OTHER_JSON |= {"intrinsics", "camera", "cam0"}


def _kitti_cameras(path: Path, lines: list[list[str]]) -> InputError:
    """What to do with KITTI's calib.txt, which has a projection for each of its cameras, and no image size."""
    fx, _, cx, _, _, fy, cy = lines[0][1:8]
    return InputError(
        path,
        f"KITTI's calib.txt, projections of the cameras {', '.join(words[0].rstrip(':') for words in lines[:4])}",
        f"write the one that took these images to intrinsics.txt: the first would be {fx} 0 {cx} / 0 {fy} {cy} / 0 0 1",
    )


def _in_pixels(camera: CameraModel, path: Path) -> CameraModel:
    """The camera, or InputError where its numbers are parts of the image's sides."""
    sides = camera.params[:4]
    if isinstance(camera, Scaramuzza) or max(abs(v) for v in sides) >= 3 or min(camera.width, camera.height) < 16:
        return camera
    fx, fy, cx, cy = (v * s for v, s in zip(sides, (camera.width, camera.height) * 2, strict=True))
    raise InputError(
        path,
        f"a focal length of {camera.focal_length:.3g} pixels in an image {camera.width} wide",
        f"were its numbers divided by width and height? In pixels they are fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}",
    )


def write_camera(camera: CameraModel, path: Path, format: str | None = None) -> None:
    """To a format: json, vicalib, opencv, colmap, ocamcalib, intrinsics or intrinsics4x4. The file appears whole.

    Left out, it follows the name: .json ours, .xml vicalib, .yaml OpenCV; calib_results*.txt ocamcalib, intrinsics*.txt
    the 3x3 matrix, any other .txt COLMAP's cameras.txt. Raises InputError where the format cannot hold the camera.
    """
    name = Path(path).name.lower()
    suffix = Path(path).suffix.lower()
    if format is None and suffix == ".txt" and name.startswith(("calib_results", "intrinsics")):
        format = "ocamcalib" if name.startswith("c") else "intrinsics"
    format = format or _SUFFIXES.get(suffix)
    if format not in _WRITERS:
        found = f"format {format!r} is not known" if format else f"no camera format ends in {suffix!r}"
        known = ", ".join(_WRITERS if format else _SUFFIXES)
        raise InputError(path, found, f"expected one of {known}")
    _WRITERS[format](camera, Path(path))


def read_light(source: str | Path) -> PhotometricCalibration:
    """A light.json file, an EndoMapper photometric XML, or values written out as `gamma=2.2,mu=0`."""
    with reading(source, "a calibration of the light"):
        return _light_at(source)


def _light_at(source: str | Path) -> PhotometricCalibration:
    text, path = str(source), Path(source)
    if "=" in text and not path.exists():
        return light_from_text(text)
    if path.suffix.lower() != ".json" and path.is_file():
        start = read_text(path, "expected light.json or an EndoMapper photometric XML")
        if start.lstrip("\ufeff \t\r\n").startswith("<"):
            return read_photometric(path)
    return read_light_json(path)


def write_light(light: PhotometricCalibration, path: Path) -> None:
    """To light.json, or where the name ends in .xml to EndoMapper's photometric XML."""
    write = write_photometric if Path(path).suffix.lower() == ".xml" else write_light_json
    write(light, Path(path))


def _plausible(camera: CameraModel, path: Path) -> CameraModel:
    """The camera, or InputError where width and height are swapped or the axis misses the image.

    Only for calibrations of whole images: a crop may well have its axis anywhere.
    """
    if isinstance(camera, Scaramuzza):
        x, y = camera.cx, camera.cy
    else:
        x, y = camera.params[2:4]
    width, height = camera.width, camera.height

    def off(w: int, h: int) -> float:
        return max(abs(x / w - 0.5), abs(y / h - 0.5))

    found = f"principal point ({x:.1f}, {y:.1f}) in an image {width} wide and {height} high"
    if off(height, width) < 0.06 and off(width, height) > 0.1:
        raise InputError(
            path,
            f"{found}: width and height (or row and column) look swapped",
            f"the point is the middle of {height}x{width}",
        )
    if not (0 <= x <= width and 0 <= y <= height):
        raise InputError(path, f"{found} lies outside it", "is the calibration for another image size?")
    return camera
