"""Numbers that say how good a frame is: sharpness, exposure, motion, combing.

All are taken where tissue shows, on 8-bit values. Sharpness is the deviation of the Laplacian over the mean brightness,
at no more than 640 columns, so that neither exposure nor sensor noise passes for detail. Combing compares rows with
their neighbours and with those of their own field: in interlaced pictures of a moving scene the next row but one is
more alike than the next.

A frame that repeats the one before differs from it by compression or the recorder's noise alone: hardly at all, or far
less than the frames beside it do. Measured on H.264 of CRF 18 to 28 with noise of up to 4 of 255: repeats change by at
most 0.7 (1.5 where a keyframe of the stream codes them anew), the others by 2.6 or more where the camera moves by a
pixel a frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

COLUMNS = 640
THUMBNAIL = 64
SAME = 0.1
"""Mean difference of thumbnails, of 255, up to which a frame is the one before again."""
COMBED = 1.1
"""Combing from which a frame that moves is interlaced."""
_MOVING = 1.0  # change, of 255, from which a frame surely moves
_SHORT = 4  # repeats in a row, up to which they are doubles
_STILL = 2.0  # change, of 255, up to which a frame may repeat: a repeat that is coded anew changes by 1.5
_REPEATED = 0.25  # of the change of the frames beside it, up to which a frame repeats
WHITE, BLACK = 250, 16


@dataclass(frozen=True)
class Measures:
    """One number per frame (n,). Frames that could not be read are NaN everywhere.

    brightness: mean of the brightest channel, 0..255; saturated: share of pixels white in all channels; dark: share
    black in all; sharpness; change: mean difference from the frame before, 0..255, infinite for the first; combing: of
    neighbouring rows over that of next-but-one rows; red, green, blue: means, 0..255.
    """

    brightness: np.ndarray
    saturated: np.ndarray
    dark: np.ndarray
    sharpness: np.ndarray
    change: np.ndarray
    combing: np.ndarray
    red: np.ndarray
    green: np.ndarray
    blue: np.ndarray

    @property
    def readable(self) -> np.ndarray:
        result: np.ndarray = np.isfinite(self.brightness)
        return result


def repeats(change: np.ndarray) -> np.ndarray:
    """(n,) bool: which frames repeat the one before, by the change (n,) of each from the one before it."""
    result: np.ndarray = (change <= SAME) | _dips(change)
    return result


def doubles(change: np.ndarray) -> np.ndarray:
    """(n,) bool: the frames that repeat the one before singly or by a few, as where a lower rate was saved at a higher
    one; a picture that stands for longer is frozen."""
    again = repeats(change)
    result: np.ndarray = _dips(change) | (again & (_run_lengths(again) <= _SHORT))
    return result


def _dips(change: np.ndarray) -> np.ndarray:
    """(n,) bool: frames of short runs that change far less than the frames just before and after the run: a camera that
    slows down does so by degrees. There may be nothing before or after, not both."""
    count = len(change)
    padded = np.pad(change.astype(np.float64), _SHORT + 1, constant_values=np.inf)
    found = np.zeros(len(padded), bool)
    for length in range(1, _SHORT + 1):
        runs = np.lib.stride_tricks.sliding_window_view(padded, length + 2)
        inside, beside = runs[:, 1:-1].max(1), np.minimum(runs[:, 0], runs[:, -1])
        starts = np.flatnonzero((inside < _STILL) & np.isfinite(beside) & (inside < _REPEATED * beside))
        for k in range(1, length + 1):
            found[starts + k] = True
    return found[_SHORT + 1 : _SHORT + 1 + count]


class RepeatFinder:
    """Tells of frames that come one after the other which repeat the one before, without a look at what follows, nor
    at more than `LOOKS_BACK` frames before."""

    LOOKS_BACK = _SHORT + 3

    def __init__(self) -> None:
        self._before: np.ndarray | None = None
        self._changes: list[float] = []

    def again(self, pixels: np.ndarray) -> bool:
        """Whether the next frame (H, W, 3), in [0, 1], repeats the one before."""
        grey = cv2.cvtColor(np.rint(255 * pixels).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        thumb = cv2.resize(grey, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
        change = np.inf if self._before is None else _mean(cv2.absdiff(thumb, self._before))
        self._before = thumb
        self._changes = [*self._changes[-_SHORT - 1 :], change]
        return bool(repeats(np.array(self._changes))[-1])


def _run_lengths(which: np.ndarray) -> np.ndarray:
    """(n,) the length of the run of True that each True of `which` (n,) is in; 0 of False."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], which.astype(int), [0]])))
    lengths = np.zeros(len(which), int)
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        lengths[start:end] = end - start
    return lengths


