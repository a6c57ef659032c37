"""How a training run is watched and stopped: its settings, its callbacks and logger, and its lines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import EarlyStopping, EMAWeightAveraging, LearningRateMonitor, RichProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from lightdepth.command_line.outcome import is_quiet, outcome
from lightdepth.errors import InputError
from lightdepth.foreign_text import for_line
from lightdepth.ranges import BELOW_ONE, at_least, checked
from lightdepth.reporting.names import Names
from lightdepth.signals import Received

from .board import Board
from .callbacks import Diagnosis, DiagnosisConfig, TrainingProgress
from .checkpoints import Checkpoints, Start, WholeCheckpoints
from .datamodule import FrameDataModule
from .folder import first_process
from .running import NO_ROOT, report_every


@dataclass(frozen=True)
@checked
class FitConfig:
    """How a run is watched, averaged and stopped."""

    ema: Annotated[float, BELOW_ONE] = 0.0
    """Decay of the running average of the weights, in [0, 1), which is validated and exported in place of the last
    weights; 0 takes no average. A larger one averages over more steps, about 1 / (1 - decay) of them."""
    monitor: Literal["loss", "photometric", "inconsistency", "last"] = "loss"
    """Value on the validation frames that chooses the exported checkpoint, the one where it is least; none needs truth:
    the whole "loss"; its "photometric" term (rendered against seen light); or the "inconsistency" (how much distance
    changes when the image is mirrored and darkened). "last" exports the last step, whatever these say."""
    patience: Annotated[int, at_least(0)] = 0
    """Number of validations in a row without a better value of --fit.monitor after which the run ends; 0 goes on to the
    last step. More wait longer."""
    diagnosis: DiagnosisConfig = field(default_factory=DiagnosisConfig)
    """When a run that goes nowhere is stopped."""

    def __post_init__(self) -> None:
        if self.patience and self.monitor == "last":
            raise InputError(
                "fit", "patience without a criterion", "set fit.monitor to loss, photometric or inconsistency"
            )


def with_callbacks(
    given: Mapping[str, object],
    folder: Path,
    echo: Callable[[str], None],
    data: FrameDataModule,
    settings: FitConfig,
    received: Received,
    start: Start | None,
    board: Mapping[str, str | float] = MappingProxyType({}),
) -> dict[str, object]:
    """Trainer options completed by the run's logger, checkpoints and progress. `received` tells of signals, `start`
    where the run goes on; `board` are settings for TensorBoard."""
    options = dict(given)
    interval, asked = options.get("val_check_interval"), options.get("max_steps")
    steps = asked if isinstance(asked, int) and asked else -1
    if isinstance(interval, int) and 0 < steps < interval:
        options["val_check_interval"] = interval = steps  # a short run is validated once, at its end
    options["logger"] = _logger(options.get("logger"), folder)
    monitor = None if settings.monitor == "last" else f"val/{settings.monitor}"
    every = interval if isinstance(interval, int) else 250
    extra: list[pl.Callback] = [
        Board(board),
        Diagnosis(settings.diagnosis, data.names),
        TrainingProgress(echo, report_every(steps), data.seconds_waited),
    ]
    if settings.patience > 0:
        assert monitor is not None
        extra.append(EarlyStopping(monitor, patience=settings.patience))
    extra.append(Checkpoints(folder / "checkpoints", monitor, every, data.config.seed, received, start))
    if settings.ema > 0:  # behind the checkpoints: at the end it puts the average in the place of the weights
        extra.append(EMAWeightAveraging(decay=settings.ema))
    if options["logger"] is not False:
        extra.append(LearningRateMonitor("step"))
    if options.get("enable_progress_bar") is None:
        options["enable_progress_bar"] = sys.stderr.isatty() and not is_quiet()
    if options["enable_progress_bar"]:
        extra.append(RichProgressBar())
    callbacks = options.get("callbacks") or []
    options["callbacks"] = [*(callbacks if isinstance(callbacks, list) else [callbacks]), *extra]
    if options.get("sync_batchnorm") is None:
        options["sync_batchnorm"] = options.get("accelerator") != "cpu" and torch.cuda.is_available()
    options["enable_checkpointing"] = False  # ours take the place of Lightning's
    options["plugins"] = [WholeCheckpoints()]
    options.setdefault("default_root_dir", NO_ROOT)
    return options


def _logger(asked: object, folder: Path) -> object:
    """What logs a run, by our names; a logger of Lightning's, given from code, as it is."""
    if asked in (None, True, "tensorboard"):
        return TensorBoardLogger(str(folder), name="tensorboard", version="")
    if asked == "csv":
        return CSVLogger(str(folder), name="csv", version="")
    return False if asked == "none" else asked


class Echo:
    """Lines for the terminal and the run's log, from the first process only.

    A class, not a closure, because it is pickled to worker processes."""

    def __init__(self, log: Path, names: Names) -> None:
        self.log, self.names = log, names

    def __call__(self, line: str) -> None:
        if not first_process():
            return
        if not is_quiet() or line.startswith("warning: "):
            print(for_line(line), file=sys.stderr, flush=True)
        outcome().stage(line)
        with self.log.open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(for_line(self.names.text(line)) + "\n")
