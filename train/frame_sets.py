"""The frames of a run: those of sequences, which are read when they are asked for, and those that were rendered."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

from torch.utils.data import Dataset

from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch, to_batch
from train.colons import TubeData
from train.frame_cache import FrameCache


def held_out_count(frames: int, share: float) -> int:
    """How many frames at the end of a sequence are held out."""
    return max(1, int(share * frames))


class Frames(Dataset[FrameBatch]):
    """Frames of the sequence at `path`, read when asked for, at one size."""

    def __init__(self, frames: FrameSequence, size: tuple[int, int], path: str) -> None:
        self.frames, self.size, self.path = frames, size, path
        self.cache: FrameCache | None = None
        """where they are kept once they are decoded, if anywhere"""
        self.names = [f"{path}: {name}" for name in frames.names]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> FrameBatch:
        if self.cache is None:
            return to_batch(self.frames[index], self.size)
        number = self.frames.numbers[index]
        found = self.cache.read(number)
        if found is None:
            found = to_batch(self.frames[index], self.size)
            self.cache.keep(number, found)
        return found

    def first(self) -> FrameBatch | None:
        """The first frame that can be read; None where none of the first few can."""
        for i in range(min(len(self), 5)):
            with suppress(InputError):
                return self[i]
        return None


class Rendered(Dataset[FrameBatch]):
    """Frames in memory."""

    def __init__(self, batches: list[FrameBatch], names: list[str]) -> None:
        self.batches, self.names = batches, names

    def __len__(self) -> int:
        return len(self.batches)

    def __getitem__(self, index: int) -> FrameBatch:
        return self.batches[index]


class Opened(NamedTuple):
    """The sequences of a run: what is trained and validated on, and each that trains with its rows that are used."""

    train: list[Frames]
    val: list[Frames]
    listed: list[tuple[str, FrameSequence, list[int]]]

    def counts(self, tube: TubeData) -> dict[str, int]:
        """Number of frames to train and to validate on, colons among them."""
        train, val = (sum(map(len, part)) for part in (self.train, self.val))
        return {"train": train + tube.scenes * tube.frames, "val": val + tube.val_scenes * tube.frames}

    def first(self) -> FrameBatch | None:
        """A frame of them, the first that can be read; None where there is none."""
        found = (part.first() for part in (*self.train, *self.val))
        return next((batch for batch in found if batch is not None), None)
