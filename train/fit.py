"""The training run: a model, its data and a folder in; checkpoints, an exported model and a record of the run out.

OUT/  config.yaml  log.txt  tensorboard/  checkpoints/{last,best}.ckpt  model.safetensors  model.md  run.json
      uncertainty.png (where the network has that head, and validation frames have truth)

`best` is the lowest validation criterion, which needs no truth. run.json is written last, by rename: its presence means
the run is complete.
"""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import lightning.pytorch as pl
import torch
import yaml
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import (
    EarlyStopping,
    EMAWeightAveraging,
    LearningRateMonitor,
    ModelCheckpoint,
    RichProgressBar,
)
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from lightdepth.checkpoint import load_model, save_model
from lightdepth.errors import InputError
from lightdepth.files.named_inputs import INPUTS, write_inputs
from lightdepth.files.writing import write_whole
from lightdepth.models import NetworkModel
from lightdepth.module import LightDepth
from lightdepth.network import DepthNetwork
from lightdepth.ranges import BELOW_ONE, at_least, checked
from lightdepth.reporting.names import KEPT, Names, names_of
from lightdepth.reporting.record import versions, write_run_json
from lightdepth.reporting.run import input_hash
from lightdepth.uncertainty import Calibration, Doubted, chart_png, doubted, fit_calibration, summary

from .callbacks import Diagnosis, DiagnosisConfig, Panels, TrainingProgress, validation_line
from .card import Card, Doubt
from .colons import TubeData
from .datamodule import FrameDataModule
from .running import quiet, report_every
from .trainer_options import check_trainer_options

_OURS = (
    *(
        "config.yaml",
        "log.txt",
        "tensorboard",
        "csv",
        "checkpoints",
        "model.safetensors",
        "model.md",
        "uncertainty.png",
    ),
    INPUTS,
    "run.json",
)
_PRECISIONS = (None, 32, "32", "32-true", 16, "16", "16-mixed", "bf16", "bf16-mixed")


@dataclass(frozen=True)
@checked
class FitConfig:
    """How a run is watched, averaged and stopped."""

    ema: Annotated[float, BELOW_ONE] = 0.0
    """Decay of the running average of the weights, in [0, 1), which is validated and exported in place of the last
    weights; 0 takes no average. A larger one averages over more steps, about 1 / (1 - decay) of them."""
    monitor: Literal["loss", "photometric", "inconsistency", "last"] = "loss"
    """What must be least, on the validation frames, in the checkpoint that is exported; it needs no truth: the whole
    "loss"; its "photometric" term (rendered against seen light); or the "inconsistency" (how much distance changes when
    the image is mirrored and darkened). "last" exports the last step, whatever these say."""
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


_FIT = FitConfig()


def check_output(output: Path, resume: bool, overwrite: bool) -> None:
    """Raises InputError when the folder holds a run and neither flag says what to do with it."""
    if resume and overwrite:
        raise InputError("--resume, --overwrite", "they contradict each other", "give one of them")
    if output.exists() and not output.is_dir():
        raise InputError(output, "is a file", "expected a folder to write the run to")
    complete, begun = (output / "run.json").exists(), (output / "checkpoints" / "last.ckpt").exists()
    if (complete or begun) and not resume and not overwrite:
        state = "complete" if complete else "unfinished"
        raise InputError(output, f"holds a {state} run", "--resume continues it, --overwrite starts anew")


