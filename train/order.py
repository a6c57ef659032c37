"""In which order frames are trained on: pure functions of seed and epoch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from torch.utils.data import Sampler


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

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[int]:
        past = self._begun[1] if self._begun is not None and self._begun[0] == self.epoch else 0
        return iter(self.rows()[past:])

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
