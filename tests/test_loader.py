"""What a loader makes of frames that cannot be read, and of what the machine does wrong, in whichever process."""

from __future__ import annotations

import errno
import multiprocessing
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from colons import CAMERA
from torch.utils.data import Dataset

from lightdepth.errors import InputError, MachineFailure
from lightdepth.files.machine import machine_failure
from lightdepth.files.reading import reading
from lightdepth.frame import Frame, FrameBatch, to_batch
from train.loader import loader

WORKERS = pytest.mark.parametrize("workers", [0, 2])


class Frames(Dataset[FrameBatch]):
    """Frames that are as bright as their number in hundredths, some of which raise something."""

    def __init__(self, folder: Path, count: int, raising=lambda i: None) -> None:
        self.folder, self.count, self.raising = folder, count, raising

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> FrameBatch:
        error = self.raising(index)
        if error is not None:
            raise error
        image = np.full((CAMERA.height, CAMERA.width, 3), index / 100, np.float32)
        return to_batch(Frame(str(index), image, CAMERA), (5, 4))


def torn(folder: Path, *rows: int):
    return lambda i: InputError(folder / f"{i}.png", "not a readable image", "copy it again") if i in rows else None


def read(dataset: Frames, workers: int, **options) -> tuple[list[list[int]], list[str]]:
    """The frames of each batch of two, and those that were told of."""
    told: list[str] = []
    batches = loader(dataset, 2, workers, lambda error: told.append(Path(error.where).name), **options)
    return [[round(100 * float(v)) for v in batch.image.mean((1, 2, 3))] for batch in batches], told


@WORKERS
def test_the_next_frame_stands_in_the_place_of_one_that_cannot_be_read_or_none(tmp_path, workers):
    dataset = Frames(tmp_path, 7, torn(tmp_path, 1, 4, 5, 6))
    told = [f"{i}.png" for i in (1, 4, 5, 6, 5, 6, 6)]  # row by row: 4 and what was tried in its place
    assert read(dataset, workers) == ([[0, 2], [2, 3], [0, 0], [0]], told)
    assert read(dataset, workers, replacing=False) == ([[0], [2, 3]], ["1.png", "4.png", "5.png", "6.png"])


@WORKERS
@pytest.mark.parametrize("replacing", [True, False])
def test_where_none_can_be_read_the_first_is_named(tmp_path, workers, replacing):
    dataset = Frames(tmp_path, 3, torn(tmp_path, 0, 1, 2))
    with pytest.raises(InputError, match=r"0\.png: not a readable image") as raised:
        read(dataset, workers, replacing=replacing)
    assert ("none of the 2 frames behind it can be read, up to" in str(raised.value)) == replacing


@WORKERS
def test_of_a_score_after_one_another_first_and_last_are_named_and_none_that_was_replaced(tmp_path, workers):
    dataset = Frames(tmp_path, 40, torn(tmp_path, 0, *range(3, 24)))
    with pytest.raises(InputError, match=r"/3\.png: .* 19 frames behind it can be read, up to .*/22\.png"):
        read(dataset, workers)


@WORKERS
@pytest.mark.parametrize(
    "error",
    [OSError(errno.EIO, "Input/output error", "/data/3.png"), MachineFailure("the disk is gone"), MemoryError()],
    ids=["disk", "known", "memory"],
)
def test_what_the_machine_does_wrong_comes_back_as_it_is(tmp_path, workers, error):
    with pytest.raises(type(error)) as raised:
        read(Frames(tmp_path, 6, lambda i: error if i == 3 else None), workers)
    failure = machine_failure(raised.value, tmp_path, "Its checkpoints are kept")
    assert failure is not None and str(failure).endswith("Its checkpoints are kept")
    assert isinstance(error, MachineFailure | MemoryError) or "/data/3.png: the disk could not be read" in str(failure)


class OutOfMemory(Frames):
    def __getitem__(self, index: int) -> FrameBatch:
        with reading("3.png"):
            if index == 3:
                raise MemoryError
            return super().__getitem__(index)


@WORKERS
def test_a_moment_without_memory_replaces_no_frame(tmp_path, workers):
    with pytest.raises(MemoryError):
        read(OutOfMemory(tmp_path, 6), workers)


@WORKERS
def test_a_folder_that_is_gone_is_the_machine_s_doing(tmp_path, workers):
    folder = tmp_path / "frames"
    folder.mkdir()

    def raising(i: int) -> InputError | None:
        if i == 4:
            shutil.rmtree(folder, ignore_errors=True)
        return torn(folder, 4, 5)(i)

    with pytest.raises(MachineFailure, match="frames: the folder that frames were read from is gone"):
        read(Frames(folder, 6, raising), workers)


def test_a_worker_that_is_killed_is_told_as_the_machine_s_doing_and_the_others_end(tmp_path):
    killed = Frames(tmp_path, 6, lambda i: os.kill(os.getpid(), signal.SIGKILL) if i == 2 else None)
    with pytest.raises(MachineFailure) as raised:
        read(killed, 2)
    failure = machine_failure(raised.value, tmp_path, "Its checkpoints are kept: --resume goes on")
    assert failure is not None and "--data.num-workers 0" in str(failure) and str(failure).endswith("--resume goes on")
    assert not multiprocessing.active_children()
