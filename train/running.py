"""What training anew and adapting share: a quiet Lightning, and how often to report."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence

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


def quiet() -> None:
    """Lightning's tips and hardware lists do not belong in a log; its warnings that matter stay."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*number of training batches.*")
    warnings.filterwarnings("ignore", ".*exists and is not empty.*")
    warnings.filterwarnings("ignore", ".*isn't supported for scheduler.*")
    warnings.filterwarnings("ignore", ".*dirpath has changed.*")
    warnings.filterwarnings("ignore", ".*LeafSpec.*")
    warnings.filterwarnings("ignore", ".*mid-epoch.*|.*ended.*epoch.*")
    warnings.filterwarnings("ignore", ".*in eval mode at the start of training.*")  # what is frozen is so on purpose
    torch.set_float32_matmul_precision("high")
