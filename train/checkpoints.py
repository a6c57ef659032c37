"""Checkpoints of a training run: when they are written, how, and which of them a run goes on from.

OUT/checkpoints/  last.ckpt  last-previous.ckpt (the one before)  best.ckpt (least validation criterion)

`last` is written only between two steps: the step before, its validation and what follows from it are whole, and no
gradient waits for more batches. Where in the run that is, is written as the number T of batches that are done, and from
it alone Lightning's counters follow. So a resumed run takes the very step that an uninterrupted one would have taken.
"""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import EarlyStopping
from lightning.pytorch.plugins.io import TorchCheckpointIO

from lightdepth.checkpoint import load_model
from lightdepth.errors import InputError, PartialFailure
from lightdepth.files.weights import read_pickled
from lightdepth.files.writing import is_dead_partial, write_whole
from lightdepth.signals import Received

LAST, PREVIOUS, BEST = "last.ckpt", "last-previous.ckpt", "best.ckpt"
NOT_KEPT = "the last one is not kept"
_SEEDS_APART = 1_000_003
_STARTS_ANEW = "remove it to start anew, or copy it again"


@dataclass(frozen=True)
class Start:
    """Where a run goes on: the checkpoint, how far it is, and a sentence that says which one and why."""

    path: Path
    step: int
    """Changes of the weights until there."""
    epoch: int
    batch: int
    """Batches of that epoch that are done."""
    planned: float
    """Steps that the run was to take when the checkpoint was written; nan where it does not say."""
    said: str


def newest(folder: Path) -> Start | None:
    """The newest checkpoint that reads: last, else of the one before and the best the later. None where there is none;
    InputError where none of them reads."""
    there = [folder / name for name in (LAST, PREVIOUS, BEST) if (folder / name).is_file()]
    refusals, found = [], list[Start]()
    for path in there:
        try:
            start = _start(path)
        except InputError as error:
            refusals.append(error)
            continue
        if path.name == LAST:
            return start
        found.append(start)
    if found:
        start = max(found, key=lambda each: each.step)
        why = refusals[0].found if refusals else "there is none"
        return replace(start, said=f"{start.said}, as {LAST} cannot be read ({why})")
    if refusals:
        raise refusals[0]
    return None


def _start(path: Path) -> Start:
    load_model(path)  # says what is wrong with it
    saved = read_pickled(path, _STARTS_ANEW)
    try:
        loops, step = saved["loops"]["fit_loop"], int(saved["global_step"])
        epoch = int(loops["epoch_progress"]["current"]["processed"])
        batch = int(loops["epoch_loop.batch_progress"]["current"]["ready"])
        planned = float(saved["callbacks"].get(Checkpoints.__qualname__, {}).get("planned", math.nan))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(path, "a checkpoint that does not say how far its run was", _STARTS_ANEW) from error
    return Start(path, step, epoch, batch, planned, f"resuming from {path.name}, step {step}")


class WholeCheckpoints(TorchCheckpointIO):
    """Writes a checkpoint beside its place, brings it to the disk and renames it; keeps the last one before it, unless
    the storage options are NOT_KEPT."""

    def save_checkpoint(
        self, checkpoint: dict[str, object], path: str | Path, storage_options: object | None = None
    ) -> None:
        assert storage_options in (None, NOT_KEPT), storage_options
        path = Path(path)
        if path.name == LAST and path.is_file() and storage_options != NOT_KEPT:
            _keep(path, path.with_name(PREVIOUS))
        write_whole(path, lambda partial: torch.save(checkpoint, partial))


def _keep(path: Path, previous: Path) -> None:
    """A second name for a file, so that at every moment one of the two is there."""
    beside = previous.with_name(f".{previous.name}")
    beside.unlink(missing_ok=True)
    try:
        os.link(path, beside)
    except OSError:  # a file system without links
        os.replace(path, previous)
    else:
        os.replace(beside, previous)
        beside.unlink(missing_ok=True)  # which a rename leaves where both are one file already: after a kill


def exported_of(folder: Path, best: bool) -> Path:
    """The checkpoint that a run exports: its best one where it is asked for, as one may be there of other settings."""
    return folder / (BEST if best and (folder / BEST).exists() else LAST)


def clear_cut_off(folder: Path) -> None:
    """Removes what a killed run had written of checkpoints: the next ones may have other names."""
    for path in folder.glob(".*"):
        if is_dead_partial(path) or path == folder / f".{PREVIOUS}":
            path.unlink(missing_ok=True)


