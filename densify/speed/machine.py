"""What this machine does at best, by two plain calls of a library: a copy of a large array, a product of matrices.

A stage that moves B bytes and does N operations cannot take less than its floor, max(B / bandwidth, N / rate), but for
what fits into the processor's caches, where it moves faster than the copy does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import cv2
import numba
import numpy as np
import torch

Kind = Literal["float32", "bfloat16", "float64", "comparison"]
_MULTIPLIED: Mapping[Kind, torch.dtype] = {
    "float32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float64": torch.float64,
}
_COPIED, _SIDE, _SORTED, _ROUNDS = 2**26, 2048, 2**20, 5
_LEAST, _MOST = 3, 99
"""Rounds of a timing."""


@dataclass(frozen=True)
class Load:
    """What a stage has to do, however it is written."""

    operations: Mapping[Kind, float] = field(default_factory=dict)
    """additions, multiplications and the like, by the kind of number; a root, a logarithm or a division counts as one.
    Comparisons are those of a sort"""
    bytes: float = 0.0
    """of what is read, once, and of what is written, once"""

    @property
    def total(self) -> float:
        """Operations of all kinds."""
        return sum(self.operations.values())


@dataclass(frozen=True)
class Rates:
    """What is done in a second."""

    bandwidth: float
    """bytes read and written, by a copy"""
    operations: Mapping[Kind, float]
    """by products of matrices (2 n^3 each), and comparisons by a sort"""

    def floor(self, load: Load) -> float:
        """Seconds that a load takes at the least."""
        done = sum(count / self.operations[kind] for kind, count in load.operations.items())
        return max(load.bytes / self.bandwidth, done)


@dataclass(frozen=True)
class Machine:
    """What a machine does at best."""

    device: str
    """what PyTorch calls it"""
    threads: int
    """with which copy and products were taken; a sort has one"""
    clock: Rates
    """in a second of the clock"""
    core: Rates
    """in a second of a processor's core: what other work on the machine hardly changes"""


@dataclass(frozen=True)
class Taken:
    """Seconds that a piece of work took."""

    clock: float
    core: float
    """of all cores together"""


def comparisons(count: int) -> float:
    """Comparisons that no sort of so many can do without: the logarithm of the number of their orders, to base 2."""
    return math.lgamma(count + 1) / math.log(2)


def machines_of(device: torch.device) -> list[Machine]:
    """The processor, and the device of the model where that is another."""
    return [measured_machine(each) for each in dict.fromkeys((torch.device("cpu"), device))]


def threads() -> Mapping[str, int]:
    """Threads of what stages are made of."""
    return {
        "PyTorch": torch.get_num_threads(),
        "OpenCV": cv2.getNumThreads(),
        "compiled loops": min(2, numba.config.NUMBA_NUM_THREADS),  # type: ignore[attr-defined]  # set at run time
    }


def measured_machine(device: torch.device, copied: int = _COPIED, side: int = _SIDE) -> Machine:
    """The machine as it is now, with as many threads as any stage has: a copy of so many float32, products of square
    matrices of that side, and a sort of a million float64 on the processor."""
    before, most = torch.get_num_threads(), max(threads().values())
    torch.set_num_threads(most)
    try:
        source = torch.ones(copied, device=device)
        copy = least(partial(torch.empty_like(source).copy_, source), device)
        products: dict[Kind, Taken] = {}
        for kind, number in _MULTIPLIED.items():
            square = torch.rand(side, side, device=device).to(number)
            products[kind] = least(partial(torch.matmul, square, square), device)
    finally:
        torch.set_num_threads(before)
    sort = least(partial(np.sort, np.random.default_rng(0).random(_SORTED)), device)

    def rates(of: Callable[[Taken], float]) -> Rates:
        operations = {kind: 2 * side**3 / of(taken) for kind, taken in products.items()}
        return Rates(2 * source.nbytes / of(copy), {**operations, "comparison": comparisons(_SORTED) / of(sort)})

    return Machine(str(device), most, rates(lambda taken: taken.clock), rates(lambda taken: taken.core))


def least(work: Callable[[], object], device: torch.device) -> Taken:
    """What work takes, each the least of some times after a first one."""
    (taken,) = side_by_side([work], 0.0, device, _ROUNDS)
    return Taken(min(each.clock for each in taken), min(each.core for each in taken))


def side_by_side(
    works: Sequence[Callable[[], object]], seconds: float, device: torch.device, rounds: int = _LEAST
) -> list[list[Taken]]:
    """What each work took, each time: after a first time, which is not counted, as often as `seconds` have room for
    all, and at least `rounds` times. They take turns, so that a busy machine slows them alike."""
    for work in works:
        _timed(work, device)
    taken: list[list[Taken]] = [[] for _ in works]
    end = time.perf_counter() + seconds
    while len(taken[0]) < rounds or (time.perf_counter() < end and len(taken[0]) < _MOST):
        for work, times in zip(works, taken, strict=True):
            times.append(_timed(work, device))
    return taken


def _timed(work: Callable[[], object], device: torch.device) -> Taken:
    _settle(device)
    clock, core = time.perf_counter(), time.process_time()
    work()
    _settle(device)
    return Taken(time.perf_counter() - clock, max(time.process_time() - core, 1e-9))


def _settle(device: torch.device) -> None:
    """Waits for what a GPU is still at."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
