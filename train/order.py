"""In which order frames are trained on: pure functions of seed and epoch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from torch.utils.data import Sampler


class Shuffled(Sampler[int]):
    """A new order every epoch, which follows from seed and epoch. Lightning calls `set_epoch`."""

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.seed, self.epoch = count, seed, 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[int]:
        return iter(np.random.default_rng((self.seed, self.epoch)).permutation(self.count).tolist())


class Halves(Shuffled):
    """An epoch goes once through the first `frames` rows, in batches filled up from the `colons` rows behind them."""

    def __init__(self, frames: int, colons: int, batch_size: int, seed: int) -> None:
        self.frames, self.colons, self.second = frames, colons, batch_size // 2
        self.first = batch_size - self.second
        self.batches = max(1, frames // self.first)
        super().__init__(self.batches * batch_size, seed)

    def __iter__(self) -> Iterator[int]:
        rng = np.random.default_rng((self.seed, self.epoch))
        frames = np.resize(rng.permutation(self.frames), (self.batches, self.first))
        colons = self.frames + np.resize(rng.permutation(self.colons), (self.batches, self.second))
        return iter(np.concatenate([frames, colons], 1).ravel().tolist())
