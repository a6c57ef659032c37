"""A verb that is at work is never silent for longer than ten seconds: where nothing else was said, what it is at is.

Steps that are counted say how many are done and how long the rest takes (`reporting.progress`), but only when one ends;
others are not counted at all. So a thread looks now and then when something was said last. Where LIGHTDEPTH_HEARTBEAT
is `off` in the environment, it does not.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SECONDS = 10.0
"""The longest silence."""
_LOOKS = 0.5
"""Seconds between two looks."""
_SHOWN = 60
"""Characters of a line of the log that are enough to know it by."""

Activity = Callable[[float], str]
"""What is being done, in words, at a time of the monotonic clock; empty where a bar on the terminal shows it."""

_activities: list[Activity] = []


@contextmanager
def at_work(activity: Activity) -> Iterator[None]:
    """Within it a silence is ended with what `activity` says."""
    _activities.append(activity)
    try:
        yield
    finally:
        _activities.remove(activity)


def is_counted() -> bool:
    """Whether something at work says how far it is."""
    return bool(_activities)


_compiled_now: set[int] = set()
_REASON = " (it compiles loops, which are kept for the next runs on this machine)"


def compiles(loop: int, begins: bool) -> None:
    """Notes that machine code of a loop begins to be made, or that it is there; `loop` is any number of its own."""
    (_compiled_now.add if begins else _compiled_now.discard)(loop)


class Heartbeat:
    """Ends silences. `heard` gives when something was said last, `say` takes a line."""

    def __init__(self, verb: str, heard: Callable[[], float], say: Callable[[str], None]) -> None:
        self._start = time.monotonic()
        self._verb, self._heard, self._say = verb, heard, say
        self._stage, self._since = "", self._start
        self._begun, self._own = False, self._start  # whether the verb said anything itself; when this one spoke last
        self._reasoned = False

    def stage(self, said: str) -> None:
        """A line of the log: what is done from now on."""
        line = said.partition("\n")[0]
        self._stage = line if len(line) <= _SHOWN else f"{line[: _SHOWN - 3]}..."
        self._since = time.monotonic()

    def beat(self, now: float) -> None:
        """Says what is at work, where the silence would else be too long before the next look."""
        heard = self._heard()
        self._begun |= bool(_activities) or (heard > self._start and heard != self._own)
        if now - max(heard, self._start) < SECONDS - _LOOKS:
            return
        if not _activities:
            line = f"{self._verb}: {duration(now - self._start)} so far"
            if self._stage:
                line += f", {duration(now - self._since)} since: {self._stage}"
            elif not self._begun:
                line += ", still starting"
            if _compiled_now and not self._reasoned:
                line, self._reasoned = line + _REASON, True  # once
        else:
            line = _activities[-1](now)
        if line:
            self._say(line)
            self._own = self._heard()


@contextmanager
def beating(heart: Heartbeat) -> Iterator[None]:
    """Within it the heart looks every half a second, on a thread of its own."""
    if os.environ.get("LIGHTDEPTH_HEARTBEAT") == "off":
        yield
        return
    over = threading.Event()

    def look() -> None:
        while not over.wait(_LOOKS):
            heart.beat(time.monotonic())

    thread = threading.Thread(target=look, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def duration(seconds: float) -> str:
    """A time in words, as exactly as it matters."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
