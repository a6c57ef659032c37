"""Depth that any other program predicted, as the files that such programs write: .npz, .npy, EXR, TIFF, 16-bit PNG.

A file holds one array (H, W), of one of three kinds, s the scale that the user gives:

    distance    along the ray          t = s v
    depth       along the axis         z = s v
    disparity   one over depth         z = s / v

A pixel is valid where v is finite and above 0 (and where an array `valid` of a .npz says so). Arrays smaller or larger
than the frame, of the same aspect, are brought to its size as our own models' are: log distance is interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np

from densify.dense_map import run_record
from lightdepth.camera import CameraModel
from lightdepth.datasets.sequence import numbered_files
from lightdepth.errors import InputError
from lightdepth.files.arrays import array_in, read_arrays
from lightdepth.files.exr import read_exr
from lightdepth.files.headers import what_is_there
from lightdepth.files.images import read_bytes, read_raw
from lightdepth.geometry import distance_from_depth
from lightdepth.prediction import DepthPrediction, read_prediction
from lightdepth.ranges import above, checked

DepthKind = Literal["distance", "depth", "disparity"]
SUFFIXES = ("npz", "npy", "exr", "tiff", "tif", "png")
"""Endings that are read, the first that a folder has: a picture often lies beside the numbers."""
_NAMES = ("distance", "depth", "disparity", "disp", "pred", "prediction", "arr_0")
_CHANNELS = ("Z", *_NAMES[:4], "V", "Y", "R")
_LEAST_RAY_Z = 0.05  # as of true depth: farther to the side, depth along the axis says nothing


@dataclass(frozen=True)
@checked
class DepthReading:
    """How a folder of depth is read. Without a kind it is one that `lightdepth predict` made."""

    depth_kind: DepthKind | None = None
    """What the numbers of another program's depth files are (.npy, .npz, EXR, TIFF, 16-bit PNG): distance along the
    ray, depth along the axis, or disparity, which is one over depth. Left out, the folder is one of `lightdepth
    predict`."""
    depth_scale: Annotated[float | None, above(0)] = None
    """Factor from the numbers in another program's depth files to mm (for disparity, depth is this factor divided by
    it). Left out, they are up to scale, or as `lightdepth export` says in its run.json. A larger one makes a farther
    wall."""

    def __post_init__(self) -> None:
        if self.depth_scale is not None and not (np.isfinite(self.depth_scale) and self.depth_scale > 0):
            raise InputError("--depth-scale", f"{self.depth_scale}", "expected a positive factor")
        if self.depth_scale is not None and self.depth_kind is None:
            raise InputError(
                "--depth-scale", "given without --depth-kind", "say what is scaled: distance, depth or disparity"
            )

    def files(self, folder: Path) -> dict[int, Path]:
        """The depth files of a folder, by the number in their names. Raises InputError where there is none."""
        self._check_own(folder)
        for suffix in SUFFIXES if self.depth_kind else SUFFIXES[:1]:
            found = numbered_files(folder, rf".*?(\d+)\D*\.{suffix}")
            if found:
                return found
        if self.depth_kind is None:
            return {}
        raise InputError(
            folder,
            "no depth files with a number in their names",
            f"expected one for each frame, such as 000012.npy, ending in {', '.join(SUFFIXES)}",
        )

    def _check_own(self, folder: Path) -> None:
        """Raises InputError where the folder is of this program, and so says itself what it holds, which is another."""
        record = run_record(folder)
        if not isinstance(record, Mapping):
            return
        own = {"predict": "distance", "export": "depth"}.get(str(record.get("verb", "")))
        if own is None or self.depth_kind in (None, own) or (own == "depth" and "kind" not in record):
            return
        along = {"distance": "distance along the ray", "depth": "depth along the axis"}[own]
        raise InputError(
            "--depth-kind",
            f"{self.depth_kind}, but {folder} holds {along} (its run.json says: {record['verb']})",
            f"give --depth-kind {own}" + (", or leave it out" if own == "distance" else ""),
        )

    def read(self, path: Path, camera: CameraModel) -> DepthPrediction:
        """What a file says of a frame of this camera. Raises InputError where it does not hold what is expected."""
        if self.depth_kind is None:
            try:
                return read_prediction(path)
            except InputError as error:
                cure = f"{error.cure}; of another program's depth say --depth-kind distance, depth or disparity"
                raise InputError(error.where, error.found, cure) from error
        if not path.is_file():  # a named pipe would wait for ever
            raise InputError(path, what_is_there(path), "expected a file of depth")
        values, valid = _array(path, self.depth_kind)
        valid &= np.isfinite(values) & (values > 0)
        if not valid.any():
            raise InputError(path, "no finite number above 0 in it", "leave it out, or check --depth-kind")
        values = np.where(valid, values, 1)
        step, own_unit = _own_step(path.parent)
        scale = step if self.depth_scale is None else self.depth_scale
        with np.errstate(over="ignore"):
            metric = (scale / values if self.depth_kind == "disparity" else scale * values).astype(np.float32)
        valid &= np.isfinite(metric) & (metric > 0)
        if not valid.any():
            raise InputError(
                path, f"no depth that 32 bits hold, with a scale of {scale:g}", "check the unit of --depth-scale"
            )
        metric = np.where(valid, metric, np.float32(1))
        metric, valid = _resized(metric, valid, camera, path)
        if self.depth_kind != "distance":
            ray_z = camera.rays()[0][..., 2]
            valid &= ray_z > _LEAST_RAY_Z
            metric = distance_from_depth(metric, np.where(valid, ray_z, 1)).astype(np.float32)
        unit = own_unit if self.depth_scale is None else "mm"
        return DepthPrediction(path.stem, metric, valid, camera, f"{self.depth_kind} in {path.suffix} files", unit)


def _own_step(folder: Path) -> tuple[float, str]:
    """What one number stands for in a folder that `lightdepth export` made, and its unit; 1, up to scale, elsewhere."""
    record = run_record(folder)
    if not isinstance(record, Mapping) or record.get("verb") != "export":
        return 1.0, "up to scale"
    step = record.get("step")
    unit = "mm" if record.get("unit") == "mm" else "up to scale"
    return (float(step) if isinstance(step, (int, float)) and np.isfinite(step) and step > 0 else 1.0), unit


def other_depth(path: Path) -> bool:
    """Whether a folder may be another program's depth, which is read where its kind is said."""
    return path.is_dir() and any(numbered_files(path, rf".*?(\d+)\D*\.{suffix}") for suffix in SUFFIXES)


