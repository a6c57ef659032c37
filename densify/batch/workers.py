"""Processes that work side by side, each through one task after the other, with so many threads and no more.

What a process needs it makes once, at its start. One that dies over a task (a library that crashes, the system that is
out of memory) loses this task alone: it is told, and another process takes its place. When we die ourselves, however,
they see it and end.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from typing import Any, Generic, TypeVar

from lightdepth.command_line.own_process import set_own_process
from lightdepth.errors import Interrupted
from lightdepth.signals import ending_on_signals, finishing_first

Task = TypeVar("Task")
Result = TypeVar("Result")

COUNTED = ("OMP", "MKL", "OPENBLAS", "NUMEXPR", "NUMBA")
"""Libraries that take their number of threads from the environment, when they are loaded."""
_GRACE_S = 20.0
"""How long a process has to put down its task before it is killed."""


@dataclass(frozen=True)
class Lost:
    """A process died over a task."""

    code: int | None
    """As multiprocessing has it: minus the number of the signal that killed it."""

    def __str__(self) -> str:
        if self.code is None or self.code >= 0:
            return f"its process ended with {self.code}"
        name = signal.Signals(-self.code).name if -self.code in set(signal.Signals) else f"signal {-self.code}"
        hint = ", as the system does when memory runs out" if -self.code == signal.SIGKILL else ""
        return f"its process was killed by {name}{hint}"


@dataclass
class _Hand(Generic[Task]):
    """A process, what we talk to it by, and what it is at."""

    process: Any
    line: Any
    task: Task | None = None


def worked(
    tasks: Iterable[Task], start: Callable[[], Callable[[Task], Result]], jobs: int, threads: int = 1
) -> Iterator[tuple[Task, Result | Lost]]:
    """Each task with what came of it, in the order in which they end; `jobs` of them are at work at once. `start`,
    pickled as tasks and results are, gives what does a task, in its process. No process outlives the loop."""
    waiting, hands = deque(tasks), list[_Hand[Task]]()
    try:
        while waiting or any(hand.task is not None for hand in hands):
            for hand in hands:
                if hand.task is None and waiting:
                    _give(hand, waiting.popleft())
            while waiting and len(hands) < jobs:
                hands.append(_started(start, threads))
                _give(hands[-1], waiting.popleft())
            busy = {hand.line: hand for hand in hands if hand.task is not None}
            for line in connection.wait(list(busy)):
                hand = busy[line]
                task, result = _taken(hand)
                if isinstance(result, Lost):
                    hands.remove(hand)
                yield task, result
    finally:
        with finishing_first():
            _end(hands)


def _started(start: Callable[[], Callable[[Task], Result]], threads: int) -> _Hand[Task]:
    context = get_context("spawn")  # a copy of a process with threads may hang
    ours, theirs = context.Pipe()
    process = context.Process(target=_be_one, args=(start, theirs, threads), daemon=True)
    with counted_threads(threads):
        process.start()
    theirs.close()
    return _Hand(process, ours)


def _give(hand: _Hand[Task], task: Task) -> None:
    hand.task = task
    with suppress(OSError):  # of a dead one: the end of the line says so when we listen
        hand.line.send(task)


def _taken(hand: _Hand[Task]) -> tuple[Task, Any]:
    task, hand.task = hand.task, None
    assert task is not None
    try:
        return task, hand.line.recv()
    except (EOFError, OSError):
        hand.process.join(_GRACE_S)
        hand.line.close()
        return task, Lost(hand.process.exitcode)


def _end(hands: Iterable[_Hand[Any]]) -> None:
    """Those that are at work get a signal and time to put it down; the others hear the end of the line."""
    for hand in hands:
        if hand.task is not None:
            hand.process.terminate()
        hand.line.close()
    for hand in hands:
        hand.process.join(_GRACE_S)
        if hand.process.is_alive():
            hand.process.kill()
            hand.process.join()


def _be_one(start: Callable[[], Callable[[Any], Any]], line: Any, threads: int) -> None:
    """The life of a process."""
    set_own_process()
    threading.Thread(target=_die_with_parent, daemon=True).start()
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)  # libraries that write there themselves
    os.dup2(quiet, 2)
    try:
        with ending_on_signals(), pinned_threads(threads):
            work = start()
            while True:
                line.send(work(line.recv()))
    except EOFError:
        return
    except Interrupted as error:
        sys.exit(128 + error.signal)


def _die_with_parent() -> None:
    """Nobody would want what is still made: the same is done again by whoever goes on."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


@contextmanager
def counted_threads(threads: int) -> Iterator[None]:
    """Within it, processes that are started have so many threads."""
    wanted = {f"{library}_NUM_THREADS": str(threads) for library in COUNTED} | {"OMP_WAIT_POLICY": "passive"}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def pinned_threads(threads: int) -> Iterator[None]:
    """Within it this process has so many threads, of the libraries that can be told so after they were loaded."""
    import cv2
    import torch

    before = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])
