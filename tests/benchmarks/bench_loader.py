"""The share of a training step that waits for frames of C3VD's size: decoded each time, kept for the first time, kept.

The preset `lightdepth` with its own augmentation, tiny at 320x256, on a processor: forward, backward and AdamW, and no
logging, which would make the share smaller. Shares are of one run each, so that a busy machine slows both parts; with
workers they want cores of their own. Run by `make bench`.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import cv2
import lightning.pytorch as pl
import numpy as np
import pytest
from training import write_c3vd_frames

from lightdepth.command_line.presets import with_preset
from train.datamodule import FrameDataModule
from train.parser import training_parser
from train.running import NO_ROOT

AT_MOST = 0.05
"""Share of a step with two workers, of frames that are kept."""
FRAMES, STEPS = 60, 10  # all steps are of one epoch: at the start of each the first batch is waited for
_COLONS = ["--data.tube.scenes", "0", "--data.tube.val_scenes", "0"]


class Steps(pl.Callback):
    """When each step began, and the seconds waited for frames until then."""

    def __init__(self, data: FrameDataModule) -> None:
        self.data, self.found = data, list[tuple[float, float]]()

    def on_train_batch_start(self, trainer, module, batch, batch_idx) -> None:
        self.found.append((time.perf_counter(), self.data.seconds_waited()))


def steps(sequence: Path, cache: str, workers: int, count: int) -> np.ndarray:
    """(count, 2): seconds of each step but the first, and of waiting in it."""
    words = ["--preset", "lightdepth", "-o", "run", "--data.sequences", f"[{sequence}]", "--data.size", "[320, 256]"]
    words += [*_COLONS, "--data.num_workers", str(workers), "--data.cache", cache]
    parser = training_parser()
    made = parser.instantiate(parser.parse_args(with_preset("train", words, parser.error)))
    data = FrameDataModule(made.data)
    seen = Steps(data)
    off = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = pl.Trainer(
        accelerator="cpu",
        devices=1,
        max_steps=count + 2,
        limit_val_batches=0,
        default_root_dir=NO_ROOT,
        callbacks=[seen],
        **off,
    )
    trainer.fit(made.model, datamodule=data)
    return np.diff(np.array(seen.found), axis=0)[1:]


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Path:
    folder = write_c3vd_frames(tmp_path_factory.mktemp("bench") / "seq", 10)
    for i in range(10, FRAMES):
        for name in ("color.png", "depth.tiff"):
            os.link(folder / f"{i % 10:04d}_{name}", folder / f"{i:04d}_{name}")
    with (folder / "pose.txt").open("a", encoding="utf-8") as poses:
        poses.writelines((folder / "pose.txt").read_text(encoding="utf-8").splitlines(True)[:1] * (FRAMES - 10))
    return folder


def test_two_workers_keep_a_training_from_waiting_for_frames_that_are_kept(sequence, tmp_path, capsys):
    cv2.setNumThreads(1)
    shares = {}
    for workers in (0, 2):
        kept = str(tmp_path / str(workers))
        found = {
            "decoded each time": steps(sequence, "false", workers, STEPS),
            "kept, first epoch": steps(sequence, kept, workers, STEPS),
            "kept, later": steps(sequence, kept, workers, STEPS),
        }
        for how, taken in found.items():
            seconds, waited = taken.mean(0)
            shares[how, workers] = waited / seconds
            with capsys.disabled():
                print(
                    f"\n{workers} workers, {how:18}  step {1e3 * seconds:6.0f} ms  waits {1e3 * waited:6.1f} ms, "
                    f"{waited / seconds:6.1%}  {4 / seconds:5.2f} frames/s, "
                    f"{4 / (seconds - waited):5.2f} without waiting",
                    end="",
                )
    assert shares["kept, later", 2] < AT_MOST < shares["decoded each time", 0]
