"""Which frames are kept: by time, the sharpest of each interval, without blurred, frozen and double ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.ndimage import percentile_filter

from lightdepth.errors import InputError
from lightdepth.image_quality import Measures, doubles, repeats
from lightdepth.ranges import BELOW_ONE, above, at_least, checked

KEPT, PASSED, BLURRED, UNREADABLE = "kept", "passed over", "blurred", "unreadable"
FROZEN, DOUBLE = "frozen", "double"


@dataclass(frozen=True)
@checked
class Choice:
    """Which frames to keep."""

    rate: Annotated[float | None, above(0, up_to=10_000)] = None
    """Number of frames to keep per second, the sharpest of each interval; left out, 5 for a video, and all of a folder.
    More keep more frames; not with --every."""
    every: Annotated[int | None, at_least(1)] = None
    """Number N of which every N-th frame is kept, counted over all frames from --start on, unless it is blurred or
    frozen; instead of a rate per second. More keep fewer frames."""
    start: Annotated[float, at_least(0)] = 0.0
    """Time before which frames are left out, seconds from the first frame. A larger one leaves out more at the
    beginning."""
    end: Annotated[float | None, at_least(0)] = None
    """Time after which frames are left out, seconds from the first frame; left out itself, all are kept to the last. A
    larger one keeps more."""
    blur: Annotated[float, BELOW_ONE] = 0.6
    """Least sharpness of a frame, as a share, in [0, 1), of that which the sharpest quarter of the frames within about
    a second before and after reach. A frame below it is left out as blurred; 0 leaves out none. A larger one leaves out
    more."""
    max_frames: Annotated[int | None, at_least(1)] = None
    """Largest number of frames to keep; where the other options keep more, this number of them is taken at even steps.
    A larger one keeps more frames; without it there is no limit."""

    def __post_init__(self) -> None:
        if self.end is not None and self.end <= self.start:
            raise InputError("--start", f"{self.start} --end {self.end}", "expected an end after the start")
        if self.rate is not None and self.every is not None:
            raise InputError(
                "--rate, --every", f"{self.rate} and {self.every}, which are both given", "give one of them"
            )


def selected(times: np.ndarray, measures: Measures, choice: Choice) -> np.ndarray:
    """(n,) what becomes of each frame: kept, passed over, blurred, frozen, double or unreadable. times (n,) [s] of the
    frames; where they are unknown, `rate` cannot be used."""
    fate = np.full(len(times), PASSED, dtype="<U12")
    fate[~measures.readable] = UNREADABLE
    again = measures.readable & repeats(measures.change)
    fate[again] = FROZEN
    fate[again & doubles(measures.change)] = DOUBLE
    left = fate == PASSED
    blurred = left & (measures.sharpness < choice.blur * neighbourhood(measures.sharpness, times))
    fate[blurred] = BLURRED
    good = np.flatnonzero(left & ~blurred)
    if choice.every is not None:
        good = good[good % choice.every == 0]
    elif choice.rate is not None:
        if np.isnan(times[good]).any():
            raise InputError("--rate", "the frames have no times", "choose with --every N")
        interval = np.floor((times[good] - np.nanmin(times)) * choice.rate + 1e-6).astype(int)
        # Sorted by interval, the sharpest first; of each interval the first.
        order = np.lexsort((-measures.sharpness[good], interval))
        good = np.sort(good[order[np.unique(interval[order], return_index=True)[1]]])
    if choice.max_frames is not None and len(good) > choice.max_frames:
        good = good[np.linspace(0, len(good) - 1, choice.max_frames).round().astype(int)]
    fate[good] = KEPT
    return fate


def neighbourhood(sharpness: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) upper quartile of sharpness within about a second before and after: at least 5, at most 121 frames."""
    steps = np.diff(times)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    size = int(np.clip(2 / np.median(steps), 5, 121)) | 1 if len(steps) else 15
    known = np.isfinite(sharpness)
    filled = np.interp(np.arange(len(sharpness)), np.flatnonzero(known), sharpness[known]) if known.any() else sharpness
    result: np.ndarray = percentile_filter(filled, 75, size=min(size, 2 * len(filled) - 1), mode="nearest")
    return result
