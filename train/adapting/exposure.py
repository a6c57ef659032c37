"""Frames that show nothing: black or white nearly all over. They teach nothing and judge nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import readable
from lightdepth.image_quality import Meter

_LOOKED_AT = 64  # frames, evenly chosen
_SHARE = 0.95  # of a frame's pixels that are black or white, from which it shows nothing
_MOST = 0.5  # of the frames that may show nothing


def check_exposed(parts: Sequence[FrameSequence]) -> None:
    """Raises InputError where more than half of the frames of any part are black or white nearly all over."""
    for part in parts:
        black, white, looked = _empty(part)
        if black + white > _MOST * looked:
            raise InputError(
                f"{part.source}: {part.names[0]} to {part.names[-1]}",
                f"{black / looked:.0%} of the frames are black and {white / looked:.0%} white over "
                f"{_SHARE:.0%} of their pixels",
                "expected frames that show lit tissue: is the mask the right way round, and the light on?",
            )


def _empty(frames: FrameSequence) -> tuple[int, int, int]:
    """How many frames are black, how many white, and how many were looked at: those that can be read."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_LOOKED_AT, len(frames))).round().astype(int))
    black = white = looked = 0
    for frame in readable(frames, chosen.tolist()):
        looked += 1
        meter = Meter(frame.valid)
        meter.add(np.rint(255 * np.clip(frame.image, 0, 1)).astype(np.uint8))
        found = meter.result()
        black += bool(found.dark[0] > _SHARE)
        white += bool(found.saturated[0] > _SHARE)
    return black, white, looked
