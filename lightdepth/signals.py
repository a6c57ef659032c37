"""A signal ends a verb in order: what it was writing is finished or taken away, one line says so, exit code 128 + n.

Within `ending_on_signals` a signal raises `Interrupted` in the main thread, once: repeats tear no clean-up.
Where a step is to be finished first, `finishing_first` holds the signal back until the step asks for it.
"""

from __future__ import annotations

import os
import signal
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from lightdepth.errors import Interrupted

SIGNALS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
    if hasattr(signal, name)
)
"""What a terminal, a scheduler and a limit of time send to end a program in order."""
_INSISTED = 3
"""The interrupts from a keyboard, the first included, that end the program at once: somebody is there and waits."""
_TOGETHER_S = 2.0
"""Interrupts as near as this are one: a terminal and a program around ours both send it."""


@dataclass
class Received:
    """The signal that a `finishing_first` was sent, 0 for none."""

    signal: int = 0

    def stop(self, kept: str = "") -> None:
        """Raises Interrupted if there was a signal; `kept` says what is kept and how to go on."""
        if self.signal:
            _raise(self.signal, kept)

    def listen(self) -> None:
        """Sees to it that signals come here, where a library has put handlers of its own in the place of ours."""
        if _layer is not None and _layer.holding is self:
            for number in _layer.ours:
                signal.signal(number, _layer)


class _Layer:
    """The handler of all signals, of one process."""

    def __init__(self) -> None:
        self.process = os.getpid()
        self.holding: Received | None = None
        self.ours: list[signal.Signals] = []
        self.raised: weakref.ref[Interrupted] | None = None
        self._interrupts, self._last_interrupt = 0, -_TOGETHER_S

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self.process:
            _as_a_child(number)
            return
        if number == signal.SIGINT and time.monotonic() - self._last_interrupt >= _TOGETHER_S:
            self._interrupts, self._last_interrupt = self._interrupts + 1, time.monotonic()
        if self._interrupts >= _INSISTED:
            _die_of(number)
        if self.raised is not None and self.raised() is not None:
            return  # it is on its way: what cleans up is not torn
        if self.holding is not None:
            first = not self.holding.signal
            self.holding.signal = self.holding.signal or number
            if first or self._interrupts < 2:
                return
        # Where nothing holds the first one any more, something swallowed it (a destructor, a callback of C).
        _raise(number)


_layer: _Layer | None = None


@contextmanager
def ending_on_signals() -> Iterator[None]:
    """Within it SIGINT, SIGTERM, SIGHUP, SIGUSR1, SIGUSR2 and SIGXCPU raise Interrupted; before and after it, whatever
    they did. One that is ignored (`nohup`, a shell's background) stays so; in other threads nothing changes."""
    global _layer
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    outer, before = _layer, {number: signal.getsignal(number) for number in SIGNALS}
    _layer = layer = _Layer()
    layer.ours = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    try:
        for number in layer.ours:
            signal.signal(number, layer)
        yield
    finally:
        _layer = outer
        for number in layer.ours:
            signal.signal(number, before[number])


@contextmanager
def finishing_first() -> Iterator[Received]:
    """Within it a signal raises nothing: it stands in what is yielded, whose `stop` is called when a step is done.

    A second interrupt from the keyboard is not held back. One that nobody asked for raises at the end of the block.
    """
    layer, received = _layer, Received()
    if layer is None or layer.holding is not None or threading.current_thread() is not threading.main_thread():
        yield received
        return
    layer.holding = received
    try:
        yield received
    finally:
        layer.holding = None
    received.stop()


def _raise(number: int, kept: str = "") -> None:
    error = Interrupted(number, kept)
    if _layer is not None:
        _layer.raised = weakref.ref(error)
    try:
        raise error
    finally:
        del error  # the traceback would hold this frame, and the frame the error, after it is swallowed


def _as_a_child(number: int) -> None:
    """A forked process says nothing. Of a signal to the whole group its parent hears too, and ends it."""
    if number == signal.SIGTERM:  # may be the parent's word, who waits for its end
        _die_of(number)


def _die_of(number: int) -> None:
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