class Checkpoints(pl.Callback):
    """Writes `best` after a validation and `last` between two steps: every `every` of them, at the end, where the run
    is stopped by a signal, and where it ends with a diagnosis. A `last` from where a run was stopped is not kept beside
    the next one: `last-previous` is of the same step as without the stop.

    `monitor` is the metric that is least in `best`; None writes no best. `received` holds a signal back until a step is
    whole; `resumed` is the number of steps that the run had when it was resumed.
    """

    def __init__(
        self, folder: Path, monitor: str | None, every: int, seed: int, received: Received, resumed: Start | None
    ) -> None:
        self.folder, self.monitor, self.every, self.seed = folder, monitor, every, seed
        self.received, self.resumed = received, resumed
        self._best, self._best_batches = math.inf, 0
        self._planned = math.nan
        self._saved = resumed.step if resumed is not None else 0
        self._between = resumed is not None and resumed.path.name == LAST and resumed.step % every != 0

    def state_dict(self) -> dict[str, object]:
        best = {"best": self._best, "best_batches": self._best_batches}
        return {**best, "planned": self._planned, "monitor": self.monitor}

    def load_state_dict(self, state_dict: Mapping[str, object]) -> None:
        if state_dict.get("monitor", self.monitor) != self.monitor:
            return  # the least value of another measure says nothing of this one's
        self._best, self._best_batches = float(str(state_dict["best"])), int(str(state_dict["best_batches"]))

    def on_save_checkpoint(
        self, trainer: pl.Trainer, module: pl.LightningModule, checkpoint: dict[str, dict[str, dict[str, object]]]
    ) -> None:
        """Lightning's own counters depend on the hook that it saves from; these do not."""
        loops = checkpoint["loops"]["fit_loop"]
        epochs, batches = divmod(done := _batches(trainer), int(trainer.num_training_batches))
        begun = epochs + (batches > 0)
        epoch = {"ready": begun, "started": begun, "processed": epochs, "completed": epochs}
        loops["epoch_progress"] = {"total": dict(epoch), "current": dict(epoch)}
        loops["epoch_loop.batch_progress"] = _counted(done, batches)
        loops["epoch_loop.val_loop.batch_progress"] = _counted(0, 0)
        loops["epoch_loop.state_dict"] = {"_batches_that_stepped": trainer.global_step}

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._planned = float(trainer.estimated_stepping_batches)
        self.received.listen()  # Lightning puts handlers of its own in the place of ours
        interval = trainer.val_check_batch
        if self.monitor is not None and self._best_batches and isinstance(interval, int):
            elsewhere = trainer.check_val_every_n_epoch is None and self._best_batches % interval
            if elsewhere:  # the end of a run that was shorter; the longer one is not validated there
                self._best, self._best_batches = math.inf, 0
                for stopping in trainer.early_stopping_callbacks:
                    assert isinstance(stopping, EarlyStopping), type(stopping)
                    stopping.best_score, stopping.wait_count = torch.tensor(math.inf), 0
                if trainer.is_global_zero:
                    (self.folder / BEST).unlink(missing_ok=True)
        for stopping in trainer.early_stopping_callbacks:
            trainer.should_stop |= isinstance(stopping, EarlyStopping) and stopping.wait_count >= stopping.patience

    def on_train_batch_start(
        self, trainer: pl.Trainer, module: pl.LightningModule, batch: object, batch_idx: int
    ) -> None:
        step = trainer.global_step
        trainer.fit_loop.epoch_loop._batches_that_stepped = step  # of what is logged; after a restart it is off by one
        torch.manual_seed((self.seed * _SEEDS_APART + step) % 2**63)
        if _gradient_waits(trainer):
            return
        stop = bool(self.received.signal)
        if trainer.world_size > 1:
            stop = trainer.strategy.reduce_boolean_decision(stop, all=False)
        if step and step != self._saved and (stop or step % self.every == 0):
            self._save(trainer)
        if stop:
            self.received.signal = self.received.signal or signal.SIGTERM  # another process was told
            self.received.stop(f"step {step} is kept in {LAST}" if step else "")

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self.monitor is None or trainer.state.fn != "fit" or trainer.sanity_checking:
            return
        value = trainer.callback_metrics.get(self.monitor)
        found = math.inf if value is None or not torch.isfinite(value) else float(value)
        if found < self._best or not self._best_batches:
            self._best, self._best_batches = found, _batches(trainer)
            trainer.save_checkpoint(self.folder / BEST)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._save(trainer)

    def on_exception(self, trainer: pl.Trainer, module: pl.LightningModule, exception: BaseException) -> None:
        """Between two steps it is as good a place as any; within one, or before its validation, it is none. A run that
        ends with a diagnosis is looked at, and so kept as it is."""
        diagnosed = isinstance(exception, PartialFailure | InputError)
        total = _done(trainer)
        whole = total.started == total.processed and (total.processed == total.completed or diagnosed)
        new = trainer.global_step not in (0, self._saved)
        if new and trainer.training and whole and not _gradient_waits(trainer):
            self._save(trainer)

    def _save(self, trainer: pl.Trainer) -> None:
        self._saved = trainer.global_step
        trainer.save_checkpoint(self.folder / LAST, storage_options=NOT_KEPT if self._between else None)
        self._between = False


def _done(trainer: pl.Trainer) -> Any:
    """Lightning's count of batches, of all epochs."""
    return trainer.fit_loop.epoch_loop.batch_progress.total


def _batches(trainer: pl.Trainer) -> int:
    """Batches that are done, of all epochs."""
    return int(_done(trainer).processed)


def _gradient_waits(trainer: pl.Trainer) -> bool:
    """Whether batches were added up whose step is still to come."""
    batch = _batches(trainer) % int(trainer.num_training_batches)
    return batch % trainer.accumulate_grad_batches != 0


def _counted(total: int, current: int) -> dict[str, object]:
    names = ("ready", "started", "processed", "completed")
    return {"total": dict.fromkeys(names, total), "current": dict.fromkeys(names, current), "is_last_batch": False}
