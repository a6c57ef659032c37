"""What a training run says while it runs, and what stops it: progress, and a diagnosis when it goes wrong."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import lightning.pytorch as pl
import torch

from lightdepth.command_line.heartbeat import SECONDS
from lightdepth.decline import informative, log_closed_form, most_spread
from lightdepth.errors import InputError, PartialFailure
from lightdepth.frame import FrameBatch
from lightdepth.losses.masked import masked_std
from lightdepth.module import LightDepth
from lightdepth.photometry import brightness
from lightdepth.ranges import at_least, checked


@dataclass(frozen=True)
class Speed:
    """How fast a run trained, its validations left aside: frames a second over all processes."""

    frames_per_s: float
    without_waiting: float
    """had the frames always been there: no loader makes it faster"""

    @property
    def waiting(self) -> float:
        """Share of the time that this process waited for frames."""
        return 1 - self.frames_per_s / self.without_waiting

    def record(self) -> dict[str, float]:
        """As run.json has it."""
        found = {**vars(self), "waiting_share": self.waiting}
        return {name: round(value, 4) for name, value in found.items()}

    def __str__(self) -> str:
        return f"{self.frames_per_s:.3g} frames/s ({self.without_waiting:.3g} without waiting for them)"


class TrainingProgress(pl.Callback):
    """One line every `every` steps, and at least every ten seconds, with speed and time left, and one per validation.
    `echo` takes each line; `waited` gives the seconds for which this process has waited for frames.

    The logger gets the speed as frames per second, over all processes, and the share of time spent waiting.
    """

    def __init__(self, echo: Callable[[str], None], every: int = 50, waited: Callable[[], float] = lambda: 0.0) -> None:
        self.echo, self.every, self.waited = echo, every, waited
        self.speed: Speed | None = None
        """from the first step until the last"""
        self._start, self._first, self._said = 0.0, 0, 0.0
        self._waited_before, self._judging, self._judged = 0.0, 0.0, 0.0

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._start = self._said = time.monotonic()
        self._first, self._waited_before = trainer.global_step, self.waited()

    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: FrameBatch, batch_idx: int
    ) -> None:
        step, total, now = trainer.global_step, trainer.estimated_stepping_batches, time.monotonic()
        seen = (step - self._first) * len(batch.image) * trainer.accumulate_grad_batches * trainer.world_size
        training = max(now - self._start - self._judged, 1e-9)
        working = max(training - (self.waited() - self._waited_before), 1e-9)
        if seen:  # not while gradients of the first step are gathered
            self.speed = Speed(seen / training, seen / working)
        if self.speed is None or (step % self.every and step != total and now - self._said < SECONDS):
            return
        self._said = now
        rate = (step - self._first) / max(now - self._start, 1e-9)
        if trainer.logger is not None:
            speed = {"train/frames_per_s": self.speed.frames_per_s, "train/waiting_share": self.speed.waiting}
            trainer.logger.log_metrics(speed, step=step)
        loss = _number(trainer.callback_metrics.get("train/loss"))
        line = f"step {step}/{total:.0f}  loss {loss}  {rate:.1f} steps/s, {self.speed}"
        if math.isfinite(total):
            line += f"  {_clock((total - step) / max(rate, 1e-9))} left"
        self.echo(line)

    def on_validation_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._judging = time.monotonic()

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not trainer.sanity_checking:
            self._judged += time.monotonic() - self._judging
        if trainer.training or trainer.state.fn == "fit":
            self.echo(f"step {trainer.global_step}  {validation_line(trainer.callback_metrics)}")


def speed_of(trainer: pl.Trainer) -> Speed | None:
    """How fast it trained; None where it made no step, or other processes made them."""
    found = (callback.speed for callback in trainer.callbacks if isinstance(callback, TrainingProgress))  # type: ignore[attr-defined]  # Lightning has it
    return next(found, None)


@dataclass(frozen=True)
@checked
class DiagnosisConfig:
    """When a run that goes nowhere is stopped."""

    patience: Annotated[int, at_least(1)] = 10
    """Number of steps in a row whose loss or gradient is infinite or not a number, after which the run is stopped with
    an error; until then such steps are skipped. More wait longer."""
    blind: Annotated[int, at_least(1)] = 50
    """Number of batches in a row in which every pixel is black, saturated or masked, after which the run is stopped
    with an error. More wait longer."""
    constant: Annotated[int, at_least(1)] = 200
    """Number of batches in a row in which the network gives nearly one distance everywhere although brightness varies,
    after which the run is stopped with an error. More wait longer."""


_CONSTANT = 0.01
"""Of the closed form's standard deviation, below which a distance counts as constant."""


