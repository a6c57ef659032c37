"""The training run: a model, its data and a folder in; checkpoints, an exported model and a record of the run out.

OUT/  config.yaml  log.txt  tensorboard/  checkpoints/{last,last-previous,best}.ckpt  model.safetensors  model.md
      report.html  run.json  uncertainty.png (where the network has that head, and validation frames have truth)

`best` is the lowest validation criterion, which needs no truth. run.json is written last, by rename: its presence means
the run is complete.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import lightning.pytorch as pl
import torch
import yaml
from lightning.fabric.utilities.exceptions import MisconfigurationException

from lightdepth.checkpoint import load_model, save_model
from lightdepth.command_line.dry import is_dry
from lightdepth.command_line.outcome import outcome
from lightdepth.counting import counted
from lightdepth.datasets.no_camera import NoCamera
from lightdepth.errors import InputError, Interrupted
from lightdepth.files.named_inputs import write_inputs
from lightdepth.files.replacing import STATE, discard, output_of, read_record, unfinished_path
from lightdepth.files.writing import sync_below, write_whole
from lightdepth.models import NetworkModel
from lightdepth.module import LightDepth
from lightdepth.network import DepthNetwork
from lightdepth.option_names import options_below
from lightdepth.reporting.names import KEPT, Names, names_of
from lightdepth.reporting.plan import Plan, untouched
from lightdepth.reporting.record import versions, write_run_json
from lightdepth.reporting.run import input_hash
from lightdepth.signals import finishing_first
from lightdepth.uncertainty import Calibration, Doubted, chart_png, doubted, fit_calibration, summary

from .board import hyper_parameters, opening
from .callbacks import Speed, speed_of, validation_line
from .card import Doubt
from .checkpoints import BEST, LAST, Start, clear_cut_off, exported_of, newest
from .costs import training_steps
from .datamodule import FrameDataModule, warn
from .folder import begin_in, first_process, has_checkpoint, training_folder
from .going_on import settings_before, warn_of_length, warn_of_settings
from .report import FILES, show_frames, training_page
from .requeue import QUEUED, requeued
from .running import NO_ROOT, while_training
from .together import ending_together, look_after_each_other
from .trained_card import TrainedCard, shared_by, trained_on
from .trainer_options import check_trainer_options
from .watching import Echo, FitConfig
from .watching import with_callbacks as _with_callbacks

_PRECISIONS = (None, 32, "32", "32-true", 16, "16", "16-mixed", "bf16", "bf16-mixed")
_MUCH_WAITING = 0.1
_CURE = "--data.num-workers reads them ahead, --data.cache true keeps them decoded"
_FIT = FitConfig()
T = TypeVar("T")


@while_training()
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
    inputs: Sequence[Path] = (),
) -> dict[str, float]:
    """Trains, exports, records; returns the errors of the exported model on the validation frames.

    `trainer_options` are lightning's Trainer's; a logger among them takes the place of TensorBoard. With `resume` the
    run goes on from the newest checkpoint that reads, if there is one. `inputs` are not overwritten. Raises InputError,
    and leaves the folder as it is, when it holds a run and neither `resume` nor `overwrite` is given, or when data or
    checkpoint cannot be read; Interrupted on a signal, when the step is finished and a checkpoint written.
    """
    if trainer_options.get("precision") not in _PRECISIONS:
        raise InputError(
            "trainer.precision",
            f"{trainer_options['precision']}, but the physics of light needs float32",
            "expected 32-true, 16-mixed or bf16-mixed",
        )
    check_trainer_options(trainer_options)
    if is_dry():
        _planned(model, data, output, trainer_options, resume)
    job = _Job(config_yaml, seed, arguments or [], settings, resume)
    try:
        with training_folder(output, resume, overwrite, inputs) as folder:
            start = newest(folder / "checkpoints") if resume else None
            return _fitted(model, data, folder, trainer_options, job, start)
    except Interrupted as error:
        asked = requeued(error.signal)
        error.kept = ". ".join(filter(None, (_left(output, resume or overwrite, error.kept), asked)))
        if asked.endswith(QUEUED) or not first_process():
            outcome().again = None
        raise


def _planned(
    model: LightDepth, data: FrameDataModule, output: Path, trainer_options: Mapping[str, object], resume: bool
) -> None:
    """Ends a dry run: what is read is there, a Trainer takes its options, and no other run writes to the output."""
    with untouched(output.resolve()):
        opened = _opened(data.open_sequences)
        unlogged = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
        with _refusals_named(MisconfigurationException, ValueError, TypeError, RuntimeError):
            pl.Trainer(**{"default_root_dir": NO_ROOT, **trainer_options, **unlogged})  # type: ignore[arg-type]  # the parser checked them
        made = unfinished_path(output.resolve())
        start = newest((made if made.is_dir() else output) / "checkpoints") if resume else None
        counts, (width, height) = opened.counts(data.tube), data.size
        what = f"{counted(counts['train'], 'frame')} to train on, {counts['val']} to validate on, {width}x{height}"
        done = 0 if start is None else start.step
        plan = Plan(output, again=f"going on: {start.said}" if start else "")
        plan.ends(what, partial(training_steps, model, data, opened, trainer_options, done))


@dataclass(frozen=True)
class _Job:
    """What a run was asked for, besides its model, data and Trainer."""

    config_yaml: str
    seed: int
    arguments: list[str]
    settings: FitConfig
    resume: bool


def _opened(reads: Callable[[], T]) -> T:
    """Opens sequences; what cannot be opened is told with the options of train, which lie below --data."""
    with options_below("data"):
        try:
            return reads()
        except NoCamera as error:
            raise error.of_other_verb(error.where, maps=False) from error


def _fitted(
    model: LightDepth,
    data: FrameDataModule,
    folder: Path,
    trainer_options: Mapping[str, object],
    job: _Job,
    start: Start | None,
) -> dict[str, float]:
    started = time.monotonic()
    data.parted = bool(trainer_options.get("use_distributed_sampler", True))
    data.read_colons(folder / STATE / "colons")
    _opened(data.setup)
    asked = {"settings": yaml.safe_load(job.config_yaml), "sequences": [*data.sequences, *data.val_sequences]}
    output = output_of(folder) or folder
    unread = {data.config.cache: "0" * 64} if isinstance(data.config.cache, str) else {}  # gigabytes, of any state
    names = Names() if KEPT.get() else names_of(asked, (output, folder), argv=job.arguments, hashed=unread)
    echo = Echo(folder / "log.txt", names)
    before = settings_before(folder) if start is not None else None
    unkept = ""
    if first_process():
        begin_in(folder)
        clear_cut_off(folder / "checkpoints")
        unkept = data.keep_colons()
        settings = job.config_yaml
        if names.paths:
            write_inputs(folder, names.paths)
            settings = yaml.safe_dump(names.hidden(asked["settings"], exactly=True), sort_keys=False)
        write_whole(folder / "config.yaml", settings)
    echo(
        f"{counted(data.counts['train'], 'frame')} to train on, {data.counts['val']} to validate on, "
        f"{data.size[0]}x{data.size[1]}"
    )
    for sentence in data.doubts:
        echo(f"warning: {sentence}")
    if unkept:
        echo(unkept)
    data.tell = partial(_warned, echo)
    checkpoints = folder / "checkpoints"
    with finishing_first() as received:
        board = hyper_parameters(model, data, trainer_options, job.seed)
        options = _with_callbacks(trainer_options, folder, echo, data, job.settings, received, start, board)
        with _refusals_named(MisconfigurationException, ValueError, TypeError, RuntimeError):  # the last: of a cluster
            trainer = pl.Trainer(**options)  # type: ignore[arg-type]  # the parser checked them against Trainer
        if shows := opening(trainer.logger, folder):
            echo(shows)
        if job.resume:
            echo(start.said if start else "nothing to resume: starting anew")
        if start is not None:
            data.go_on(start.epoch, start.batch)
            warn_of_length(echo, model, start, trainer.max_steps)
            warn_of_settings(echo, before, names.hidden(asked["settings"], exactly=True))
        look_after_each_other(trainer, received)
        with _refusals_named(MisconfigurationException), ending_together(trainer):
            path = None if start is None else start.path
            trainer.fit(model, datamodule=data, ckpt_path=path, weights_only=True)
        train_loss = trainer.callback_metrics.get("train/loss")
        received.stop(f"all steps are kept in {LAST}, and the model is not exported yet")

    chosen = exported_of(checkpoints, job.settings.monitor != "last")
    with ending_together(trainer):
        found = trainer.validate(model, datamodule=data, ckpt_path=chosen, verbose=False, weights_only=True)[0]
        data.gather()
    errors = {key.removeprefix("val/"): float(value) for key, value in found.items()}
    if trainer.is_global_zero:
        final = f"train loss {float(train_loss):.4g}  " if train_loss is not None else ""
        echo(f"final: {final}{validation_line(found)}")
        speed = speed_of(trainer)
        if speed is not None and speed.waiting > _MUCH_WAITING and data.sequences:
            echo(f"{speed.waiting:.0%} of the training was spent waiting for frames: {_CURE}")
        shared = shared_by(model, data, trainer.world_size, bool(options["sync_batchnorm"]))
        record = _exported(model, data, folder, chosen, errors, job, echo, shared, speed)
        if shows:
            echo(opening(trainer.logger, output))
        discard(folder / STATE)  # nothing is gone on with: it would be a finished run's largest part
        sync_below(folder)  # run.json says that the rest is whole
        record["resumed"] = start is not None
        write_run_json(folder, "train", {"argv": names.command(job.arguments)}, started, record, names)
    return errors


def _exported(
    model: LightDepth,
    data: FrameDataModule,
    folder: Path,
    chosen: Path,
    errors: dict[str, float],
    job: _Job,
    echo: Echo,
    shared: str,
    speed: Speed | None,
) -> dict[str, object]:
    """Writes the model of the chosen checkpoint with its card, and returns what run.json is to say. `shared`: how
    processes shared the work, where there were several."""
    exported = load_model(chosen)  # not `model`: where weights are averaged, the file has the average
    assert isinstance(exported, NetworkModel)
    doubt = _calibrate(exported.network, data, folder) if model.loss_config.uncertainty > 0 else None
    # Not the trainer's step: of processes started for the fit alone, it never hears.
    steps = int(torch.load(chosen.with_name(LAST), map_location="cpu", weights_only=True)["global_step"])
    card = TrainedCard(
        trained_on=trained_on(model, data) + shared,
        rows=model.rows,
        steps=steps,
        seed=job.seed,
        checkpoint=chosen.stem,
        network=model.network.config,
        loss=model.loss_config,
        fit=job.settings,
        uncertainty=doubt,
        tube=data.tube if data.tube.scenes or data.tube.val_scenes else None,
        errors=errors,
        version=versions().get("lightdepth", "not installed"),
        chosen_by=job.settings.monitor if chosen.name == BEST else "",
    )
    save_model(exported.network, folder / "model.safetensors", card.record())
    output = output_of(folder) or folder
    write_whole(folder / "model.md", card.text(output.name))
    said = [card.trained_on, f"{steps} steps, seed {job.seed}; the {chosen.stem} checkpoint."]
    if speed is not None:
        said.append(f"Its speed, with validation left aside: {speed}.")
    page = training_page(said, errors, card.chosen_by)
    if (batch := next(iter(data.val_dataloader()), None)) is not None:
        pictured = (folder / "uncertainty.png").read_bytes() if doubt is not None else None
        device = next(exported.network.parameters()).device
        show_frames(page, exported.network, batch.to(device), model.loss_config, pictured)
    page.files(folder, FILES)
    write_whole(folder / "report.html", page.write)
    echo(f"exported the {chosen.stem} checkpoint to {output / 'model.safetensors'}")
    return {
        "seed": job.seed,
        "inputs": {echo.names.of(path): input_hash(Path(path)) for path in [*data.sequences, *data.val_sequences]},
        "split": data.split and echo.names.of(data.split),
        "frames": data.counts,
        "unread": data.unread,
        "steps": steps,
        "units": {"rmse_mm": "mm", "medae_mm": "mm", "distance": "up to scale"},
        "errors": errors,
        "timings": None if speed is None else speed.record(),
        "warnings": data.doubts,
        "colour": {echo.names.of(path): colours.record() for path, colours in data.colours.items()},
    }


def _warned(echo: Echo, sentence: str) -> None:
    if first_process():
        echo(f"warning: {sentence}")
    else:  # of other processes the log says nothing
        warn(sentence)


def _left(output: Path, flagged: bool, kept: str) -> str:
    """What is left of a run that was stopped, and how to go on; `kept` is what its steps say of it."""
    if has_checkpoint(unfinished_path(output.resolve())) or (has_checkpoint(output) and read_record(output) is None):
        return outcome().keeping(kept or "its checkpoints are kept")
    if flagged and has_checkpoint(output):
        return f"no step was made yet, so {output.name} is as it was: the same command goes on"
    none = f"{output.name} is as it was" if flagged else "nothing is kept"
    return f"no step was made yet, so {none}: the same command starts anew"


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
