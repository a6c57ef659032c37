"""Progress that reads well on a terminal and in a log file alike."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any


class Progress:
    """`with Progress("Rendering", 40) as bar: ... bar.advance()`.

    On a terminal a rich bar; elsewhere a line at most every ten seconds, and one at the end, with rate and time left.
    """

    def __init__(self, label: str, total: int, interval: float = 10.0):
        self.label, self.total, self.done = label, total, 0
        self._interval = interval
        self._bar: Any = None

    def __enter__(self) -> Progress:
        self._start = self._last = time.monotonic()
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress

            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._bar = RichProgress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self.label, total=self.total)
        return self

    def advance(self, count: int = 1) -> None:
        self.done += count
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._task, completed=self.done)
        elif now - self._last >= self._interval:
            self._last = now
            left = (now - self._start) / self.done * (self.total - self.done)
            print(f"{self.label}: {self.done}/{self.total}, about {left:.0f} s left", file=sys.stderr, flush=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        if kind is None:
            taken = time.monotonic() - self._start
            print(f"{self.label}: {self.done} in {taken:.1f} s", file=sys.stderr, flush=True)
