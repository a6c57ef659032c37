"""Progress that reads well on a terminal and in a log file alike."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any, TypeVar

from lightdepth.command_line.heartbeat import SECONDS, at_work, duration, is_counted
from lightdepth.command_line.outcome import is_quiet

Thing = TypeVar("Thing")
_LEAST_SECONDS, _LEAST_STEPS, _LEAST_SHARE = 3.0, 2, 0.05
"""What an estimate of the time left has to rest on, after the first step."""


class Progress:
    """`with Progress("Rendering", 40) as bar: ... bar.advance()`.

    On a terminal a rich bar; elsewhere a line at most every ten seconds, with the rate and the time left by recent
    steps as soon as these tell them, and one at the end. The first step, in which much is set up and compiled, tells
    nothing. A step that takes longer than ten seconds is told of by the heartbeat of the verb. Nothing is said with
    --quiet.
    """

    _shown = False
    """whether the bar of any is on the terminal"""

    def __init__(self, label: str, total: int, interval: float = SECONDS):
        self.label, self.total, self.done = label, total, 0
        self._interval = interval
        self._bar: Any = None
        self._hidden = self._inner = False
        self._recent: deque[tuple[float, int]] = deque(maxlen=2 + max(5, round(0.3 * total)))  # when, and how many then
        self._ending = ExitStack()

    def __enter__(self) -> Progress:
        self._start = self._last = self._since = time.monotonic()
        self._err = sys.stderr
        self._hidden = is_quiet() or Progress._shown  # a bar inside another one would take its place
        if self._err.isatty() and not self._hidden:
            Progress._shown = True
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress

            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._bar = RichProgress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self.label, total=self.total)
        self._inner = is_counted()
        self._ending.enter_context(at_work(self._state))
        return self

    def advance(self, count: int = 1) -> None:
        self.reach(self.done + count)

    def reach(self, done: int) -> None:
        """So many are done by now."""
        now = time.monotonic()
        self.done, self._since = done, now
        self._recent.append((now, done))
        if self._bar is not None:
            self._bar.update(self._task, completed=self.done)
        elif now - self._last >= self._interval:
            self._last = now
            self._say(f"{self.label}: {self.done}/{self.total}{self._left()}")

    def _say(self, line: str) -> None:
        if not self._hidden:
            print(line, file=self._err, flush=True)

    def _state(self, now: float) -> str:
        """For a silence: the step that takes so long. The next line of its own has time from then on."""
        if self._bar is not None or self._hidden:
            return ""
        self._last = now
        waited = now - self._since
        at_it = f", {duration(waited)} into the next" if self.done < self.total and waited >= 1 else ""
        return f"{self.label}: {self.done}/{self.total}{at_it}{self._left(waited)}"

    def _left(self, waited: float = 0.0) -> str:
        """The rate and the time left, in words; empty where they are not known, or where the step at work has lasted
        for longer than all was to take."""
        if not self._recent:
            return ""
        (since, before), (now, done) = self._recent[0], self._recent[-1]
        if now - since < _LEAST_SECONDS or done - before < max(_LEAST_STEPS, _LEAST_SHARE * self.total):
            return ""
        each = (now - since) / (done - before)
        if waited > (left := each * (self.total - done)):
            return ""
        rate = f"{1 / each:.3g} a second" if each < 1 else f"{each:.3g} s each"
        return f", {rate}, about {duration(left)} left"

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.close()
        if self._bar is not None:
            self._bar.stop()
            Progress._shown = False
        if kind is None and not self._inner:  # the end of a part is no news
            self._say(f"{self.label}: {self.done} in {time.monotonic() - self._start:.1f} s")


def counted_through(things: Sequence[Thing], label: str) -> Iterator[Thing]:
    """The things one after the other, with their progress."""
    with Progress(label, len(things)) as bar:
        for thing in things:
            yield thing
            bar.advance()


class Stages:
    """Work of several stages, each counted: `with Stages("Sparse map") as told: ... told("features", 3, 40)`."""

    def __init__(self, label: str):
        self._label, self._stage = label, ""
        self._bar: Progress | None = None

    def __enter__(self) -> Stages:
        return self

    def __call__(self, stage: str, done: int, count: int) -> None:
        if stage != self._stage or self._bar is None or self._bar.total != count:
            self._end(None)
            self._stage, self._bar = stage, Progress(f"{self._label}: {stage}", count)
            self._bar.__enter__()
        if done > self._bar.done:
            self._bar.reach(done)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end(kind, error, trace)

    def _end(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None = None,
        trace: TracebackType | None = None,
    ) -> None:
        if self._bar is not None:
            self._bar.__exit__(kind, error, trace)
            self._bar = None