def _array(path: Path, kind: DepthKind) -> tuple[np.ndarray, np.ndarray]:
    """The numbers (H, W) of a file, and which of them it calls valid."""
    if path.suffix == ".npz":
        arrays = read_arrays(path)
        if kind != "distance" and arrays.keys() >= {"meta", "distance", "valid"}:  # as DepthPrediction is saved
            raise InputError(
                path, "distance along the ray, as `lightdepth predict` writes it", "leave out --depth-kind"
            )
        values, valid = _chosen(arrays, path)
    elif path.suffix == ".exr":
        values, valid = _channel(read_exr(path), path), None
    else:
        values, valid = (_load_npy(path) if path.suffix == ".npy" else read_raw(path)), None
    shape = values.shape
    if values.ndim != 2:
        values = values.squeeze()
    if values.ndim != 2 or values.dtype.kind not in "fui":
        raise InputError(path, f"{values.dtype} of shape {shape}", "expected one number a pixel, (H, W)")
    if values.dtype == np.uint8:
        raise InputError(
            path, "8 bits a pixel, a picture of depth and not depth", "expected 16-bit PNG, TIFF, .npy or .npz"
        )
    return values.astype(np.float64), np.ones(values.shape, bool) if valid is None else valid.copy()


def _load_npy(path: Path) -> np.ndarray:
    return array_in(read_bytes(path), path)


def _chosen(arrays: Mapping[str, np.ndarray], path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """The depth of an .npz, by its name, or the only array of numbers; and `valid`, where that is there."""
    numbers = {name: a for name, a in arrays.items() if a.dtype.kind in "fui" and a.squeeze().ndim == 2}
    named = [name for name in _NAMES if name in numbers] or (list(numbers) if len(numbers) == 1 else [])
    if not named:
        raise InputError(
            path,
            f"arrays {', '.join(arrays) or 'none'}: none is known as depth",
            f"expected one array (H, W), or one with the name {', '.join(_NAMES[:4])}",
        )
    valid = arrays.get("valid")
    fits = valid is not None and valid.dtype == bool and valid.shape == numbers[named[0]].shape
    return numbers[named[0]], valid if fits else None


def _channel(channels: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    """The depth of an EXR: its only channel, one with a known name, or any of three that are the same."""
    found = next((name for name in _CHANNELS if name in channels), next(iter(channels)))
    grey = all(np.array_equal(channels[found], channels[other], equal_nan=True) for other in "GB" if other in channels)
    if (found not in _CHANNELS and len(channels) > 1) or (found == "R" and not grey):
        raise InputError(
            path,
            f"channels {', '.join(channels)}: none is known as depth",
            f"expected one channel, or one with the name {', '.join(_CHANNELS[:5])}",
        )
    return channels[found]


def _resized(metric: np.ndarray, valid: np.ndarray, camera: CameraModel, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """At the size of the camera; valid where all pixels that are merged are."""
    height, width = metric.shape
    size = (camera.width, camera.height)
    if (width, height) == size:
        return metric, valid
    if abs(width * camera.height / (height * camera.width) - 1) > 0.01:
        raise InputError(
            path,
            f"depth is {width}x{height}, the frame {camera.width}x{camera.height}",
            "expected the same size, or one of the same aspect",
        )
    method = cv2.INTER_AREA if camera.width < width else cv2.INTER_LINEAR
    share = cv2.resize(valid.astype(np.float32), size, interpolation=method)
    log = cv2.resize(np.where(valid, np.log(metric), 0).astype(np.float32), size, interpolation=method)
    return np.exp(log), share > 0.999
