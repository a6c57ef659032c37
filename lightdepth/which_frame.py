"""Which frame is this: by name, number, time, folder; and which frame a time falls on.

A map's keyframes, a trajectory's poses and the frames of a folder or video meet by number. A name gives it, or a time
does: by the frames' own stamps, or counted at a rate, on a clock that may begin elsewhere (`time_offset`).
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from lightdepth.errors import InputError

MAX_FRAME = 10**8
"""A month of video; a time of day in seconds or nanoseconds lies above."""
_LATEST = 9e12
"""Seconds whose microseconds are a number of 63 bits still."""
_FOREIGN = 1e7  # seconds, from which times count from no video's beginning
_BETWEEN, _ON_STAMP = 0.1, 0.05
"""Parts of a frame: from the first on, times fall between frames (median); up to the second, on a stamp (all)."""
_SUFFIX = re.compile(r"\.[A-Za-z]\w*$")
# A decimal number is a time where a unit says so, where it is all of the name or follows a separator, or where it
# counts from 1970; `shot1.0001` and `shot_01.0001` are counters behind a point, `frame_0.0333` is none.
_SECONDS = re.compile(r"(\d+\.\d+)_?(?:s|sec)$", re.IGNORECASE)
_TIME = re.compile(r"(?:^|[_\-= ]|(?:^|[^a-z])t)(\d+\.\d+)$", re.IGNORECASE)
_OF_A_FRAME = re.compile(
    r"(?:^|[^a-z])(?:f|(?:key)?frames?|frm|kf|im|img|images?|pics?|t|ts|times?|(?:time)?stamps?|sec|seconds?)[_\-= ]*$",
    re.IGNORECASE,
)
_MICROSECOND = 1e-6
_UNITS = {13: 1e-3, 16: 1e-6, 19: 1e-9}  # digits of a time since 1970, and what one of it is in seconds


@dataclass(frozen=True)
class WhichFrame:
    """A frame as its name tells it: `number` is unique in a folder, `time` [s] is None where the name is none, and
    `folder` is what stands before the file's name, "" for nothing."""

    name: str
    number: int
    time: float | None = None
    folder: str = ""

    @classmethod
    def named(cls, name: str) -> WhichFrame:
        """Of a file's name, with or without folders. The number is the last run of digits in the stem; a name that is
        a time, such as `frame_00.03s` or `1403636579.763555`, has its microseconds as number. Raises InputError where
        there is no digit."""
        folder, _, last = name.replace("\\", "/").rpartition("/")
        stem = _SUFFIX.sub("", last)
        time = _time_in(stem)
        if time is not None and time > _LATEST:
            raise InputError(name[:80], f"a time of {time:.3g} s in the name", f"expected at most {_LATEST:g} s")
        if time is not None:
            return cls(name, round(time / _MICROSECOND), time, folder)
        digits = re.findall(r"\d+", stem)
        if not digits:
            raise InputError(
                name or "''", "no number in the name", "frames are matched with map entries by the integer in it"
            )
        significant = digits[-1].lstrip("0")
        if len(significant) > 18 and (len(significant) > 19 or int(significant) >= 2**63):
            found = f"a number of {len(digits[-1])} digits in the name"
            raise InputError(name if len(name) <= 80 else f"{name[:80]}...", found, "expected one below 2^63")
        unit = _UNITS.get(len(digits[-1])) if digits[-1][0] in "12" else None
        return cls(name, int(digits[-1]), None if unit is None else unit * int(digits[-1]), folder)


def _time_in(stem: str) -> float | None:
    """The time [s] that the end of a stem is; None where it is something else."""
    found = _SECONDS.search(stem)
    if found is not None:
        return float(found[1])
    found = _TIME.search(stem)
    if found is None:
        return None
    whole, _, part = found[1].partition(".")
    padded = part[0] == "0" or (whole[0] == "0" and len(whole) > 1)  # shot_01.0001, shot_01.1000
    counter = len(part) in (4, 5) and padded and found.start(1) > 0 and len(whole) < 9
    return None if counter and not _OF_A_FRAME.search(stem[: found.start(1)]) else float(found[1])


