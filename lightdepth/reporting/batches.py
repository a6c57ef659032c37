"""Work on many things in a row, of which each few seconds' worth is a finished part of a run.

    for batch in batches(run, "frames", len(frames)):
        if batch.finished:
            ...  # what was made before: batch.kept, batch.arrays()
            continue
        for i in batch:
            batch.files.append(...)
        batch.finish(kept, {"name": array})

Where batches end depends on the machine's speed; what comes out of the run must not. So what is summed up over the
frames is kept batch by batch, as it was before it was summed up.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.reporting.run import Run

SECONDS = 2.0
"""Work that makes a batch: bringing it to the disk takes some milliseconds a file, and a killed run loses no more."""


class Batch:
    """Things in a row, from `start` on; `end` is behind the last one."""

    def __init__(self, run: Run, work: str, start: int, count: int) -> None:
        self._run, self._count, self._part = run, count, f"{work} from {start}"
        self._arrays = run.state / f"{work} {start}.npz"
        self.start = self.end = start
        self.files: list[Path] = []
        self.kept: Any = None
        self.finished = run.done(self._part)
        if self.finished:
            self.end, self.kept = run.kept_of(self._part)

    def __len__(self) -> int:
        return self.end - self.start

    def __iter__(self) -> Iterator[int]:
        """The numbers of the things, until some seconds are over."""
        begun = time.monotonic()
        while self.end < self._count and (self.end == self.start or time.monotonic() - begun < SECONDS):
            self.end += 1
            yield self.end - 1

    def finish(self, kept: Any = None, arrays: Mapping[str, np.ndarray] | None = None) -> None:
        """All of them are done; what is kept (plain values, and arrays) is there when the run is resumed."""
        if arrays is not None and self._run.resumable:
            self._arrays.parent.mkdir(exist_ok=True)
            np.savez(self._arrays, **arrays)  # type: ignore[arg-type]  # numpy's own names of options are no arrays
            self.files.append(self._arrays)
        self._run.finish_part(self._part, self.files, [self.end, kept])

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that were kept of a finished batch."""
        with np.load(self._arrays, allow_pickle=False) as found:
            return dict(found)


def batches(run: Run, work: str, count: int) -> Iterator[Batch]:
    """Batches of `count` things, one after the other: those that are finished first."""
    start = 0
    while start < count:
        batch = Batch(run, work, start, count)
        yield batch
        start = batch.end
