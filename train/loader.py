"""Batches of frames, loaded in this process or in workers."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence, Sized
from typing import NamedTuple, cast

import torch
from torch.utils.data import DataLoader, Dataset

from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch
from lightdepth.photometry import LightTerms
from train.order import Shuffled

_GRACE_S = 120.0
_MOST_UNREAD = 20  # items one after another: no accident, but a mistake


def loader(
    dataset: Dataset[FrameBatch],
    batch_size: int,
    workers: int,
    left_out: Callable[[InputError], None],
    order: Shuffled | None = None,
    drop_last: bool = False,
) -> DataLoader[FrameBatch]:
    """Batches of a dataset whose items are batches of one, in an `order` or its own.

    In the place of an item that cannot be read stands the next one that can: `left_out` is told of each, in this
    process. Raises InputError where a score of items after one another cannot be read."""
    return _Loader(
        _Readable(dataset),
        left_out,
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
    """A batch, or none, and what could not be read before it was found. What is raised in a worker would come back as
    another exception."""

    batch: FrameBatch | None
    unread: tuple[InputError, ...]


class _Readable(Dataset[_Item]):
    """The items of a dataset; in the place of one that cannot be read the next one that can."""

    def __init__(self, dataset: Dataset[FrameBatch]) -> None:
        self.dataset = dataset

    def __len__(self) -> int:
        return len(cast(Sized, self.dataset))

    def __getitem__(self, index: int) -> _Item:
        unread: tuple[InputError, ...] = ()
        for row in range(index, index + min(len(self), _MOST_UNREAD)):
            try:
                return _Item(self.dataset[row % len(self)], unread)
            except InputError as error:
                unread += (error,)
        return _Item(None, unread)


def _collated(items: Sequence[_Item]) -> _Item:
    batches = [item.batch for item in items if item.batch is not None]
    whole = len(batches) == len(items)
    return _Item(collate(batches) if whole else None, tuple(error for item in items for error in item.unread))


class _Loader(DataLoader[FrameBatch]):
    """Tells and raises in this process what is wrong with an item, wherever it was loaded."""

    def __init__(self, dataset: _Readable, left_out: Callable[[InputError], None], **options: object) -> None:
        super().__init__(dataset, **options)  # type: ignore[arg-type]  # what it gives is told apart below
        self.left_out = left_out

    def __iter__(self) -> Iterator[FrameBatch]:  # type: ignore[override]  # Lightning asks for no more
        for batch, unread in cast(Iterator[_Item], super().__iter__()):
            if batch is None:
                raise unread[0]
            for error in unread:
                self.left_out(error)
            yield batch


def _outliving_a_signal(worker: int) -> None:
    """A scheduler's SIGTERM is for all processes of a job; the run still needs frames to finish its step, and ends this
    process then. Should it not, an alarm does."""
    signal.signal(signal.SIGTERM, lambda number, frame: signal.setitimer(signal.ITIMER_REAL, _GRACE_S))
