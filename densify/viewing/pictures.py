"""The pictures of a run's keyframes, read when they are asked for.

Those of frames are taken from the frames; those of what was predicted of them were written by `densify`.
"""

from __future__ import annotations

import threading
from functools import lru_cache
from pathlib import Path

import numpy as np

from densify.run_frames import frame_of
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.files.images import read_pixels
from lightdepth.reporting.figures import thumbnail

SMALL, LARGE = 128, 480
"""Widths, pixels: on a camera in the scene, and beside it."""


class Pictures:
    """Of frames by number, one read at a time; none where there are no frames. `rows` is the folder with what was
    predicted of each keyframe."""

    def __init__(self, frames: FrameSequence | None = None, rows: Path | None = None) -> None:
        self._frames, self._rows, self._reading = frames, rows, threading.Lock()
        self._kept = lru_cache(maxsize=32)(self._large)

    def large(self, number: int) -> np.ndarray | None:
        """(H, 480, 3) uint8; None where there is no such frame, or it cannot be read, which is warned of."""
        with self._reading:
            return self._kept(number)

    def small(self, number: int) -> np.ndarray | None:
        """As `large`, 128 wide."""
        found = self.large(number)
        return None if found is None else thumbnail(found, SMALL)

    def row(self, number: int) -> np.ndarray | None:
        """Distance, uncertainty and residual (H, W, 3) uint8 beside each other (densify.thumbnails); None where no such
        picture was written, or it cannot be read."""
        if self._rows is None or not (file := self._rows / f"{number:06d}.jpg").is_file():
            return None
        try:
            return read_pixels(file)
        except InputError:
            return None

    def _large(self, number: int) -> np.ndarray | None:
        frame = frame_of(self._frames, number)
        return None if frame is None else thumbnail(frame.image, LARGE)