class Diagnosis(pl.Callback):
    """Skips a step whose gradient is no number, and stops the run, saying why, when it does not get better.

    A distance counts as constant when its log varies by less than a hundredth of the closed form's. `names` gives the
    frames of a batch, as far as they are known, from epoch and batch index.
    """

    def __init__(self, config: DiagnosisConfig, names: Callable[[int, int], list[str]]) -> None:
        self.config, self.names = config, names
        self.skipped = 0
        self._row: Counter[str] = Counter()
        self._bad = ""

    def state_dict(self) -> dict[str, object]:
        return {"skipped": self.skipped, "row": dict(self._row)}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self.skipped, self._row = int(state_dict["skipped"]), Counter(state_dict["row"])

    def on_train_batch_start(
        self, trainer: pl.Trainer, module: pl.LightningModule, batch: FrameBatch, batch_idx: int
    ) -> None:
        self._bad = ""

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, module: pl.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        gradients = {name: p.grad for name, p in module.named_parameters() if p.grad is not None}
        finite = [torch.isfinite(gradient).all() for gradient in gradients.values()]
        if not finite or torch.stack(finite).all():  # a GPU is waited for once, not for each of them
            return
        self._bad = list(gradients)[[bool(each) for each in finite].index(False)]
        if getattr(trainer.precision_plugin, "scaler", None) is None:  # a scaler skips such steps by itself
            for parameter in module.parameters():
                parameter.grad = None

    @torch.no_grad()
    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: FrameBatch, batch_idx: int
    ) -> None:
        usable = informative(batch.image, batch.mask)
        assert isinstance(module, LightDepth), type(module)
        white = usable & (brightness(batch.image) >= module.loss_config.white)
        spread = masked_std(outputs["distance"].log(), usable)
        # The closed form takes longer than all the rest, and hardly ever has to be asked.
        never = (spread >= _CONSTANT * most_spread(batch.image, batch.light)).any()
        told = [torch.isfinite(outputs["loss"]).all(), (usable & ~white).any(), never]
        finite, seen, varies = torch.stack(told).tolist()
        wrong = bool(self._bad) or not finite
        self.skipped += wrong
        where = self._where(trainer, batch_idx)
        if self._in_a_row("number", wrong) >= self.config.patience:
            raise PartialFailure(
                f"training: {self.config.patience} steps in a row without a finite gradient, the last {where}: "
                f"{_not_finite(batch, outputs, module, self._bad)}. Lower model.learning_rate, train in precision "
                "32-true, or leave those frames out; the checkpoints until here are kept"
            )
        if self._in_a_row("blind", not seen) >= self.config.blind:
            inside = batch.mask.sum().clamp(min=1)
            raise InputError(
                "training",
                f"no usable pixel in {self.config.blind} batches in a row, the last {where}: "
                f"{float(white.sum() / inside):.0%} of the pixels are saturated, "
                f"{float((batch.mask & ~usable).sum() / inside):.0%} black, {float(1 - batch.mask.float().mean()):.0%} "
                "outside the mask",
                "expected images that show the decline of light: check exposure, mask and image folder",
            )
        flat, expected = False, spread
        if not varies:
            expected = masked_std(log_closed_form(batch.image, batch.mask, batch.rays, batch.light), usable)
            flat = bool(((spread < _CONSTANT * expected) & (expected > 0.05)).all())
        if self._in_a_row("constant", flat) >= self.config.constant:
            raise PartialFailure(
                f"training: distance has been constant for {self.config.constant} batches, the last {where}: its log "
                f"varies by {float(spread.mean()):.2g}, the closed form's by {float(expected.mean()):.2g}. The network "
                "has collapsed: lower model.loss.smoothness or model.learning_rate; the checkpoints until here are kept"
            )

    def _in_a_row(self, what: str, happened: bool) -> int:
        self._row[what] = self._row[what] + 1 if happened else 0
        return self._row[what]

    def _where(self, trainer: pl.Trainer, batch_idx: int) -> str:
        names = self.names(trainer.current_epoch, batch_idx)
        shown = f" ({', '.join(names)})" if names else ""
        return f"step {trainer.global_step}, batch {batch_idx} of epoch {trainer.current_epoch}{shown}"


def _not_finite(batch: FrameBatch, outputs: Any, module: pl.LightningModule, gradient: str) -> str:
    """The first thing that is not a number, in the order in which it would spread."""
    if not torch.isfinite(batch.image).all():
        return "the image has pixels that are not numbers"
    broken = [name for name, value in module.named_parameters() if not torch.isfinite(value).all()]
    if broken:
        return f"weights {broken[0]} are not numbers"
    if not torch.isfinite(outputs["distance"]).all():
        return "the predicted distance is not a number"
    terms = [name for name, value in outputs["terms"].items() if not torch.isfinite(value)]
    if terms:
        return f"loss term{'s' if len(terms) > 1 else ''} {', '.join(terms)} not a number"
    return f"the gradient of {gradient} is not a number, though the loss is"


def validation_line(metrics: Any) -> str:
    """The label-free loss, and the errors of network and closed form where there is truth."""
    line = f"validation loss {_number(metrics.get('val/loss'))}"
    if "val/abs_rel_median" in metrics:
        for prefix, who in (("val/", "network"), ("val/closed_form/", "closed form")):
            abs_rel, rmse, medae = (
                _number(metrics.get(f"{prefix}{name}_median")) for name in ("abs_rel", "rmse_mm", "medae_mm")
            )
            line += f"  {who} AbsRel {abs_rel} RMSE {rmse} mm MedAE {medae} mm"
        line += "  (median-aligned)"
    return line


def _number(value: Any) -> str:
    return "-" if value is None else f"{float(value):.4g}"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
