"""What a training run shows while it runs: pictures in TensorBoard, and progress that reads well in a log file too."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from lightdepth.decline import log_closed_form
from lightdepth.frame import FrameBatch
from lightdepth.losses import masked_median, render_image
from lightdepth.module import LightDepth


class Panels(pl.Callback):
    """The first validation images, each a row: image, rendered, log distance, closed form, truth where there is any."""

    def __init__(self, images: int = 4) -> None:
        self.images = images

    @torch.no_grad()
    def on_validation_batch_end(
        self,
        trainer: pl.Trainer,
        module: pl.LightningModule,
        outputs: Any,
        batch: FrameBatch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        logger = trainer.logger
        if batch_idx > 0 or not trainer.is_global_zero or not isinstance(logger, TensorBoardLogger):
            return
        assert isinstance(module, LightDepth), type(module)
        distance, albedo_hs = module(batch)
        rendered = render_image(distance, albedo_hs, batch, module.loss_config)
        closed_form = log_closed_form(batch.image, batch.mask, batch.rays, batch.light)
        truth = batch.true_distance.clamp(min=1e-6).log()
        maps = [(distance.log(), batch.mask), (closed_form, batch.mask), (truth, batch.true_valid)]
        centred = [(values - masked_median(values, mask), mask) for values, mask in maps]
        rows = []
        for i in range(min(self.images, len(batch.image))):
            pictures = [batch.image[i], rendered[i]]
            pictures += [_coloured(values[i, 0], mask[i, 0]) for values, mask in centred]
            rows.append(torch.cat([picture.float().cpu() for picture in pictures], -1))
        logger.experiment.add_image("val/images", torch.cat(rows, -2).clamp(0, 1), trainer.global_step)


class Progress(pl.Callback):
    """One line every `every` steps, with speed and time left, and one per validation. `echo` takes each line."""

    def __init__(self, echo: Callable[[str], None], every: int = 50) -> None:
        self.echo, self.every = echo, every
        self._start, self._first = 0.0, 0

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._start, self._first = time.monotonic(), trainer.global_step

    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: FrameBatch, batch_idx: int
    ) -> None:
        step, total = trainer.global_step, trainer.estimated_stepping_batches
        if step % self.every and step != total:
            return
        rate = (step - self._first) / max(time.monotonic() - self._start, 1e-9)
        line = (
            f"step {step}/{total:.0f}  loss {_number(trainer.callback_metrics.get('train/loss'))}  {rate:.1f} steps/s"
        )
        if math.isfinite(total):
            line += f"  {_clock((total - step) / max(rate, 1e-9))} left"
        self.echo(line)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.training or trainer.state.fn == "fit":
            self.echo(f"step {trainer.global_step}  {validation_line(trainer.callback_metrics)}")


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


def _coloured(log_distance: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """(H, W) centred log distance -> RGB (3, H, W), from half to thrice the median; black outside the mask."""
    from matplotlib import colormaps

    level = ((log_distance.float().cpu().numpy() + math.log(2)) / math.log(6)).clip(0, 1)
    colour = colormaps["magma_r"](level)[..., :3] * mask.cpu().numpy()[..., None]
    return torch.from_numpy(np.ascontiguousarray(colour.transpose(2, 0, 1))).float()