def fit(
    model: LightDepth,
    data: FrameDataModule,
    output: Path,
    trainer_options: Mapping[str, object],
    config_yaml: str,
    seed: int,
    resume: bool = False,
    overwrite: bool = False,
    arguments: list[str] | None = None,
    settings: FitConfig = _FIT,
) -> dict[str, float]:
    """Trains, exports, records; returns the errors of the exported model on the validation frames.

    `trainer_options` are lightning's Trainer's; a logger among them takes the place of TensorBoard. With `resume` the
    run goes on from checkpoints/last.ckpt, if there is one. Raises InputError, and leaves the folder as it is, when it
    holds a run and neither `resume` nor `overwrite` is given, or when data or checkpoint cannot be read.
    """
    if trainer_options.get("precision") not in _PRECISIONS:
        raise InputError(
            "trainer.precision",
            f"{trainer_options['precision']}, but the physics of light needs float32",
            "expected 32-true, 16-mixed or bf16-mixed",
        )
    check_trainer_options(trainer_options)
    check_output(output, resume, overwrite)
    started = time.time()
    quiet()
    checkpoints = output / "checkpoints"
    last = checkpoints / "last.ckpt"
    resumed = last if resume and last.exists() else None
    if resumed is not None:
        load_model(resumed)  # says what is wrong with it before anything is touched
    data.setup()
    asked = {"settings": yaml.safe_load(config_yaml), "sequences": [*data.sequences, *data.val_sequences]}
    names = Names() if KEPT.get() else names_of(asked, (output,), argv=arguments or ())
    echo = _Echo(output / "log.txt", names)
    if _first_process():
        output.mkdir(parents=True, exist_ok=True)
        for name in _OURS if overwrite else ("run.json",):
            _remove(output / name)
        if names.paths:
            write_inputs(output, names.paths)
            config_yaml = yaml.safe_dump(names.hidden(asked["settings"], exactly=True), sort_keys=False)
        write_whole(output / "config.yaml", config_yaml)
    echo(
        f"{data.counts['train']} frames to train on, {data.counts['val']} to validate on, {data.size[0]}x{data.size[1]}"
    )
    for sentence in data.doubts:
        echo(f"warning: {sentence}")
    options = _with_callbacks(trainer_options, output, echo, data, settings)
    with _refusals_named(MisconfigurationException, ValueError, TypeError):
        trainer = pl.Trainer(**options)  # type: ignore[arg-type]  # the parser checked them against Trainer
    if resume:
        echo(f"resuming from {last.name}" if resumed else "nothing to resume: starting anew")
    with _refusals_named(MisconfigurationException):
        trainer.fit(model, datamodule=data, ckpt_path=resumed, weights_only=True)
    train_loss = trainer.callback_metrics.get("train/loss")

    best = checkpoints / "best.ckpt"
    chosen = best if best.exists() else last
    found = trainer.validate(model, datamodule=data, ckpt_path=chosen, verbose=False, weights_only=True)[0]
    errors = {key.removeprefix("val/"): float(value) for key, value in found.items()}
    if trainer.is_global_zero:
        final = f"train loss {float(train_loss):.4g}  " if train_loss is not None else ""
        echo(f"final: {final}{validation_line(found)}")
        exported = load_model(chosen)  # not `model`: where weights are averaged, the file has the average
        assert isinstance(exported, NetworkModel)
        doubt = _calibrate(exported.network, data, output) if model.loss_config.uncertainty > 0 else None
        # Not the trainer's step: of processes started for the fit alone, it never hears.
        steps = int(torch.load(last, map_location="cpu", weights_only=True)["global_step"])
        card = TrainedCard(
            trained_on=_trained_on(model, data),
            rows=model.rows,
            steps=steps,
            seed=seed,
            checkpoint=chosen.stem,
            network=model.network.config,
            loss=model.loss_config,
            fit=settings,
            uncertainty=doubt,
            tube=data.tube if data.tube.scenes or data.tube.val_scenes else None,
            errors=errors,
            version=versions().get("lightdepth", "not installed"),
        )
        save_model(exported.network, output / "model.safetensors", card.record())
        write_whole(output / "model.md", card.text(output.name))
        echo(f"exported the {chosen.stem} checkpoint to {output / 'model.safetensors'}")
        record = {
            "seed": seed,
            "inputs": {names.of(path): input_hash(Path(path)) for path in [*data.sequences, *data.val_sequences]},
            "split": data.split and names.of(data.split),
            "frames": data.counts,
            "steps": steps,
            "resumed": resumed is not None,
            "units": {"rmse_mm": "mm", "medae_mm": "mm", "distance": "up to scale"},
            "errors": errors,
            "warnings": data.doubts,
            "colour": {names.of(path): colours.record() for path, colours in data.colours.items()},
        }
        write_run_json(output, "train", {"argv": names.command(arguments or [])}, started, record, names)
    return errors


@contextmanager
def _refusals_named(*kinds: type[Exception]) -> Iterator[None]:
    """What Lightning says of settings that it cannot run with, as of a user's other mistakes."""
    try:
        yield
    except InputError:
        raise  # of ours, which is a ValueError
    except kinds as error:
        found = " ".join(str(error).split()).rstrip(".")
        raise InputError("--trainer", f"Lightning says: {found}", "see lightdepth train --help-all") from error


@torch.no_grad()
def doubted_frames(network: DepthNetwork, data: FrameDataModule) -> list[Doubted]:
    """Errors and uncertainties on the validation frames that have truth."""
    frames, device = [], next(network.parameters()).device
    for batch in data.val_dataloader():
        batch = batch.to(device)
        distance, _, log_sigma = network.estimate(batch.image, batch.mask, batch.rays, batch.light)
        assert log_sigma is not None
        columns = (distance, log_sigma.exp(), batch.true_distance, batch.true_valid)
        for row in zip(*(column[:, 0].cpu().numpy() for column in columns), strict=True):
            frame = doubted(*row)
            if frame is not None:
                frames.append(frame)
    return frames


def _calibrate(network: DepthNetwork, data: FrameDataModule, output: Path) -> Doubt | None:
    """Calibrates the uncertainty head on the validation frames that have truth, and says how good it is on them."""
    assert network.uncertainty is not None
    frames = doubted_frames(network, data)
    if not frames:
        return None
    fitted = fit_calibration(frames)
    _set_calibration(network, fitted)
    frames = [Doubted(frame.error, fitted(frame.sigma)) for frame in frames]
    write_whole(output / "uncertainty.png", chart_png(frames))
    found = summary(frames)
    return {
        "exponent": round(fitted.exponent, 4),
        "scale": round(fitted.scale, 4),
        "sparsification": found["sparsification"],
        "coverage": found["coverage"],
        "frames": found["frames"],
    }


