"""How fast training reads frames of C3VD's size, beside bare cv2.imread + cv2.resize with as many workers, in one run.

Both go through a DataLoader in turns, so that a busy machine slows them alike. Run by `make bench`.
"""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from torch.utils.data import DataLoader, Dataset
from training import write_c3vd_frames

from lightdepth.datasets import open_sequence
from train.frame_sets import Frames
from train.loader import collate

AT_LEAST = 0.8
"""Least share of the bare rate."""
FRAMES, ROUNDS, BATCH, SIZE = 16, 5, 4, (160, 128)


class Bare(Dataset):
    """Images as bytes, read and resized, and nothing else."""

    def __init__(self, files: list[Path], how: int) -> None:
        self.files, self.how = files, how

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> np.ndarray:
        return cv2.resize(cv2.imread(str(self.files[index])), SIZE, interpolation=self.how)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Path:
    return write_c3vd_frames(tmp_path_factory.mktemp("bench") / "seq", FRAMES)


def rates(loaders: list[DataLoader]) -> np.ndarray:
    """Frames per second of each loader, best of some rounds after one to start the workers."""
    taken = np.zeros((ROUNDS + 1, len(loaders)))
    for round_, loader in np.ndindex(taken.shape):
        start = time.perf_counter()
        for _ in loaders[loader]:
            pass
        taken[round_, loader] = time.perf_counter() - start
    return FRAMES / taken[1:].min(0)


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_frames_are_read_almost_as_fast_as_bare_images(sequence, workers, capsys):
    cv2.setNumThreads(1)
    files = sorted(sequence.glob("*_color.png"))
    options = {"batch_size": BATCH, "num_workers": workers, "persistent_workers": workers > 0}
    ours, area, linear = rates(
        [
            DataLoader(Frames(open_sequence(sequence), SIZE, "seq"), collate_fn=collate, **options),
            DataLoader(Bare(files, cv2.INTER_AREA), **options),
            DataLoader(Bare(files, cv2.INTER_LINEAR), **options),
        ]
    )
    size = sum(file.stat().st_size for file in files) / len(files) / 1e6
    with capsys.disabled():
        print(f"\nReading 1350x1080 PNG of {size:.1f} MB at {SIZE[0]}x{SIZE[1]}, {workers} workers    frames/s")
        print(f"  open_sequence + to_batch              {ours:7.1f}")
        print(
            f"  cv2.imread + cv2.resize, by area      {area:7.1f}   we reach {ours / area:.0%}  (gate {AT_LEAST:.0%})"
        )
        print(f"  cv2.imread + cv2.resize, linear       {linear:7.1f}   we reach {ours / linear:.0%}")
    assert ours / area >= AT_LEAST
