"""What training anew and adapting share: a quiet Lightning, fast arithmetic, and how often to report."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import lightning.pytorch as pl
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment

NO_ROOT = "/dev/null/no-root"
"""Lightning's folder for what we write ourselves; none can be there. On a cluster it would take the weights of any
`hpc_ckpt_*.ckpt` that lies in it, and where none is given it is the one that the user is in."""


def trainer_of_one(steps: int = 0, callbacks: Sequence[pl.Callback] = ()) -> pl.Trainer:
    """A Trainer of one process that writes nothing, also in a job of a cluster that has more: for so many steps without
    validation, or, with none, to validate."""
    return pl.Trainer(
        devices=1,
        plugins=[LightningEnvironment()],
        default_root_dir=NO_ROOT,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        max_steps=steps or -1,
        gradient_clip_val=1.0,
        limit_val_batches=0 if steps else None,
        log_every_n_steps=1,
        callbacks=list(callbacks),
    )


def report_every(steps: int) -> int:
    return 50 if steps <= 0 else max(1, min(100, steps // 10))


_LOGGERS = ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
_TIPS = (
    "does not have many workers",
    "number of training batches",
    "exists and is not empty",
    "isn't supported for scheduler",
    "dirpath has changed",
    "LeafSpec",
    "mid-epoch",
    "ended.*epoch",
    "in eval mode at the start of training",  # what is frozen is so on purpose
)


@contextmanager
def while_training() -> Iterator[None]:
    """Lightning's tips and hardware lists do not belong in a log; its warnings that matter stay. Within it products of
    matrices are as fast as their precision allows, and this thread, with those that it starts, takes numbers below
    1.2e-38 for 0. Channels that have died are full of them, and a processor takes many times as long over each: a step
    of the unet took three times as long after 2500 steps as at the start. Afterwards the process is as it was."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before, precision, flushed = [each.level for each in loggers], torch.get_float32_matmul_precision(), flushes()
    with warnings.catch_warnings():
        for tip in _TIPS:
            warnings.filterwarnings("ignore", f".*{tip}")
        for each in loggers:
            each.setLevel(logging.ERROR)
        torch.set_float32_matmul_precision("high")
        torch.set_flush_denormal(True)  # where a processor has no such thing, nothing changes
        try:
            yield
        finally:
            torch.set_flush_denormal(flushed)
            torch.set_float32_matmul_precision(precision)
            for each, level in zip(loggers, before, strict=True):
                each.setLevel(level)


def flushes() -> bool:
    """Whether this thread takes numbers below 1.2e-38 (denormal ones) for 0."""
    return float(torch.tensor(2e-38) * 0.5) == 0
