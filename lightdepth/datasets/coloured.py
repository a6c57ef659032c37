"""The colours of a sequence: some dozen of its frames are looked at, each with the one that follows it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightdepth.colour import ColourMeter, Colours
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.errors import InputError

LOOKED_AT = 32
"""Frames of a sequence that are looked at, each with its neighbour."""


def colours_of(frames: FrameSequence, among: Sequence[int] | None = None, most: int = LOOKED_AT) -> Colours:
    """Of `most` frames spread over the sequence, or over those `among` its rows, with the frame after each. What cannot
    be read is left out."""
    rows = list(range(len(frames))) if among is None else sorted(set(among))
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))
    first = {rows[i] for i in chosen.tolist()}
    looked = sorted(first | {row + 1 for row in first if row + 1 < len(frames)})
    blind, meter, last = frames.without_truth(), ColourMeter(), -2
    for row in looked:
        if row != last + 1:
            meter.apart()
        last = row
        try:
            frame = blind[row]
        except InputError:
            meter.apart()
            continue
        meter.add(frame.image, frame.valid)
    return meter.result()
