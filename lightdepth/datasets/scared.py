"""SCARED: stereo endoscopy of porcine abdomens with structured light, `dataset_<d>/keyframe_<k>/` as it is shipped.

| what | where | as |
|---|---|---|
| a sequence | `data/rgb.mp4` | both views of each frame, the left above the right |
| calibration and poses | `data/frame_data/frame_data%06d.json` | `KL DL KR DR R T`, camera-pose |
| truth | `data/scene_points/scene_points%06d.tiff` | float32 X Y Z [mm] of each pixel, both views |
| the keyframe alone | `Left_Image.png`, `left_depth_map.tiff` | X Y Z; `endoscope_calibration.yaml` has M1 D1 R T |

Both folders in data/ may still be the .tar.gz they are shipped as. The number in a name is the video's frame, from 0.
The camera-pose is taken as camera-from-world in millimetres, as most readers of the set do; some take metres. Where the
truth fits another direction or unit better, that is taken, and a warning says so. Truth is depth (Z) along the axis, 0
or NaN where missing; points of later frames were made by moving the keyframe's with these poses. The first pixel's
centre is at (0, 0). A fifth coefficient k3 is folded into the other four, unless that moves a pixel by more than half
a pixel. The light is not known.

Going back in an archive starts from its beginning, so extract scene_points.tar.gz before training.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.calibration.opencv import read_matrices
from lightdepth.camera import Brown, CameraModel, camera_from_params
from lightdepth.camera_conversion import without_k3
from lightdepth.datasets.checks import READINGS, fitting_reading
from lightdepth.datasets.folder import image_folder
from lightdepth.datasets.format import Format, frames_of
from lightdepth.datasets.scared_files import IMAGES, VIDEO, numbered_members
from lightdepth.datasets.sequence import FrameSequence, along_ray
from lightdepth.datasets.video import VideoFile
from lightdepth.datasets.video_sequence import border_of
from lightdepth.errors import InputError
from lightdepth.files.images import decode_raw, image_size, read_raw, unit_range
from lightdepth.frame import Frame
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration
from lightdepth.pose_readings import AS_GIVEN, INVERSE
from lightdepth.sparse_map import check_rigid

_DATA, _POINTS = ("frame_data", r"frame_data(\d+)\.json"), ("scene_points", r"scene_points(\d+)\.tiff?")
_METRES = next(name for name in READINGS if "multiplied by 1000" in name and INVERSE not in name)
_BAD = ("dataset_4", "dataset_5")


@dataclass(frozen=True)
class _Calibration:
    """One view's matrix (9) and distortion, and where the left camera is from the right (4, 4) [mm]."""

    matrix: list[float]
    distortion: list[float]
    right_from_left: np.ndarray


def is_scared(path: Path) -> bool:
    """Whether a folder is a keyframe of SCARED, with its video or alone."""
    return (path / VIDEO).is_file() or all(
        (path / name).is_file() for name in ("Left_Image.png", "left_depth_map.tiff")
    )


