"""Progress that reads well on a terminal and in a log file alike."""

from __future__ import annotations

import sys
import time
from collections import deque
from types import TracebackType
from typing import Any

_LEAST_SECONDS, _LEAST_STEPS, _LEAST_SHARE = 3.0, 2, 0.05
"""What an estimate of the time left has to rest on, after the first step."""


class Progress:
    """`with Progress("Rendering", 40) as bar: ... bar.advance()`.

    On a terminal a rich bar; elsewhere a line at most every ten seconds, with the time left by recent steps as soon as
    these tell it, and one at the end. The first step, in which much is set up and compiled, tells nothing.
    """

    def __init__(self, label: str, total: int, interval: float = 10.0):
        self.label, self.total, self.done = label, total, 0
        self._interval = interval
        self._bar: Any = None
        self._recent: deque[tuple[float, int]] = deque(maxlen=2 + max(5, round(0.3 * total)))  # when, and how many then

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
        self._recent.append((now, self.done))
        if self._bar is not None:
            self._bar.update(self._task, completed=self.done)
        elif now - self._last >= self._interval:
            self._last = now
            print(f"{self.label}: {self.done}/{self.total}{self._left()}", file=sys.stderr, flush=True)

    def _left(self) -> str:
        """The time left, in words; empty where it cannot be told yet."""
        (since, before), (now, done) = self._recent[0], self._recent[-1]
        if now - since < _LEAST_SECONDS or done - before < max(_LEAST_STEPS, _LEAST_SHARE * self.total):
            return ""
        return f", about {(now - since) / (done - before) * (self.total - done):.0f} s left"

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        if kind is None:
            taken = time.monotonic() - self._start
            print(f"{self.label}: {self.done} in {taken:.1f} s", file=sys.stderr, flush=True)
