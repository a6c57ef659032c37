"""What TensorBoard shows of a training run, besides the curves that the module logs.

Charts of its tab *Custom Scalars*: the terms of the loss, and each error of the network beside the closed form's. The
same frames at every validation, each a row of labelled panels; the decline of light on them; and the settings, under
*HParams*.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

import cv2
import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from lightdepth.decline import informative, log_closed_form
from lightdepth.frame import FrameBatch
from lightdepth.losses import masked_median, render_image
from lightdepth.module import LightDepth
from lightdepth.photometry import brightness
from lightdepth.reporting.figures import chart

from .datamodule import FrameDataModule

_WORST = 0.4
"""Of log distance, from which on a residual has its full colour."""
_SCALE = 2
"""Pixels of a panel for each of the image, so that its label can be read."""
_STRIP = 18
_POINTS = 4000  # of each frame in the plot of decline
CHARTS = {
    "loss and its terms": {
        "training": ["Multiline", [r"train/(?!frames_per_s|waiting_share)\w+$"]],
        "validation": ["Multiline", [r"val/(?!.*_median)\w+$"]],
    },
    "errors of the network and the closed form": {
        error: ["Multiline", [f"val/{error}_median$", f"val/closed_form/{error}_median$"]]
        for error in ("abs_rel", "rmse_mm", "medae_mm")
    },
}
"""Which curves stand in one chart of *Custom Scalars*: patterns of their names."""


def opening(logger: object, folder: Path) -> str:
    """The command that shows the curves of a run in `folder`; empty where they are logged otherwise."""
    if not isinstance(logger, TensorBoardLogger):
        return ""
    return f"curves: tensorboard --logdir {quote(str(folder / 'tensorboard'))}"


def hyper_parameters(
    model: LightDepth, data: FrameDataModule, options: Mapping[str, object], seed: int
) -> dict[str, str | float]:
    """Settings to compare runs by, with no name of a file among them."""
    network = model.network.config
    chosen: dict[str, object] = {
        "network": network.kind,
        "learning_rate": model.learning_rate,
        "weight_decay": model.weight_decay,
        "schedule": model.schedule,
        "batch_size": data.batch_size,
        "width": data.size[0],
        "height": data.size[1],
        "seed": seed,
        "colons": data.tube.scenes,
        "train_frames": data.counts["train"],
        **{name: options[name] for name in ("max_steps", "max_epochs", "precision") if options.get(name) is not None},
        **{f"loss.{name}": value for name, value in asdict(model.loss_config).items()},
    }
    plain = (str, int, float)
    return {name: value if isinstance(value, plain) else str(value) for name, value in chosen.items()}


class Seen(NamedTuple):
    """Frames of a batch with what is said of their log distance, each (B, 1, H, W) and centred on its median."""

    distance: Tensor
    closed_form: Tensor
    truth: Tensor
    residual: Tensor
    """from the truth; of a frame without any, from the closed form"""
    has_truth: list[bool]

    @classmethod
    def of(cls, distance: Tensor, batch: FrameBatch) -> Seen:
        closed = log_closed_form(batch.image, batch.mask, batch.rays, batch.light)
        truth = batch.true_distance.clamp(min=1e-6).log()
        known = batch.true_valid & batch.mask
        masks = (batch.mask, batch.mask, batch.true_valid)
        maps = zip((distance.log(), closed, truth), masks, strict=True)
        predicted, closed, truth = (values - masked_median(values, mask) for values, mask in maps)
        has_truth = known.flatten(1).any(1)
        against = torch.where(has_truth[:, None, None, None], truth, closed)
        where = torch.where(has_truth[:, None, None, None], known, batch.mask)
        residual = predicted - against
        residual = torch.where(where, residual - masked_median(residual, where), 0.0)
        return cls(predicted, closed, truth, residual, has_truth.tolist())


class Board(pl.Callback):
    """Writes to TensorBoard; does nothing with another logger. `images` of the first validation batch are shown."""

    def __init__(self, settings: Mapping[str, str | float], images: int = 4) -> None:
        self.settings, self.images = settings, images

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        logger = trainer.logger
        if not trainer.is_global_zero or not isinstance(logger, TensorBoardLogger):
            return
        logger.log_hyperparams(dict(self.settings))
        logger.experiment.add_custom_scalars(CHARTS)

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
        if trainer.state.fn != "fit":  # the chosen checkpoint is judged at the end, at a step that is not its own
            return
        assert isinstance(module, LightDepth), type(module)
        distance, albedo_hs = module(batch)
        rendered = render_image(distance, albedo_hs, batch, module.loss_config)
        seen = Seen.of(distance.float(), batch)
        count = min(self.images, len(batch.image))
        rows = [row_of(batch, rendered, seen, i) for i in range(count)]
        write, step = logger.experiment, trainer.global_step
        write.add_image("val/images", np.concatenate(rows, 0), step, dataformats="HWC")
        write.add_figure("val/decline", decline(batch, seen, count), step)


def row_of(batch: FrameBatch, rendered: Tensor, seen: Seen, i: int) -> np.ndarray:
    """The labelled panels of a frame, (H, W, 3) uint8."""
    panels = panels_of(batch, rendered, seen, i)
    return np.concatenate([_labelled(panel, label) for label, panel in panels.items()], 1)


def panels_of(batch: FrameBatch, rendered: Tensor, seen: Seen, i: int) -> dict[str, np.ndarray]:
    """The panels of a frame, (H, W, 3) uint8 each, by their labels."""
    mask = _flat(batch.mask[i])
    panels = {
        f"frame {i + 1}": _eight_bits(batch.image[i]),
        "rendered": _eight_bits(rendered[i]),
        "distance": _coloured(seen.distance[i], mask),
        "closed form": _coloured(seen.closed_form[i], mask),
    }
    if seen.has_truth[i]:
        panels["truth"] = _coloured(seen.truth[i], _flat(batch.true_valid[i]))
    else:
        panels["no truth"] = np.zeros_like(panels["rendered"])
    panels["off the truth" if seen.has_truth[i] else "off closed form"] = _signed(seen.residual[i], mask)
    return panels


def decline(batch: FrameBatch, seen: Seen, count: int) -> Any:
    """Linear brightness of the frames' pixels over their distance, predicted and, where it is known, true, with the
    line of the inverse square, which a wall that faces the light follows."""
    figure, axes = chart((6.4, 3.6))
    usable = informative(batch.image, batch.mask)
    light = batch.light.gamma * brightness(batch.image).clamp(min=1e-3).log()
    light = (light - masked_median(light, usable)) / math.log(10)
    told: dict[str, tuple[Tensor, Tensor, str]] = {
        "true": (seen.truth, usable & batch.true_valid, "#c46a1b"),
        "predicted": (seen.distance, usable, "#2a6f97"),
    }
    for name, (log_distance, where, color) in told.items():
        places = [np.flatnonzero(_flat(where[i])) for i in range(count)]
        places = [each[:: max(1, len(each) // _POINTS)] for each in places]
        x = np.concatenate([np.exp(_flat(log_distance[i])).ravel()[p] for i, p in enumerate(places)])
        y = np.concatenate([10 ** _flat(light[i]).ravel()[p] for i, p in enumerate(places)])
        if len(x):
            axes.plot(x, y, ".", color=color, markersize=1, alpha=0.4, label=f"{name} distance", rasterized=True)
    ends = np.array([0.25, 4.0])
    axes.plot(ends, ends**-2.0, color="black", linewidth=1, label="inverse square")
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = [0.25, 0.5, 1, 2, 4]  # those of a decade lie over each other here
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("distance over the frame's median")
    axes.set_ylabel("linear brightness over its median")
    axes.legend(frameon=False, fontsize=8, markerscale=6)
    return figure


def _labelled(panel: np.ndarray, label: str) -> np.ndarray:
    """A panel, enlarged, under its name."""
    height, width = panel.shape[:2]
    large = cv2.resize(panel, (width * _SCALE, height * _SCALE), interpolation=cv2.INTER_NEAREST)
    strip = np.full((_STRIP, large.shape[1], 3), 255, np.uint8)
    cv2.putText(strip, label, (3, _STRIP - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40), 1, cv2.LINE_AA)
    return np.concatenate([strip, large], 0)


def _flat(values: Tensor) -> np.ndarray:
    """(1, H, W) -> (H, W)."""
    result: np.ndarray = values[0].cpu().numpy()
    return result


def _eight_bits(image: Tensor) -> np.ndarray:
    """(3, H, W) in [0, 1] -> (H, W, 3)."""
    result: np.ndarray = (image.float().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    return result


def _coloured(log_distance: Tensor, mask: np.ndarray) -> np.ndarray:
    """(1, H, W) centred log distance in colours, light near, from half to thrice the median; black outside."""
    from matplotlib import colormaps

    level = ((_flat(log_distance.float()) + math.log(2)) / math.log(6)).clip(0, 1)
    result: np.ndarray = (255 * colormaps["magma_r"](level)[..., :3] * mask[..., None]).astype(np.uint8)
    return result


def _signed(residual: Tensor, mask: np.ndarray) -> np.ndarray:
    """(1, H, W) of log distance in colours: red too far, blue too near, white right; black outside."""
    from matplotlib import colormaps

    level = 0.5 + 0.5 * np.clip(_flat(residual.float()) / _WORST, -1, 1)
    result: np.ndarray = (255 * colormaps["bwr"](level)[..., :3] * mask[..., None]).astype(np.uint8)
    return result