def frame_number(name: str) -> int:
    """The integer by which a frame and a map's keyframe meet: the last run of digits in the file's stem.

    C3VD's `0012_color` and `12_color` are both 12; `frame_00.03s`, a time, is 30000 microseconds. Raises InputError
    when there is none.
    """
    return WhichFrame.named(name).number


@dataclass(frozen=True, eq=False)
class Stamps:
    """The frames that there are, looked up when they are asked for, without reading one; `folder` is where they lie."""

    load: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    """gives numbers (n,) and, where they are known, times (n,) [s]"""
    folder: str = ""

    @cached_property
    def _loaded(self) -> tuple[np.ndarray, np.ndarray | None]:
        return self.load()

    @property
    def numbers(self) -> np.ndarray:
        return self._loaded[0]

    @cached_property
    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers and times in the order of time; empty where no times are known."""
        numbers, times = self._loaded
        if times is None or len(times) < 2 or not np.isfinite(times).all():
            return np.zeros(0, int), np.zeros(0)
        order = np.argsort(times, kind="stable")
        return numbers[order], times[order]

    @property
    def numbered_by_time(self) -> bool:
        """Whether the frames' numbers are their times, in a unit that names have, and count nothing."""
        numbers, times = self.known
        units = (_MICROSECOND, *_UNITS.values())
        return bool(times.any()) and any(np.abs(numbers * unit - times).max() < _MICROSECOND for unit in units)

    @property
    def step(self) -> float:
        """Usual time from a frame to the next [s]."""
        return float(np.median(np.diff(self.known[1])))

    def nearest(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n,) of the frames nearest to times (n,), and how far off [s] these are (n,)."""
        numbers, stamps = self.known
        after = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
        rows = np.where(times - stamps[after - 1] < stamps[after] - times, after - 1, after)
        return numbers[rows], np.abs(stamps[rows] - times)


@dataclass(frozen=True)
class Clock:
    """How the times of a map's keyframes, or of a trajectory, become frame numbers."""

    fps: float | None = None
    """Frames per second by which times are counted; None where the frames' own stamps tell."""
    time_offset: float | None = None
    """What the clock shows at the time 0 of the frames, seconds; None where it has to be found."""
    time_tolerance: float | None = None
    """How far a time may be from the stamp of its frame, seconds; None is half a frame."""
    frames: Stamps | None = None
    """The frames, where they are known."""

    def names(self, times: np.ndarray, where: Path | str, begun: tuple[float, str] | None = None) -> list[str]:
        """Names of the frames that times (n,) fall on, six digits each; integers with nothing that says how to count
        are numbers themselves. `begun` is the first stamp of the clock that is known, and where it stands.

        Raises InputError when nothing says how to count, when a time falls on no frame, and when two fall on one.
        """
        times = np.asarray(times, np.float64)
        if self.fps is None and self.time_offset is None and (times == np.rint(times)).all():
            return _unique(self._counted(times, times, where), where)
        stamped = self.frames is not None and len(self.frames.known[0]) > 0
        if self.fps is None and not stamped:
            raise InputError(
                where,
                f"the time {times[times != np.rint(times)][0] if (times != np.rint(times)).any() else times[0]:g} is "
                "not a frame number",
                'give --map-fps, the frames per second of the video, or put {"fps": ...} into densify_map.json beside '
                "it, to count frames by time; or write frame numbers as times",
            )
        if stamped and (self._stamps_tell(times) or self._counts_nothing(times, where)):
            return self._by_stamp(times, where, begun)
        assert self.fps is not None
        offset = self._offset(times, where, begun, 0.0)
        return _unique(self._counted((times - offset) * self.fps, times, where), where)

    def guesses(self, times: np.ndarray) -> bool:
        """Whether `names` takes the first stamp for the first frame, because the times are of another clock."""
        times = np.asarray(times, np.float64)
        stamped = self.frames is not None and len(self.frames.known[0]) > 0
        if self.time_offset is not None or (self.fps is None and (not stamped or (times == np.rint(times)).all())):
            return False
        if stamped and self._stamps_tell(times):
            return self._no_frames_at(times)
        return bool(times.min() > _FOREIGN)

    def _no_frames_at(self, times: np.ndarray) -> bool:
        """Whether none of the times lies within those of the frames."""
        assert self.frames is not None
        first, last = self.frames.known[1][[0, -1]]
        return not ((times >= first - self._tolerance) & (times <= last + self._tolerance)).any()

    @property
    def _tolerance(self) -> float:
        assert self.frames is not None
        return self.time_tolerance if self.time_tolerance is not None else 0.5 * self.frames.step + 1e-6

    def _stamps_tell(self, times: np.ndarray) -> bool:
        """Whether stamps say more than a rate: where there is none, where the frames' numbers are times themselves and
        count nothing, and where both are of one clock of no video, such as Unix time."""
        assert self.frames is not None
        same_clock = self.frames.known[1][0] > _FOREIGN and times.min() > _FOREIGN and self.time_offset is None
        return bool(self.fps is None or same_clock or self.frames.numbered_by_time)

    def _counts_nothing(self, times: np.ndarray, where: Path | str) -> bool:
        """Whether times at the rate fall between frames, and on the frames' own stamps: those of a varying rate."""
        assert self.frames is not None and self.fps is not None
        shown = times - (self.time_offset or 0.0)
        between = np.abs(shown * self.fps - np.rint(shown * self.fps))
        if np.median(between) < _BETWEEN or (self.frames.nearest(shown)[1] > _ON_STAMP * self.frames.step).any():
            return False
        warnings.warn(
            f"{where}: times fall on the stamps of the frames, and between frames where they are counted at "
            f"{self.fps:g} a second: the stamps are used, as the frame rate varies",
            stacklevel=2,
        )
        return True

    def _counted(self, counted: np.ndarray, times: np.ndarray, where: Path | str) -> list[str]:
        numbers = np.rint(counted)
        if (numbers < 0).any() or (numbers > MAX_FRAME).any():
            odd = times[(numbers < 0) | (numbers > MAX_FRAME)][0]
            raise InputError(
                where,
                f"the time {odd:g} falls on no frame",
                "expected seconds since the first frame of the video (with --map-fps, or fps in densify_map.json), or "
                "on another clock with --time-offset, or frame numbers; not nanoseconds",
            )
        return [f"{number:06.0f}.png" for number in numbers]

    def _by_stamp(self, times: np.ndarray, where: Path | str, begun: tuple[float, str] | None) -> list[str]:
        assert self.frames is not None
        tolerance = self._tolerance
        offset = self._offset(times, where, begun, float(self.frames.known[1][0]))
        numbers, off = self.frames.nearest(times - offset)
        near = off <= tolerance
        if 2 * near.sum() < len(times):
            raise InputError(
                where,
                f"{len(times) - near.sum()} of {len(times)} times are more than {tolerance:.3g} s from the stamp of "
                "any frame",
                "give --time-offset, what the map's clock shows at the time 0 of the frames, or a larger "
                "--time-tolerance",
            )
        # One without a frame is named by its time: no frame has that number, so it is missed as others are.
        found = zip(numbers.tolist(), near.tolist(), (times - offset).tolist(), strict=True)
        return _unique([f"{n:06d}.png" if ok else f"{abs(t):.6f}s.png" for n, ok, t in found], where)

    def _offset(self, times: np.ndarray, where: Path | str, begun: tuple[float, str] | None, first: float) -> float:
        """What the clock shows at the time 0 of the frames, the first of which is at `first`; said where it is
        found."""
        if not self.guesses(times):
            return self.time_offset or 0.0
        stamp, of = begun if begun is not None and begun[0] <= times.min() else (float(times.min()), "the map")
        warnings.warn(
            f"{where}: times are of another clock than the frames' (they begin at {stamp:.3f} s): the first stamp of "
            f"{of} is taken for the first frame. Where tracking began later and the images do not tell, say what the "
            f"clock shows at the time 0 of the frames: --time-offset, here {stamp - first:.3f}",
            stacklevel=2,
        )
        return stamp - first


def _unique(names: list[str], where: Path | str) -> list[str]:
    found, counts = np.unique(names, return_counts=True)
    if len(found) < len(names):
        raise InputError(
            where,
            f"{counts.max()} keyframes fall on frame {frame_number(str(found[counts.argmax()]))}",
            "is fps in densify_map.json too low?",
        )
    return names
