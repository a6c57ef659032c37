"""What a video is to its readers, whatever holds it; and which of its samples are white.

Pictures keep 16 bits where a file has more than 8. A file of 16 may hold samples of 10 or 12 as they are, which then
fill a 64th or 16th of it: `bit_depth` says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from lightdepth.errors import InputError
from lightdepth.option_names import option

_DARK = 4096 / 65535
"""Highest value of a video of 16 bits, of white, below which its samples may be of fewer bits."""
_VARYING = 0.05


class Clip(Protocol):
    """Pictures in the order of time. `times` (n,) [s] are NaN where the file does not tell; `keyframes` are indices
    that are quick to reach; `missing` frames at the end are announced, not there; `tags` may tell a patient."""

    path: Path
    codec: str
    rate: float | None
    times: np.ndarray
    width: int
    height: int
    bits: int
    white: float
    pixel_aspect: float
    keyframes: list[int]
    missing: int
    rotation: int
    interlaced: bool
    tags: list[str]

    def __len__(self) -> int: ...

    def read(self, index: int) -> np.ndarray:
        """Picture (H, W, 3) RGB, uint8, or uint16 where there are more than 8 bits."""
        ...


def white_level(bits: int, bit_depth: int | None) -> float:
    """The share of a file's own white that is white, where its samples have `bits` and the user says `bit_depth`."""
    if bit_depth is not None and not 1 <= bit_depth <= 32:
        raise InputError(option("bit-depth"), f"{bit_depth}", "expected the bits of a sample, from 8 to 32")
    if bit_depth is None or bits <= 8:
        return 1.0
    if not 1 <= bit_depth <= bits:
        raise InputError(option("bit-depth"), f"{bit_depth}, of a video of {bits} bits", f"expected up to {bits}")
    return (2.0**bit_depth - 1) / (2.0**bits - 1)


def brightened(pixels: np.ndarray, white: float, where: str) -> np.ndarray:
    """The pixels (H, W, 3) of a file in which this share of white is white. Raises InputError where one is beyond."""
    if white == 1.0:
        return pixels
    highest = float(pixels.max()) / np.iinfo(pixels.dtype).max
    if highest > white * 1.01:
        raise InputError(
            where, f"pixels {highest / white:.3g} times as bright as white", f"give a larger {option('bit-depth')}"
        )
    top = float(np.iinfo(pixels.dtype).max)
    result: np.ndarray = np.rint(np.minimum(pixels / np.float32(white), np.float32(top))).astype(pixels.dtype)
    return result


def check_depth(clip: Clip, images: Sequence[np.ndarray]) -> None:
    """Raises InputError where a clip of 16 bits is so dark, in pictures (H, W, 3) in [0, 1] of it, that its samples may
    have been of fewer."""
    highest = max((float(image.max()) for image in images), default=1.0)
    if clip.bits < 16 or clip.white != 1.0 or not 0 < highest < _DARK:
        return
    least = max(8, int(np.ceil(np.log2(highest * 65535 + 1))))
    raise InputError(
        clip.path,
        f"a video of {clip.bits} bits whose highest value is {highest * 65535:.0f}: samples of {least} bits stored as "
        "they are, or pictures that are nearly black",
        f"give {option('bit-depth')} {least}, or {option('bit-depth')} {clip.bits} if they are dark",
    )


def uneven(times: np.ndarray) -> tuple[float, float] | None:
    """Short and long steps [s] from frame to frame, where the rate of times (n,) [s] varies; else None."""
    steps = np.diff(times[np.isfinite(times)])
    if len(steps) < 2:
        return None
    short, long = np.quantile(steps, (0.05, 0.95))
    return (float(short), float(long)) if long - short > _VARYING * np.median(steps) + 1e-3 else None
