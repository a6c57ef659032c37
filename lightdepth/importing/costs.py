"""About how long an import takes, for a dry run: the first frames are read, measured and encoded on the spot."""

from __future__ import annotations

import numpy as np

from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.errors import InputError
from lightdepth.image_quality import Meter
from lightdepth.importing.source import Source
from lightdepth.reporting.figures import png
from lightdepth.reporting.plan import timed, times

_SOME = 3  # frames in a row: a video is decoded from a key picture on


def import_steps(source: Source, frames: bool) -> list[Step]:
    """Measuring, and writing those that are chosen, which are all at the most."""
    count, some = len(source), min(_SOME, len(source))
    measure = Meter(np.ones((source.height, source.width), bool))

    def measured() -> None:
        for i in range(some):
            measure.add(source.read(i)[0])

    try:
        each = timed(measured) / some
        pixels = source.read(0)[0]
        written = timed(lambda: png(pixels.astype(np.uint8)))
    except InputError:
        each, written = None, None
    steps = [Step(f"measuring {counted(count, 'frame')}", times(count, each))]
    if frames:
        both = None if each is None or written is None else each + written
        steps.append(Step("writing those that are chosen, at the most", times(count, both)))
    return steps
