"""What a dry run finds out: whether the real one could begin, what it would do, and about how long that takes.

Times are measured on the spot where that is quick (a model on a frame), and taken from a table where it is not: seconds
of the table's machine, times how much slower than it this one is now.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from lightdepth.command_line.dry import Planned, Step
from lightdepth.counting import counted
from lightdepth.errors import InputError
from lightdepth.files.lock import check_free
from lightdepth.files.replacing import check_ours, old_path, unfinished_path

if TYPE_CHECKING:
    from lightdepth.frame import Frame

Work = Callable[[], Sequence[Step]]
"""Gives the steps of the work that comes next; called in a dry run alone."""

_YARDSTICK = 0.0124
"""Seconds of `_yardstick` on the machine of the tables (one core of an AMD EPYC with AVX-512)."""


class Plan:
    """What a run into an output would do. `parts` of it are finished; `again` says that it goes on in its place."""

    def __init__(self, output: Path, parts: int = 0, again: str = "") -> None:
        self._output = output
        there = output.is_dir() and any(output.iterdir()) and not again
        how = ", in place of the run that is there" if there else ""
        how += f", {again}" if again else f", going on from {counted(parts, 'finished part')}" if parts else ""
        self._made = f"would make {output}{how}"

    def ends(self, what: str, work: Work) -> NoReturn:
        """Here the work would begin."""
        raise Planned([f"dry run: {what}", self._made], work(), str(self._output))


@contextmanager
def untouched(output: Path) -> Iterator[None]:
    """In the place of what makes the folders of an output and locks it: raises what that would, and makes nothing."""
    check_free(output)
    for hidden in (unfinished_path(output), old_path(output)):
        check_ours(hidden, output)
    existing = next(folder for folder in output.parents if os.path.lexists(folder))
    if not existing.is_dir():
        number = errno.EEXIST if existing == output.parent else errno.ENOTDIR
        raise OSError(number, os.strerror(number), str(existing))
    if not os.access(existing, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(existing))
    yield


def timed(work: Callable[[], object]) -> float:
    """Seconds that work takes: the mean of two times after a first one, at which much is set up."""
    work()
    start = time.perf_counter()
    for _ in range(2):
        work()
    return (time.perf_counter() - start) / 2


def seconds_each(frames: Sequence[Frame], work: Callable[[Frame], object]) -> float | None:
    """Seconds that it takes to read a frame and do the work on it; None where the first few cannot be read."""
    for row in range(min(len(frames), 5)):
        with suppress(InputError):
            return timed(lambda row=row: work(frames[row]))  # type: ignore[misc]
    return None


def times(count: int, seconds: float | None) -> float | None:
    """Of so many; None where it is not known of one."""
    return None if seconds is None else count * seconds


@cache
def slowness() -> float:
    """How many times slower this machine is now than the one of the tables."""
    return timed(_yardstick) / _YARDSTICK


def _yardstick() -> None:
    """Work of the kind that takes the time elsewhere: smoothing, sorting, copying."""
    import cv2
    import numpy as np

    values = np.linspace(0, 40, 256 * 320, dtype=np.float32).reshape(256, 320)
    values = np.sin(values) * np.cos(3 * values)
    for _ in range(20):
        values = cv2.GaussianBlur(values, (0, 0), 3) + 0.1 * values
        np.sort(values.ravel()[::7])
        values = values[::-1, ::-1].copy()
