"""The pictures of a run's keyframes, read when they are asked for."""

from __future__ import annotations

import threading
from functools import lru_cache

import numpy as np

from densify.run_frames import frame_of
from lightdepth.datasets import FrameSequence
from lightdepth.reporting.figures import thumbnail

SMALL, LARGE = 128, 480
"""Widths, pixels: on a camera in the scene, and beside it."""


class Pictures:
    """Of frames by number, one read at a time; none where there are no frames."""

    def __init__(self, frames: FrameSequence | None = None) -> None:
        self._frames, self._reading = frames, threading.Lock()
        self._kept = lru_cache(maxsize=32)(self._large)

    def large(self, number: int) -> np.ndarray | None:
        """(H, 480, 3) uint8; None where there is no such frame, or it cannot be read, which is warned of."""
        with self._reading:
            return self._kept(number)

    def small(self, number: int) -> np.ndarray | None:
        """As `large`, 128 wide."""
        found = self.large(number)
        return None if found is None else thumbnail(found, SMALL)

    def _large(self, number: int) -> np.ndarray | None:
        frame = frame_of(self._frames, number)
        return None if frame is None else thumbnail(frame.image, LARGE)