def combed(measures: Measures) -> tuple[int, int]:
    """How many of the frames that move are interlaced, and how many move. Where nothing moves it cannot be seen, and
    does no harm."""
    moving = measures.readable & np.isfinite(measures.change) & (measures.change > _MOVING)
    return int((measures.combing[moving] > COMBED).sum()), int(moving.sum())


class Meter:
    """Measures frames (H, W, 3) one after the other, over a mask (H, W) that is the same for all."""

    def __init__(self, mask: np.ndarray):
        height, width = mask.shape
        self._size = (min(width, COLUMNS), max(1, round(height * min(width, COLUMNS) / width)))
        share = cv2.resize(mask.astype(np.float32), self._size, interpolation=cv2.INTER_AREA)
        self._mask = (share > 0.999).astype(np.uint8)
        self._pixels = int(self._mask.sum())
        self._inner = cv2.erode(np.pad(self._mask, 1), np.ones((5, 5), np.uint8), borderValue=1)[1:-1, 1:-1].copy()
        self._step = max(1, width // 160)
        stripes = mask[:, :: self._step]
        self._rows_of_three = (stripes[:-2] & stripes[1:-1] & stripes[2:]).astype(np.uint8)
        self._before: np.ndarray | None = None
        self._found: list[list[float]] = []

    def unreadable(self) -> None:
        self._found.append([np.nan] * 9)
        self._before = None

    def add(self, pixels: np.ndarray) -> None:
        if not self._pixels:
            self.unreadable()
            return
        pixels = eight_bits(pixels)
        small = cv2.resize(pixels, self._size, interpolation=cv2.INTER_AREA)
        channels = cv2.split(small)
        top = cv2.max(cv2.max(channels[0], channels[1]), channels[2])
        low = cv2.min(cv2.min(channels[0], channels[1]), channels[2])
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        # Highlights are the sharpest edges of a blurred frame too.
        detail = cv2.Laplacian(np.minimum(grey, 220), cv2.CV_32F, ksize=3)
        thumb = cv2.resize(grey, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
        change = np.inf if self._before is None else _mean(cv2.absdiff(thumb, self._before))
        self._before = thumb
        brightness = _mean(top, self._mask)
        self._found.append(
            [
                brightness,
                _mean(cv2.inRange(low, WHITE, 255), self._mask) / 255,
                _mean(cv2.inRange(top, 0, BLACK - 1), self._mask) / 255,
                float(cv2.meanStdDev(detail, mask=self._inner)[1][0, 0]) / max(brightness, 1.0),
                change,
                self._combing(pixels),
                *(_mean(channel, self._mask) for channel in channels),
            ]
        )

    def _combing(self, pixels: np.ndarray) -> float:
        if not self._rows_of_three.any():
            return 1.0
        rows = np.ascontiguousarray(pixels[:, :: self._step, 1])
        next_row = cv2.absdiff(rows[1:], rows[:-1])
        neighbours = _mean(next_row[:-1], self._rows_of_three) + _mean(next_row[1:], self._rows_of_three)
        return (neighbours + 0.5) / (2 * _mean(cv2.absdiff(rows[2:], rows[:-2]), self._rows_of_three) + 0.5)

    def __len__(self) -> int:
        return len(self._found)

    def since(self, count: int) -> dict[str, np.ndarray]:
        """What came after so many frames, as arrays that `go_on` takes."""
        found = np.array(self._found[count:], np.float64).reshape(-1, 9)
        return {"measures": found} | ({} if self._before is None else {"before": self._before})

    def go_on(self, since: Mapping[str, np.ndarray]) -> None:
        """Takes what another meter of the same mask has found."""
        self._found += since["measures"].tolist()
        self._before = since.get("before")

    def result(self) -> Measures:
        return Measures(*np.array(self._found, np.float64).reshape(-1, 9).T)


def eight_bits(pixels: np.ndarray) -> np.ndarray:
    return (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels


def one_field(pixels: np.ndarray) -> np.ndarray:
    """The picture of the even rows alone: each odd row is the mean of the rows beside it. Every row stays in its place,
    so the camera remains right."""
    kept = pixels.copy()
    last = len(pixels) - len(pixels) % 2 - 1
    above, below = pixels[0 : last - 1 : 2], pixels[2 : last + 1 : 2]
    kept[1 : 2 * len(below) : 2] = cv2.addWeighted(above[: len(below)], 0.5, below, 0.5, 0)
    if len(pixels) % 2 == 0:
        kept[-1] = pixels[-2]
    return kept


def _mean(channel: np.ndarray, mask: np.ndarray | None = None) -> float:
    return float(cv2.mean(channel, mask=mask)[0])
