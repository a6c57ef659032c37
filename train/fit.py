"""The training run: a model, its data and a folder in; checkpoints, an exported model and a record of the run out.

OUT/  config.yaml  log.txt  tensorboard/  checkpoints/{last,best}.ckpt  model.safetensors  model.md  run.json

`best` is the lowest validation loss without truth. run.json is written last, by rename: its presence means the run is
complete.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger

from lightdepth.checkpoint import load_model, save_model
from lightdepth.errors import InputError
from lightdepth.module import LightDepth
from lightdepth.run import input_hash, versions, write_run_json

from .callbacks import Panels, Progress, validation_line
from .datamodule import FrameDataModule

_OURS = ("config.yaml", "log.txt", "tensorboard", "checkpoints", "model.safetensors", "model.md", "run.json")


def check_output(output: Path, resume: bool, overwrite: bool) -> None:
    """Raises InputError when the folder holds a run and neither flag says what to do with it."""
    if resume and overwrite:
        raise InputError("--resume and --overwrite contradict each other; give one of them")
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; expected a folder to write the run to")
    complete, begun = (output / "run.json").exists(), (output / "checkpoints" / "last.ckpt").exists()
    if (complete or begun) and not resume and not overwrite:
        state = "complete" if complete else "unfinished"
        raise InputError(f"{output}: holds a {state} run; --resume continues it, --overwrite starts anew")


def fit(
    model: LightDepth,
    data: FrameDataModule,
    output: Path,
    trainer_options: dict[str, Any],
    config_yaml: str,
    seed: int,
    resume: bool = False,
    overwrite: bool = False,
    arguments: list[str] | None = None,
) -> dict[str, float]:
    """Trains, exports, records; returns the errors of the exported model on the validation frames.

    `trainer_options` are lightning's Trainer's; a logger among them takes the place of TensorBoard. With `resume` the
    run goes on from checkpoints/last.ckpt, if there is one. Raises InputError, and leaves the folder as it is, when it
    holds a run and neither `resume` nor `overwrite` is given, or when data or checkpoint cannot be read.
    """
    check_output(output, resume, overwrite)
    started = time.time()
    _quiet()
    checkpoints = output / "checkpoints"
    last = checkpoints / "last.ckpt"
    resumed = last if resume and last.exists() else None
    if resumed is not None:
        load_model(resumed)  # says what is wrong with it before anything is touched
    data.setup()
    output.mkdir(parents=True, exist_ok=True)
    for name in _OURS if overwrite else ("run.json",):
        _remove(output / name)
    (output / "config.yaml").write_text(config_yaml)
    echo = _echo(output / "log.txt")
    echo(
        f"{data.counts['train']} frames to train on, {data.counts['val']} to validate on, {data.size[0]}x{data.size[1]}"
    )
    options = _with_callbacks(trainer_options, output, echo)
    trainer = pl.Trainer(**options)
    if resume:
        echo(f"resuming from {last.name}" if resumed else "nothing to resume: starting anew")
    trainer.fit(model, datamodule=data, ckpt_path=resumed, weights_only=True)
    train_loss = trainer.callback_metrics.get("train/loss")
    trainer.save_checkpoint(last)

    best = checkpoints / "best.ckpt"
    chosen = best if best.exists() else last
    found = trainer.validate(model, datamodule=data, ckpt_path=chosen, verbose=False, weights_only=True)[0]
    errors = {key.removeprefix("val/"): float(value) for key, value in found.items()}
    if trainer.is_global_zero:
        card = _card(model, data, trainer, seed, chosen.stem, errors)
        save_model(model.network, output / "model.safetensors", card)
        (output / "model.md").write_text(card_text(card, output.name))
        echo(
            f"final: train loss {float(train_loss):.4g}  {validation_line(found)}"
            if train_loss is not None
            else f"final: {validation_line(found)}"
        )
        echo(f"exported the {chosen.stem} checkpoint to {output / 'model.safetensors'}")
        record = {
            "seed": seed,
            "inputs": {path: input_hash(Path(path)) for path in [*data.sequences, *data.val_sequences]},
            "split": data.split,
            "frames": data.counts,
            "steps": trainer.global_step,
            "resumed": resumed is not None,
            "units": {"rmse_mm": "mm", "medae_mm": "mm", "distance": "up to scale"},
            "errors": errors,
        }
        write_run_json(output, "train", {"argv": arguments or []}, started, record)
    return errors


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def card_text(card: dict[str, Any], name: str) -> str:
    """The card as a page to read."""
    errors = card["errors"]
    lines = [f"# {name}", "", card["trained_on"], ""]
    lines += [f"- {key}: {card[key]}" for key in ("steps", "seed", "checkpoint", "rows", "version") if key in card]
    lines += [f"- network: `{json.dumps(card['network'])}`", f"- loss: `{json.dumps(card['loss'])}`", ""]
    if "abs_rel_median" in errors:
        lines += ["On the validation frames, depth median-aligned per frame:", ""]
        lines += ["| | AbsRel | RMSE mm | MedAE mm | share within 1.25 |", "|---|---|---|---|---|"]
        for prefix, who in (("", "network"), ("closed_form/", "closed form")):
            values = [errors[f"{prefix}{key}_median"] for key in ("abs_rel", "rmse_mm", "medae_mm", "delta1")]
            lines.append(f"| {who} | " + " | ".join(f"{value:.3f}" for value in values) + " |")
    else:
        lines.append(f"Validation loss (no truth): {errors.get('loss', math.nan):.4f}")
    return "\n".join(lines) + "\n"


def _with_callbacks(given: dict[str, Any], output: Path, echo: Callable[[str], None]) -> dict[str, Any]:
    """Trainer options completed by the run's logger, checkpoints and progress."""
    options = dict(given)
    interval, steps = options.get("val_check_interval"), options.get("max_steps") or -1
    if isinstance(interval, int) and 0 < steps < interval:
        options["val_check_interval"] = interval = steps  # a short run is validated once, at its end
    if options.get("logger") in (None, True):
        options["logger"] = TensorBoardLogger(str(output), name="tensorboard", version="")
    folder = str(output / "checkpoints")
    extra: list[pl.Callback] = [
        ModelCheckpoint(folder, "best", monitor="val/loss", enable_version_counter=False),
        ModelCheckpoint(
            folder,
            "last",
            every_n_train_steps=interval if isinstance(interval, int) else 250,
            save_on_exception=True,
            enable_version_counter=False,
        ),
        Panels(),
        Progress(echo, every=_report_every(steps)),
    ]
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