def read_scared(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    view: str = "left",
    *,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of one view ("left" or "right"), with distance and pose where the folder has them.

    The sequence of data/rgb.mp4, or where there is none the keyframe alone.
    """
    if view not in IMAGES:
        raise InputError("view", f"{view!r} is not known", "expected left or right")
    if any(part in _BAD for part in path.resolve().parts):
        warnings.warn(
            f"{path}: the calibration of {' and '.join(_BAD)} is known to be wrong; leave them out", stacklevel=3
        )
    if (path / VIDEO).is_file():
        return _read_sequence(path, camera, light or PhotometricCalibration(), mask, view)
    return _read_keyframe(path, camera, light or PhotometricCalibration(), mask, view, bit_depth)


FORMAT = Format("scared", fits=is_scared, images=image_folder, has_camera=lambda _: True, read=read_scared)


def _read_keyframe(
    path: Path,
    camera: CameraModel | None,
    light: PhotometricCalibration,
    mask: np.ndarray | None,
    view: str,
    bit_depth: int | None,
) -> FrameSequence:
    image, truth = path / IMAGES[view], path / f"{view}_depth_map.tiff"
    if not image.is_file():
        raise InputError(path, f"neither {VIDEO} nor {image.name} in it", "is it a keyframe folder of SCARED?")
    width, height = image_size(image)
    if camera is None:
        camera = _camera(_read_yaml(path / "endoscope_calibration.yaml", view), width, height, path)

    def distance(i: int) -> np.ndarray | None:
        return _distance(read_raw(truth), camera, truth) if truth.is_file() else None

    names = [f"keyframe_{_number(path)}"]
    return frames_of(path, [image], camera, light, mask, names=names, distance=distance, bit_depth=bit_depth)


def _read_sequence(
    path: Path, camera: CameraModel | None, light: PhotometricCalibration, mask: np.ndarray | None, view: str
) -> FrameSequence:
    video = VideoFile(path / VIDEO)
    if video.height % 2:
        raise InputError(
            video.path, f"{video.width}x{video.height}", "expected the left view above the right, of one height"
        )
    height, times = video.height // 2, video.times
    data, points = numbered_members(path / "data", *_DATA), numbered_members(path / "data", *_POINTS)
    records = {n: (name, _json(blob, name)) for n, name, blob in data.all()} if data is not None else {}
    if camera is None and not records:
        raise InputError(
            path,
            "neither data/frame_data.tar.gz nor data/frame_data/",
            f"put it beside the video, or give {option('camera')}",
        )
    numbers = sorted(records) if records else list(range(len(video)))
    if numbers[-1] >= len(video):
        raise InputError(
            path, f"there is frame data {numbers[-1]}, but {VIDEO} has {len(video)} frames, from 0", "is it complete?"
        )
    calibration = _from_json(*records[numbers[0]], view) if records else None
    if camera is None:
        assert calibration is not None
        camera = _camera(calibration, video.width, height, path)
    poses = {n: _pose(*record) for n, record in records.items()}
    view_from_left = np.eye(4) if view == "left" or calibration is None else calibration.right_from_left
    first_row = 0 if view == "left" else height
    if mask is None:
        found = border_of(video, slice(first_row, first_row + height))
        mask = None if found.all() else found
    names = [f"{n:06d}" for n in numbers]
    # An archive is read from its start: its middle and end would cost minutes
    sampled = None if points is None or points.cheap else range(0, min(11, len(numbers)), 5 if len(numbers) > 5 else 1)

    def loader(reading: Callable[[np.ndarray], np.ndarray]) -> Callable[[int], Frame]:
        def load(i: int) -> Frame:
            number = numbers[i]
            blob = points.get(number) if points is not None else None
            distance = None
            if blob is not None:
                distance = _distance(decode_raw(blob[1], blob[0]), camera, blob[0], first_row)
            return Frame(
                names[i],
                unit_range(video.read(number)[first_row : first_row + height]),
                camera,
                light,
                mask,
                time=float(times[number]) if np.isfinite(times[number]) else None,
                true_distance=distance,
                true_world_from_cam=reading(poses[number]) @ np.linalg.inv(view_from_left) if number in poses else None,
            )

        # The frames just looked at are asked for again, and an archive would start anew
        return load if sampled is None else lru_cache(3)(load)

    sequence = FrameSequence(names, loader(np.linalg.inv), str(path), sampled)
    if not poses or points is None:
        return sequence
    readings = _pose_readings()
    frames = [sequence[i] for i in sequence.sampled]
    fit = fitting_reading(frames)
    if fit is None or fit.best == AS_GIVEN or fit.best not in readings:
        return sequence
    warnings.warn(
        f"{path}: the poses, taken as camera-from-world in millimetres, miss the true distances by "
        f"{fit.error_as_given:.1%} (median); they are read {readings[fit.best][0]}, which fits to {fit.error:.1%}",
        stacklevel=4,
    )
    return FrameSequence(names, loader(readings[fit.best][1]), str(path), sampled)


def _pose_readings() -> dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]]:
    """Of READINGS, those in which SCARED's poses are read: what it is in words, and world_from_cam [mm] of a pose."""

    def metres(pose: np.ndarray) -> np.ndarray:
        pose = pose.copy()
        pose[:3, 3] *= 1000
        return pose

    both = next(name for name in READINGS if name.startswith(INVERSE) and "multiplied by 1000" in name)
    return {
        _METRES: ("as camera-from-world in metres", lambda pose: np.linalg.inv(metres(pose))),
        INVERSE: ("as world-from-camera in millimetres", lambda pose: pose),
        both: ("as world-from-camera in metres", metres),
    }


# ---- calibration, poses, truth


def _from_json(where: str, record: dict[str, Any], view: str) -> _Calibration:
    found = record.get("camera-calibration")
    if not isinstance(found, dict):
        raise InputError(where, "camera-calibration missing", "expected KL, DL, KR, DR, R and T")
    side = view[0].upper()
    return _calibration({k: _flat(found.get(k), f"{where}: {k}") for k in (f"K{side}", f"D{side}", "R", "T")}, where)


def _read_yaml(path: Path, view: str) -> _Calibration:
    if not path.is_file():
        raise InputError(path, "no such file", f"put the keyframe's there, or give {option('camera')} FILE")
    side = "1" if view == "left" else "2"
    return _calibration(read_matrices(path, (f"M{side}", f"D{side}", "R", "T")), str(path))


def _calibration(found: dict[str, list[float]], where: str) -> _Calibration:
    """From K, D, R, T by these first letters (M for K), in this order."""
    (matrix_name, matrix), (_, distortion), (_, rotation), (_, translation) = found.items()
    if len(matrix) != 9 or matrix[3] or matrix[6:] != [0, 0, 1] or abs(matrix[1]) > 1e-6:
        raise InputError(where, f"{matrix_name} {matrix}", "expected fx 0 cx / 0 fy cy / 0 0 1")
    if len(rotation) != 9 or len(translation) != 3:
        raise InputError(where, f"R has {len(rotation)} numbers and T {len(translation)}", "expected 9 and 3")
    right_from_left = np.eye(4)
    right_from_left[:3, :3] = np.reshape(rotation, (3, 3))
    right_from_left[:3, 3] = translation
    baseline = float(np.linalg.norm(translation))
    if 0 < baseline < 0.05:
        right_from_left[:3, 3] *= 1000
        warnings.warn(f"{where}: the baseline |T| is {baseline:g}: taken as metres", stacklevel=6)
    elif not 1 <= baseline <= 20:
        warnings.warn(
            f"{where}: the baseline |T| is {baseline:g}; a stereo endoscope's is about 4 mm: what is its unit?",
            stacklevel=6,
        )
    check_rigid(right_from_left, f"{where}: R and T")
    return _Calibration(matrix, distortion, right_from_left)


def _camera(calibration: _Calibration, width: int, height: int, path: Path) -> CameraModel:
    fx, _, cx, _, fy, cy, *_ = calibration.matrix
    distortion = calibration.distortion
    if len(distortion) not in (0, 4, 5):
        raise InputError(path, f"{len(distortion)} distortion coefficients", "expected k1 k2 p1 p2 and perhaps k3")
    if not any(distortion):
        return camera_from_params("PINHOLE", width, height, [fx, fy, cx, cy], str(path)).with_pixel_center(0.0)
    camera = camera_from_params("OPENCV", width, height, [fx, fy, cx, cy, *distortion[:4]], str(path))
    assert isinstance(camera, Brown)
    if len(distortion) == 5 and distortion[4]:
        camera, off = without_k3(camera, distortion[4])
        if off > 0.5:
            raise InputError(
                path,
                f"k3 = {distortion[4]:g} cannot be folded into k1, k2, p1, p2: {off:.2g} pixels are left",
                f"undistort the images, or give {option('camera')} FILE",
            )
        warnings.warn(
            f"{path}: k3 = {distortion[4]:g} is folded into the other coefficients, off by {off:.2g} pixels",
            stacklevel=5,
        )
    return camera.with_pixel_center(0.0)


def _pose(where: str, record: dict[str, Any]) -> np.ndarray:
    pose = np.array(_flat(record.get("camera-pose"), f"{where}: camera-pose"))
    if pose.size != 16:
        raise InputError(where, f"camera-pose has {pose.size} numbers", "expected 4x4")
    check_rigid(pose.reshape(4, 4), f"{where}: camera-pose")
    return pose.reshape(4, 4)


def _distance(points: np.ndarray, camera: CameraModel, where: Path | str, first_row: int = 0) -> np.ndarray:
    """(H, W) float32 distance from X Y Z (H or 2 H, W, 3), from `first_row` on."""
    height = len(points) if len(points) == camera.height else 2 * camera.height
    expected = (height, camera.width, 3)
    if points.dtype != np.float32 or points.shape != expected:
        raise InputError(
            where,
            f"{points.dtype} of shape {points.shape}",
            f"expected float32 X Y Z of shape {expected}, each pixel's point",
        )
    depth = points[first_row : first_row + camera.height, :, 2]
    ray_z = camera.rays()[0][..., 2]
    known = np.isfinite(depth) & (depth > 0)
    return along_ray(np.where(known, depth, 0), known, ray_z)


def _number(path: Path) -> str:
    """The k of keyframe_k; 0 where the folder has another name."""
    found = re.search(r"(\d+)$", path.resolve().name)
    return found[1] if found else "0"


def _json(blob: bytes, where: str) -> dict[str, Any]:
    try:
        found = json.loads(blob)
    except (ValueError, RecursionError) as error:
        raise InputError(where, f"not valid JSON ({error})", "is the archive complete?") from error
    if not isinstance(found, dict):
        raise InputError(where, f"holds {type(found).__name__}", "expected camera-calibration and camera-pose")
    return found


def _flat(value: Any, where: str) -> list[float]:
    """A matrix of finite numbers, row by row."""
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise InputError(where, f"{str(value)[:40]}", "expected numbers") from error
    if value is None or not np.isfinite(numbers).all():
        raise InputError(where, f"{'missing' if value is None else 'NaN or infinite'}", "expected finite numbers")
    return numbers.tolist()
