"""Predictions as pictures of depth: 16-bit PNG, and EXR with 32-bit numbers.

A PNG's code is depth over a step; the step is the same for all frames of a folder, and 0 is where nothing is known.
The EXR has one channel Z, float32, without compression: lines from the top, each with its number and length.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.images import write_image
from lightdepth.geometry import depth_from_distance
from lightdepth.prediction import DepthPrediction

CODES = 65535


def depth_of(prediction: DepthPrediction) -> np.ndarray:
    """(H, W) float32 along the axis, 0 where nothing is known."""
    depth = depth_from_distance(prediction.distance, prediction.camera.rays()[0][..., 2])
    known = prediction.valid & np.isfinite(depth) & (depth > 0)
    return np.where(known, depth, 0).astype(np.float32)


def write_png16(path: Path, depth: np.ndarray, step: float) -> None:
    """Depth (H, W) in steps. Raises InputError where one does not fit 16 bits."""
    codes = np.rint(depth.astype(np.float64) / step)
    if codes.max(initial=0) > CODES:
        raise InputError(
            path, f"depth {depth.max():.4g} is more than {CODES} steps of {step:g}", "give a larger --step"
        )
    codes = np.where(depth > 0, np.maximum(codes, 1), 0)  # what is known is never 0
    write_image(path, codes.astype(np.uint16))


def write_exr(path: Path, values: np.ndarray, channel: str = "Z") -> None:
    """(H, W) as one float32 channel (OpenEXR file layout, version 2, scan lines, no compression)."""
    height, width = values.shape
    lines = np.ascontiguousarray(values, "<f4")

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    float32, sampling = 2, (1, 1)
    channels = channel.encode() + b"\0" + struct.pack("<iB3x2i", float32, 0, *sampling) + b"\0"
    header = struct.pack("<2i", 20000630, 2)
    header += attribute("channels", "chlist", channels)
    header += attribute("compression", "compression", b"\0")
    header += attribute("dataWindow", "box2i", window) + attribute("displayWindow", "box2i", window)
    header += attribute("lineOrder", "lineOrder", b"\0")
    header += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    size = 8 + 4 * width
    first = len(header) + 8 * height
    offsets = struct.pack(f"<{height}Q", *(first + size * row for row in range(height)))
    body = b"".join(struct.pack("<2i", row, 4 * width) + lines[row].tobytes() for row in range(height))
    path.write_bytes(header + offsets + body)


def fitting_step(largest: float, unit: str) -> float:
    """The step of a folder's codes: a power of ten, at most 0.001 mm where the unit is known, that the largest fits."""
    step = 1e-3 if unit == "mm" else 1e-6
    while largest / step > CODES:
        step *= 10
    return round(step, 12)
