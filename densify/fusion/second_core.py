"""A second core, where there is one, for what has the interpreter's lock released: compiled loops, images in and out.

Nothing here changes a result: what runs side by side writes to different places. More than two were not worth it: a
keyframe's loops take a few milliseconds each, and what lies between them is one thread's work. NUMBA_NUM_THREADS=1
keeps everything on one core.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TypeVar, TypeVarTuple, Unpack

import numba

Arguments = TypeVarTuple("Arguments")
R = TypeVar("R")


def later(function: Callable[[Unpack[Arguments]], R], *args: *Arguments) -> Future[R]:
    """Begins a piece of work in the background; on one core, does it. It may not itself ask for the second core."""
    helper = _helper()
    if helper is not None:
        return helper.submit(function, *args)
    done: Future[R] = Future()
    done.set_result(function(*args))
    return done


def halves(function: Callable[[int, int], object], count: int) -> None:
    """function(first, end) for range(count), half of it here and half in the background. Raises what they raise."""
    helper = _helper()
    if helper is None:
        function(0, count)
        return
    other = helper.submit(function, count // 2, count)
    try:
        function(0, count // 2)
    finally:
        other.result()


@cache
def _helper() -> ThreadPoolExecutor | None:
    threads = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # set at run time
    return ThreadPoolExecutor(1, "second core") if threads > 1 else None


if hasattr(os, "register_at_fork"):  # a thread does not come along into a forked process
    os.register_at_fork(after_in_child=_helper.cache_clear)