def _set_calibration(network: DepthNetwork, fitted: Calibration) -> None:
    """Puts a calibration on top of the one the network has."""
    assert network.uncertainty is not None
    old = network.uncertainty.calibration
    new = torch.tensor([0.0, math.log(fitted.scale)]).to(old) + fitted.exponent * old
    network.uncertainty.calibration.copy_(new)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


class _SaveLast(pl.Callback):
    """The last checkpoint of a run that ends well, before averaging puts the average in the place of the weights."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        trainer.save_checkpoint(self.path)


def _with_callbacks(
    given: Mapping[str, object], output: Path, echo: Callable[[str], None], data: FrameDataModule, settings: FitConfig
) -> dict[str, object]:
    """Trainer options completed by the run's logger, checkpoints and progress."""
    options = dict(given)
    interval, asked = options.get("val_check_interval"), options.get("max_steps")
    steps = asked if isinstance(asked, int) and asked else -1
    if isinstance(interval, int) and 0 < steps < interval:
        options["val_check_interval"] = interval = steps  # a short run is validated once, at its end
    options["logger"] = _logger(options.get("logger"), output)
    folder = str(output / "checkpoints")
    monitor = f"val/{settings.monitor}"
    best = (
        []
        if settings.monitor == "last"
        else [ModelCheckpoint(folder, "best", monitor=monitor, enable_version_counter=False)]
    )
    extra: list[pl.Callback] = [
        *best,
        ModelCheckpoint(
            folder,
            "last",
            every_n_train_steps=interval if isinstance(interval, int) else 250,
            save_on_exception=True,
            enable_version_counter=False,
        ),
        Panels(),
        Diagnosis(settings.diagnosis, data.names),
        TrainingProgress(echo, every=report_every(steps)),
        _SaveLast(output / "checkpoints" / "last.ckpt"),
    ]
    if settings.ema > 0:
        extra.append(EMAWeightAveraging(decay=settings.ema))
    if settings.patience > 0:
        extra.append(EarlyStopping(monitor, patience=settings.patience))
    if options["logger"] is not False:
        extra.append(LearningRateMonitor("step"))
    if options.get("enable_progress_bar") is None:
        options["enable_progress_bar"] = sys.stderr.isatty()
    if options["enable_progress_bar"]:
        extra.append(RichProgressBar())
    callbacks = options.get("callbacks") or []
    options["callbacks"] = [*(callbacks if isinstance(callbacks, list) else [callbacks]), *extra]
    options.setdefault("default_root_dir", str(output))
    return options


def _logger(asked: object, output: Path) -> object:
    """What logs a run, by our names; a logger of Lightning's, given from code, as it is."""
    if asked in (None, True, "tensorboard"):
        return TensorBoardLogger(str(output), name="tensorboard", version="")
    if asked == "csv":
        return CSVLogger(str(output), name="csv", version="")
    return False if asked == "none" else asked


@dataclass(frozen=True, kw_only=True)
class TrainedCard(Card):
    """The card of a checkpoint that was trained from the start."""

    fit: FitConfig
    """how the run was watched, averaged and stopped"""
    tube: TubeData | None
    """synthetic colons that it was trained or validated on, if any"""

    def record(self) -> dict[str, object]:
        shared = super().record()
        errors, version = shared.pop("errors"), shared.pop("version")
        own = {
            "fit": asdict(self.fit),
            "uncertainty": self.uncertainty,
            "tube": None if self.tube is None else asdict(self.tube),
        }
        return {**shared, **own, "errors": errors, "version": version}


def _trained_on(model: LightDepth, data: FrameDataModule) -> str:
    tube = data.tube
    parts = [f"{len(data.sequences)} sequences{_of_split(data.split)}"] if data.sequences else []
    if tube.scenes:
        parts.append(f"{tube.scenes} synthetic colons of {tube.frames} frames each")
    truth = "with true distance in the loss" if model.loss_config.supervised > 0 else "no truth in the loss"
    if model.loss_config.uncertainty > 0:
        truth += " of distance; the uncertainty head alone learned from true distance"
    return f"{' and '.join(parts)}, {data.size[0]}x{data.size[1]} pixels; {truth}."


def _of_split(split: str | None) -> str:
    """The split's data set and name: comparisons are only between models of the same one."""
    if split is None:
        return ""
    path = Path(split).resolve()
    return (
        f" of the split {path.parent.parent.name}/{path.stem}" if path.parent.name == "splits" else f" of {path.name}"
    )


def _first_process() -> bool:
    """Known before there is a Trainer: the launcher's environment says it."""
    return getattr(rank_zero_only, "rank", 0) == 0


class _Echo:
    """Lines for the terminal and the run's log, from the first process only.

    A class, not a closure, because it is pickled to worker processes."""

    def __init__(self, log: Path, names: Names) -> None:
        self.log, self.names = log, names

    def __call__(self, line: str) -> None:
        if not _first_process():
            return
        print(line, file=sys.stderr, flush=True)
        with self.log.open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(self.names.text(line) + "\n")
