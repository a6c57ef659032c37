"""In which order frames are trained on: pure functions of seed and epoch, and of which process has which of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from torch.utils.data import DistributedSampler, Sampler


class Place(NamedTuple):
    """Which of the processes of a run this one is."""

    rank: int
    world: int


ALONE = Place(0, 1)


class Shuffled(Sampler[int]):
    """A new order every epoch, which follows from seed and epoch. Lightning calls `set_epoch`."""

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.seed, self.epoch = count, seed, 0
        self._begun: tuple[int, int] | None = None

    def go_on(self, epoch: int, rows: int) -> None:
        """A run that is resumed begins with this epoch, and behind its first `rows` rows."""
        self.epoch, self._begun = epoch, (epoch, rows)

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    @property
    def past(self) -> int:
        """How many rows of the epoch lie behind the run, which was resumed."""
        return self._begun[1] if self._begun is not None and self._begun[0] == self.epoch else 0

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[int]:
        return iter(self.rows()[self.past :])

    def rows(self) -> list[int]:
        """The rows of the whole epoch, in their order."""
        result: list[int] = np.random.default_rng((self.seed, self.epoch)).permutation(self.count).tolist()
        return result


class Halves(Shuffled):
    """An epoch goes once through the first `frames` rows, in batches filled up from the `colons` rows behind them."""

    def __init__(self, frames: int, colons: int, batch_size: int, seed: int) -> None:
        self.frames, self.colons, self.second = frames, colons, batch_size // 2
        self.first = batch_size - self.second
        self.batches = max(1, frames // self.first)
        super().__init__(self.batches * batch_size, seed)

    def rows(self) -> list[int]:
        rng = np.random.default_rng((self.seed, self.epoch))
        frames = np.resize(rng.permutation(self.frames), (self.batches, self.first))
        colons = self.frames + np.resize(rng.permutation(self.colons), (self.batches, self.second))
        result: list[int] = np.concatenate([frames, colons], 1).ravel().tolist()
        return result


class Parted(DistributedSampler[int]):  # of its kind Lightning parts no sampler again
    """One process's rows of an order that was made for the batches of all of them together.

    In every step the processes see the rows that a single one would see whose batch is as large as all theirs: each has
    every `world`-th of them. Rows that make no whole batch for all are left out; where there are too few for one, some
    stand twice, so that each process has as many.
    """

    def __init__(self, order: Shuffled, batch_size: int, place: Place) -> None:
        super().__init__(order, num_replicas=place.world, rank=place.rank, shuffle=False)  # type: ignore[arg-type]  # it asks for its length alone
        self.order, self.size, self.place = order, batch_size, place

    def set_epoch(self, epoch: int) -> None:
        self.order.set_epoch(epoch)

    def __len__(self) -> int:
        return len(self._own())

    def __iter__(self) -> Iterator[int]:
        return iter(self._own()[self.order.past // self.place.world :])

    def batch(self, number: int) -> list[int]:
        """This process's rows in a batch of the epoch."""
        return self._own()[number * self.size :][: self.size]

    def _own(self) -> list[int]:
        rows, world = self.order.rows(), self.place.world
        whole = self.size * world
        used = len(rows) // whole * whole or -(-len(rows) // world) * world
        result: list[int] = np.resize(rows, used)[self.place.rank :: world].tolist()
        return result
