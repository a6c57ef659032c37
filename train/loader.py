"""Batches of frames, loaded in this process or in workers."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, cast

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from lightdepth.errors import InputError, MachineFailure
from lightdepth.frame import FrameBatch
from lightdepth.photometry import LightTerms

_GRACE_S = 120.0
_KILLED = (
    "a process that reads frames was killed, as the system does where memory runs out (fewer processes, as by "
    "--data.num-workers 0, need less)"
)
_MOST_UNREAD = 20  # items one after another: no accident, but a mistake


@dataclass
class Waited:
    """Seconds for which a process has waited for its frames; where it reads them itself, all that this takes."""

    seconds: float = 0.0


def loader(
    dataset: Dataset[FrameBatch],
    batch_size: int,
    workers: int,
    left_out: Callable[[InputError], None],
    order: Sampler[int] | None = None,
    drop_last: bool = False,
    replacing: bool = True,
    waited: Waited | None = None,
) -> DataLoader[FrameBatch]:
    """Batches of a dataset whose items are batches of one, in an `order` or its own. `waited` grows with each of them.

    In the place of an item that cannot be read stands the next one that can, or, where not `replacing`, none: that
    batch is smaller. `left_out` is told of each, in this process. Raises, in this process too, InputError where a score
    of items after one another cannot be read, or none at all, and what the machine does wrong (OSError, MachineFailure,
    MemoryError)."""
    return _Loader(
        _Readable(dataset, replacing),
        left_out,
        waited or Waited(),
        sampler=order,
        drop_last=drop_last,
        batch_size=batch_size,
        num_workers=workers,
        persistent_workers=workers > 0,
        collate_fn=_collated,
        worker_init_fn=_outliving_a_signal,
    )


def collate(batches: Sequence[FrameBatch]) -> FrameBatch:
    """One batch out of batches."""
    columns = zip(*(batch[:3] + batch[4:] for batch in batches), strict=True)
    image, mask, rays, true_distance, true_valid = (torch.cat(column) for column in columns)
    light = LightTerms(*(torch.cat(column) for column in zip(*(batch.light for batch in batches), strict=True)))
    return FrameBatch(image, mask, rays, light, true_distance, true_valid)


class _Item(NamedTuple):
    """A batch, or none; what could not be read before it was found; what ends the loading. Values, since what is raised
    in a worker would come back as another exception."""

    batch: FrameBatch | None
    unread: tuple[InputError, ...] = ()
    failed: Exception | None = None


class _Readable(Dataset[_Item]):
    """The items of a dataset; in the place of one that cannot be read the next one that can, or none."""

    def __init__(self, dataset: Dataset[FrameBatch], replacing: bool) -> None:
        self.dataset, self.replacing = dataset, replacing

    def __len__(self) -> int:
        return len(cast(Sized, self.dataset))

    def __getitem__(self, index: int) -> _Item:
        unread: tuple[InputError, ...] = ()
        for row in range(index, index + (min(len(self), _MOST_UNREAD) if self.replacing else 1)):
            try:
                return _Item(self.dataset[row % len(self)], unread)
            except InputError as error:
                if isinstance(error.__cause__, MemoryError):  # the frame was good when there was room for it
                    return _Item(None, failed=MemoryError())
                if (folder := Path(error.where).parent) and not folder.exists():
                    return _Item(
                        None, failed=MachineFailure(f"{folder}: the folder that frames were read from is gone")
                    )
                unread += (error,)
            except (OSError, MachineFailure, MemoryError) as error:
                return _Item(None, failed=error)
        return _Item(None, unread, _none_of(unread) if self.replacing else None)


def _none_of(unread: Sequence[InputError]) -> InputError:
    first, last = unread[0], unread[-1]
    if first is last:
        return first
    found = f"{first.found}, and none of the {len(unread) - 1} frames behind it can be read, up to {last.where}"
    return InputError(first.where, found, first.cure)


def _collated(items: Sequence[_Item]) -> _Item:
    batches = [item.batch for item in items if item.batch is not None]
    unread = tuple(error for item in items for error in item.unread)
    failed = next((item.failed for item in items if item.failed is not None), None)
    return _Item(collate(batches) if batches and failed is None else None, unread, failed)


class _Loader(DataLoader[FrameBatch]):
    """Tells and raises in this process what is wrong with an item, wherever it was loaded."""

    def __init__(
        self, dataset: _Readable, left_out: Callable[[InputError], None], waited: Waited, **options: object
    ) -> None:
        super().__init__(dataset, **options)  # type: ignore[arg-type]  # what it gives is told apart below
        self.left_out, self.waited = left_out, waited

    def __iter__(self) -> Iterator[FrameBatch]:  # type: ignore[override]  # Lightning asks for no more
        read, unreadable, failed = False, None, None
        try:
            for batch, unread, failed in self._timed():
                if failed is not None:
                    break
                for error in unread:
                    unreadable = unreadable or error
                    self.left_out(error)
                if batch is not None:
                    read = True
                    yield batch
        except RuntimeError as error:
            if "DataLoader worker" not in str(error):
                raise
            failed = MachineFailure(_KILLED)
        if failed is None and (read or unreadable is None):
            return
        # Workers end with the iterator that holds them, at once: with a traceback it would be in a cycle, whose
        # queues are closed first, so that it waits for workers that nothing reaches.
        self._iterator = None
        raise failed or cast(InputError, unreadable)

    def _timed(self) -> Iterator[_Item]:
        begun = time.perf_counter()
        items = cast(Iterator[_Item], super().__iter__())
        for item in items:
            self.waited.seconds += time.perf_counter() - begun
            yield item
            begun = time.perf_counter()


def _outliving_a_signal(worker: int) -> None:
    """A scheduler's SIGTERM is for all processes of a job; the run still needs frames to finish its step, and ends this
    process then. Should it not, an alarm does."""
    signal.signal(signal.SIGTERM, lambda number, frame: signal.setitimer(signal.ITIMER_REAL, _GRACE_S))
