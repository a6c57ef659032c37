"""Whether a sequence shows anything at all: black frames, and masks of other images, make no depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightdepth.datasets.sequence import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame, readable

_SURELY_BLACK = 64
"""Frames that are black before a sequence is said to be."""


def shows_something(frame: Frame) -> bool:
    """Whether a model could say anything of a frame: some pixel inside mask and lens is not black."""
    from lightdepth.decline import V_FLOOR

    return bool(((frame.image.max(-1) > V_FLOOR) & frame.valid).any())


def check_shown(sequence: FrameSequence, frames: Sequence[Frame]) -> None:
    """Raises InputError where all frames are black, or masked; a few dozen are looked at where the first ones are."""
    from lightdepth.decline import V_FLOOR  # brings kornia along, which takes a second

    if any(map(shows_something, frames)):
        return
    rows = np.unique(np.linspace(0, len(sequence) - 1, _SURELY_BLACK).round().astype(int)).tolist()
    count = 0
    for frame in readable(sequence, rows):  # one at a time: dozens would fill the memory
        count += 1
        if shows_something(frame):
            return
    looked_at = f"{count} frames" if count == len(sequence) else f"{count} frames looked at, of {len(sequence)},"
    raise InputError(
        sequence.source,
        f"none of the {looked_at} has a pixel inside mask and lens that is brighter than {V_FLOOR:.0%} of white",
        "look at them: are they black, or is the mask that of other images?",
    )