def _report_every(steps: int) -> int:
    return 50 if steps <= 0 else max(1, min(100, steps // 10))


def _card(
    model: LightDepth, data: FrameDataModule, trainer: pl.Trainer, seed: int, checkpoint: str, errors: dict[str, float]
) -> dict[str, Any]:
    tube = data.tube
    parts = [f"{len(data.sequences)} sequences{_of_split(data.split)}"] if data.sequences else []
    if tube.scenes:
        parts.append(f"{tube.scenes} synthetic colons of {tube.frames} frames each")
    truth = "with true distance in the loss" if model.loss_config.supervised > 0 else "no truth in the loss"
    return {
        "trained_on": f"{' and '.join(parts)}, {data.size[0]}x{data.size[1]} pixels; {truth}.",
        "rows": model.rows,
        "steps": trainer.global_step,
        "seed": seed,
        "checkpoint": checkpoint,
        "network": model.network.config.to_dict(),
        "loss": asdict(model.loss_config),
        "tube": asdict(tube) if tube.scenes or tube.val_scenes else None,
        "errors": errors,
        "version": versions().get("lightdepth", "not installed"),
    }


def _of_split(split: str | None) -> str:
    """The split's data set and name: comparisons are only between models of the same one."""
    if split is None:
        return ""
    path = Path(split).resolve()
    return (
        f" of the split {path.parent.parent.name}/{path.stem}" if path.parent.name == "splits" else f" of {path.name}"
    )


def _echo(log: Path) -> Callable[[str], None]:
    def echo(line: str) -> None:
        print(line, file=sys.stderr, flush=True)
        with log.open("a") as file:
            file.write(line + "\n")

    return echo


def _quiet() -> None:
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
    torch.set_float32_matmul_precision("high")
