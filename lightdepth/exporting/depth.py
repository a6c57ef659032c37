"""Predictions as pictures of depth: 16-bit PNG, and EXR with 32-bit numbers.

A PNG's code is depth over a step; the step is the same for all frames of a folder, and 0 is where nothing is known.
The EXR has one channel Z, float32 (`files.exr`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.images import write_image
from lightdepth.geometry import depth_from_distance
from lightdepth.prediction import DepthPrediction

CODES = 65535
_LEAST_CODES = 10  # of a folder's farthest depth: with fewer, a picture holds no depth


def depth_of(prediction: DepthPrediction) -> np.ndarray:
    """(H, W) float32 along the axis, 0 where nothing is known."""
    depth = depth_from_distance(prediction.distance, prediction.camera.rays()[0][..., 2])
    known = prediction.valid & np.isfinite(depth) & (depth > 0)
    return np.where(known, depth, 0).astype(np.float32)


def write_png16(path: Path, depth: np.ndarray, step: float) -> None:
    """Depth (H, W) in steps, which `checked_step` has found to fit 16 bits."""
    codes = np.rint(depth.astype(np.float64) / step)
    assert codes.max(initial=0) <= CODES, (path, step)
    codes = np.where(depth > 0, np.maximum(codes, 1), 0)  # what is known is never 0
    write_image(path, codes.astype(np.uint16))


def checked_step(step: float, largest: float, unit: str) -> float:
    """The step, or InputError where it is none or the largest depth is more than 16 bits of it."""
    if not (np.isfinite(step) and step > 0):
        raise InputError("--step", f"{step:g}", "expected a positive depth of one code")
    if largest / step > CODES:
        raise InputError(
            "--step",
            f"the farthest depth, {largest:.4g}, is more than {CODES} steps of {step:g}",
            f"give a larger one, such as {fitting_step(largest, unit):g}, or leave it out",
        )
    if 0 < largest < _LEAST_CODES * step:
        raise InputError(
            "--step",
            f"the farthest depth, {largest:.4g}, is less than {_LEAST_CODES} steps of {step:g}",
            f"give a smaller one, such as {fitting_step(largest, unit):g}, or leave it out",
        )
    return step


def fitting_step(largest: float, unit: str) -> float:
    """The step of a folder's codes: a power of ten, at most 0.001 mm where the unit is known, that the largest fits."""
    step = 1e-3 if unit == "mm" else 1e-6
    while largest / step > CODES:
        step *= 10
    return round(step, 12)
