"""The trainings of an ablation, one after another, each written as soon as it is judged."""

from __future__ import annotations

import contextlib
import io
import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import lightning.pytorch as pl
from jsonargparse import ArgumentParser

from lightdepth.checkpoint import load_model
from lightdepth.command_line.outcome import is_quiet, outcome
from lightdepth.errors import Interrupted, PartialFailure
from lightdepth.files.machine import machine_failure
from lightdepth.files.writing import write_whole
from lightdepth.foreign_text import for_line
from lightdepth.models import NetworkModel
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import plain

from ..datamodule import FrameDataModule
from ..fit import fit
from ..parser import as_yaml
from ..requeue import QUEUED
from .judge import Judge
from .plan import Plan
from .table import Result

_KEPT = "finished trainings are kept: the same command goes on"


def finished(plan: Plan) -> Result | None:
    """The result in the row's file, where it was made with these settings."""
    try:
        found = json.loads(plan.path.read_text(encoding="utf-8-sig"))
        return Result(**found["result"]) if found["stamp"] == plan.stamp else None
    except (OSError, ValueError, TypeError, KeyError, IndexError, RecursionError):  # it is made again
        return None


def train_all(parser: ArgumentParser, todo: Sequence[Plan], judge: Judge) -> None:
    started, steps = time.monotonic(), sum(plan.config.trainer.max_steps for plan in todo)
    done, seed, rendered = 0, None, list[FrameDataModule]()
    with _kept(), Progress("Steps of training", steps) as bar:
        for number, plan in enumerate(todo, 1):
            if plan.seed != seed:
                seed, rendered = plan.seed, []
            result = _trained(parser, plan, judge, rendered, partial(_reach, bar, done))
            write_whole(plan.path, json.dumps({"stamp": plan.stamp, "result": plain(result)}, indent=1) + "\n")
            done += plan.config.trainer.max_steps
            bar.reach(done)
            left = (time.monotonic() - started) / done * (steps - done) / 60
            said = result.failed or f"{result.overall():.3f} of the closed form's errors"
            what = f"[{number}/{len(todo)}] seed {plan.seed}, {plan.row.name}"
            say(f"{what}: {said}, {result.seconds:.0f} s; {left:.0f} min left")


@contextlib.contextmanager
def _kept() -> Iterator[None]:
    """What a signal or the machine ends within it is told with how the ablation goes on, not a training of it."""
    call = outcome()
    call.goes_on, before = "", call.goes_on
    try:
        yield
    except Interrupted as error:
        asked = error.kept.rpartition(". ")[2] if error.kept.endswith(QUEUED) else ""
        error.kept = f"finished trainings are kept. {asked}" if asked else _KEPT
        raise
    except Exception as error:
        if (failure := machine_failure(error, kept=_KEPT.capitalize())) is None:
            raise
        raise failure from error
    finally:
        call.goes_on = before


def _reach(bar: Progress, before: int, step: int) -> None:
    bar.reach(before + step)


def _trained(
    parser: ArgumentParser,
    plan: Plan,
    judge: Judge,
    rendered: list[FrameDataModule],
    step: Callable[[int], None] = lambda at: None,
) -> Result:
    """Trains one row of one seed and judges it. `rendered` has frames of this seed, and gets those that it lacks.
    `step` is told each step."""
    folder = Path(plan.config.output)
    pl.seed_everything(plan.seed, workers=True, verbose=False)
    made = parser.instantiate(plan.config)
    data = FrameDataModule(made.data)
    if not any(data.share(other) for other in rendered):
        data.setup()
        rendered.append(data)
    curve, started = _Curve(step), time.monotonic()
    options = {**vars(made.trainer), "logger": False, "callbacks": [curve], "enable_progress_bar": False}
    text = as_yaml(parser, plan.config)
    parameters = sum(p.numel() for p in made.model.network.parameters())
    failed, errors = "", dict[str, dict[str, dict[str, float]]]()
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # its own log.txt has it
            fit(made.model, data, folder, options, text, plan.seed, overwrite=True, settings=made.fit)
        model = load_model(folder / "model.safetensors", details=False)
        assert isinstance(model, NetworkModel)
        model.to("cpu")  # where the colons to judge on are
        for told in plan.row.told:
            errors[told] = judge(model.network, made.model.loss_config, told)
        if not all(math.isfinite(v) for sets in errors.values() for found in sets.values() for v in found.values()):
            failed = "its distances are not numbers"
    except PartialFailure as error:
        failed = str(error)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    return Result(
        row=plan.row.name,
        seed=plan.seed,
        steps=plan.config.trainer.max_steps,
        parameters=parameters,
        seconds=time.monotonic() - started,
        curve=curve.points,
        errors=errors,
        closed_form=judge.closed_form,
        failed=failed,
    )


class _Curve(pl.Callback):
    """The validation loss over the steps. `step` is told each step."""

    def __init__(self, step: Callable[[int], None]) -> None:
        self.points: list[tuple[int, float]] = []
        self._step = step

    def __getstate__(self) -> dict[str, object]:
        """For processes that are started for the training: nobody counts there."""
        return {"points": self.points, "_step": abs}

    def on_train_batch_end(self, trainer: pl.Trainer, *_: object) -> None:
        self._step(trainer.global_step)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        loss = float(trainer.callback_metrics["val/loss"])
        if trainer.state.fn == "fit" and math.isfinite(loss):
            self.points.append((trainer.global_step, loss))


def say(line: str) -> None:
    """A line for the terminal."""
    if not is_quiet():
        print(for_line(line), file=sys.stderr, flush=True)
    outcome().stage(line)
