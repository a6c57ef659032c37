"""What is odd about a video, said when it is opened: a few stretches of neighbouring frames are looked at.

Nothing is changed: which field to keep, which frames to leave out and how to turn pictures is for `lightdepth import`,
as a camera and a map are for the pixels that are stored.
"""

from __future__ import annotations

import warnings

import numpy as np

from lightdepth.datasets.clip import Clip, uneven
from lightdepth.errors import InputError
from lightdepth.image_quality import Measures, Meter, combed, doubles

_STRETCHES, _LENGTH = 3, 12  # frames that are looked at together, and how many such groups
_LEAST_COMBED, _LEAST_DOUBLE = 0.2, 0.1


def check_clip(clip: Clip, mask: np.ndarray) -> None:
    """Warns of a varying rate, pictures that are to be turned, interlacing and doubled frames."""
    for message in (*_of_file(clip), *_of_pictures(clip, mask)):
        warnings.warn(f"{clip.path}: {message}", stacklevel=5)


def _of_file(clip: Clip) -> list[str]:
    found = []
    if clip.rotation:
        found.append(
            f"a flag asks players to turn the pictures by {clip.rotation} degrees; it is ignored: pixels are taken "
            "as they are stored, and so are camera, mask and map (ffmpeg and OpenCV turn them)"
        )
    if (steps := uneven(clip.times)) is not None:
        found.append(
            f"the frame rate varies, in steps of {1000 * steps[0]:.0f} to {1000 * steps[1]:.0f} ms: each frame has its "
            "own time, never number / rate"
        )
    return found


def _of_pictures(clip: Clip, mask: np.ndarray) -> list[str]:
    measured = [m for start in _starts(clip) if (m := _measured(clip, mask, start)) is not None]
    counts = np.array([combed(m) for m in measured]).reshape(-1, 2).sum(0)
    teeth, moving = int(counts[0]), int(counts[1])
    again = np.concatenate([np.zeros(0, bool), *(doubles(m.change)[1:] for m in measured)])
    found = []
    if moving >= 3 and teeth >= _LEAST_COMBED * moving:
        flag = ", as the file says" if clip.interlaced else ""
        found.append(
            f"the pictures are interlaced{flag}: {teeth / moving:.0%} of {moving} moving frames that were looked at "
            "are combed; `lightdepth import --deinterlace` keeps one field, and the camera stays right"
        )
    elif clip.interlaced:
        seen = f"none of {moving} moving frames that were looked at is combed" if moving else "nothing moves in them"
        found.append(f"the file says that its pictures are interlaced, and {seen}: they are taken as they are")
    if moving and again.mean() >= _LEAST_DOUBLE:
        found.append(
            f"{again.mean():.0%} of {len(again)} frames that were looked at repeat the one before: a lower rate was "
            "saved at a higher one; `lightdepth import` leaves them out, and times stay true"
        )
    return found


def _starts(clip: Clip) -> list[int]:
    """Where stretches begin: quick to reach, with a stretch's length before the end."""
    last = max(0, len(clip) - clip.missing - _LENGTH)
    places = np.linspace(0, last, _STRETCHES)
    quick = np.array([k for k in clip.keyframes if k <= last] or [0])
    return sorted({int(quick[np.abs(quick - place).argmin()]) for place in places})


def _measured(clip: Clip, mask: np.ndarray, start: int) -> Measures | None:
    if mask.shape != (clip.height, clip.width):
        return None  # which is refused when a frame is read
    meter = Meter(mask)
    for i in range(start, min(start + _LENGTH, len(clip) - clip.missing)):
        try:
            meter.add(clip.read(i))
        except InputError:
            meter.unreadable()
    return meter.result()
