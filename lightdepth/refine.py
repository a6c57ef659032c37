"""One image's distance improved by its own light: no training, no truth.

Notation: t distance, start the distance to begin with (the closed form's or a network's), p_k corrections on grids that
are 2^k times as coarse as the image. What is sought is

    log t = log start + sum_k upsampled(p_k)

with the least self-supervised loss (lightdepth.losses): a coarse grid moves whole walls at once, which pixels alone
would take thousands of steps for. Every grid moves by up to the learning rate at every step, so it has to be small. A
start far from the loss's own optimum gains, and one that is better than it would be pulled there: `anchor` holds it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightdepth.errors import InputError
from lightdepth.frame import Frame, FrameBatch, to_batch
from lightdepth.losses import LossConfig, Seen, indirect_light, self_supervised_loss
from lightdepth.losses.masked import mean_over_images
from lightdepth.models import DepthModel, extended, prediction_of, upsampled, working_size
from lightdepth.prediction import DepthPrediction

_RENEWED = 10
"""Steps for which the light from wall to wall is kept: it changes slowly, and costs as much as all else."""


@dataclass(frozen=True)
class RefineConfig:
    """How an image is refined."""

    steps: int = 100
    """Number of steps of Adam; 0 leaves the start as it is. More follow the light further and take longer."""
    rows: int = 64
    """Height of the image that is worked on, pixels. A larger one corrects finer detail and takes longer."""
    learning_rate: float = 0.01
    """Rate of the first step, in log distance; it falls to zero along half a cosine. A larger one moves farther in as
    many steps."""
    levels: int = 6
    """Number of grids of corrections, each half as fine as the one before. More move larger pieces of wall at
    once."""
    anchor: float = 0.0
    """Weight of |log t - log start|, which holds a good start where it is. A larger one holds it more firmly."""
    loss: LossConfig = field(
        default_factory=lambda: LossConfig(smoothness=50.0, cosine_exponent=0.3, chroma=0.0, reflectance=None)
    )
    """Weights of the terms of the loss that is made small."""

    def __post_init__(self) -> None:
        if self.steps < 0 or self.rows < 8 or self.levels < 1 or self.anchor < 0 or self.learning_rate <= 0:
            raise InputError(
                "refine",
                f"steps {self.steps}, rows {self.rows}, learning_rate {self.learning_rate}, levels {self.levels}, "
                f"anchor {self.anchor}",
                "expected at least 0, 8, above 0, 1 and 0",
            )


def refine(log_start: Tensor, batch: FrameBatch, config: RefineConfig) -> Tensor:
    """log t from log start, both (B, 1, H, W), for the images of the batch; finite wherever the start is."""
    height, width = log_start.shape[-2:]
    grids = [
        log_start.new_zeros(len(log_start), 1, -(-height // 2**k), -(-width // 2**k)).requires_grad_()
        for k in range(config.levels)
    ]
    seen = Seen.of(batch, config.loss)
    indirect = None

    def current() -> Tensor:
        finest, *coarser = grids
        sizes = (F.interpolate(grid, (height, width), mode="bilinear", align_corners=False) for grid in coarser)
        return log_start + sum(sizes, start=finest)

    with torch.inference_mode(False), torch.enable_grad():
        optimizer = torch.optim.Adam(grids, lr=config.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(config.steps, 1))
        for step in range(config.steps):
            log_t = current()
            distance = log_t.exp()
            if step % _RENEWED == 0:
                indirect = indirect_light(distance, batch.rays, batch.mask, batch.light, config.loss)
            total = self_supervised_loss(distance, None, batch, config.loss, seen, indirect)[0]
            if config.anchor > 0:
                total = total + config.anchor * mean_over_images((log_t - log_start).abs(), batch.mask)
            if not torch.isfinite(total):
                break
            optimizer.zero_grad()
            total.backward()  # type: ignore[no-untyped-call]  # torch has no annotation for it
            optimizer.step()
            schedule.step()
        return current().detach()


class RefinedModel:
    """A model whose predictions are refined by the light of their own image. It says nothing of uncertainty."""

    def __init__(self, model: DepthModel, config: RefineConfig) -> None:
        self.model, self.config = model, config
        self.name = f"{model.name}, refined in {config.steps} steps"

    def __call__(self, frame: Frame) -> DepthPrediction:
        """The model's distance times the correction, which is found at `rows` rows and upsampled."""
        start = self.model(frame)
        size = working_size(frame.camera, min(self.config.rows, frame.camera.height))
        batch = to_batch(frame, size)
        whole = torch.from_numpy(start.distance).clamp(min=1e-6).log()[None, None]
        log_start = F.interpolate(whole, (size[1], size[0]), mode="area")
        log_t = refine(log_start, batch, self.config)
        coarse = prediction_of(frame, batch, log_t, None, self.name, start.normals is not None)
        correction = upsampled(extended(log_t - log_start, batch.mask), (frame.camera.width, frame.camera.height))
        return replace(
            start,
            distance=start.distance * np.exp(correction),
            source=self.name,
            normals=coarse.normals,
            uncertainty=None,
        )
