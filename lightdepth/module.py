"""LightDepth as a LightningModule: wires network, losses, optimiser and logging. It has no formula of its own."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.optim.lr_scheduler import OneCycleLR

from lightdepth.decline import log_closed_form
from lightdepth.frame import FrameBatch
from lightdepth.geometry import depth_from_distance
from lightdepth.losses import LossConfig, self_supervised_loss, training_loss
from lightdepth.metrics import DepthErrors
from lightdepth.network import NetworkConfig, build_network

_NETWORK, _LOSS = NetworkConfig(), LossConfig()
_MIN_RAY_Z = 0.15  # beyond 81 degrees from the axis, depth says little about distance


class _OneCycle(OneCycleLR):
    """OneCycleLR whose length is this run's, not the one in the checkpoint: a resumed run may be longer."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict({k: v for k, v in state_dict.items() if k not in ("total_steps", "_schedule_phases")})


class LightDepth(pl.LightningModule):
    """Trains a depth network. Hyper-parameters are plain values: checkpoints load without pickle.

    Args:
        network: which network.
        loss: weights of the loss terms.
        learning_rate: the highest, in the middle of one cycle.
        weight_decay: of AdamW.
        rows: image height it is trained at [pixels]; predictions are made at it.
    """

    def __init__(
        self,
        network: NetworkConfig = _NETWORK,
        loss: LossConfig = _LOSS,
        learning_rate: float = 2e-3,
        weight_decay: float = 1e-2,
        rows: int = 128,
    ) -> None:
        super().__init__()
        # Lightning hands back the plain values of a checkpoint.
        network = NetworkConfig.from_dict(network) if isinstance(network, dict) else network
        loss = LossConfig(**loss) if isinstance(loss, dict) else loss
        plain = {"learning_rate": learning_rate, "weight_decay": weight_decay, "rows": rows}
        self.save_hyperparameters({"network": network.to_dict(), "loss": asdict(loss), **plain}, logger=False)
        self.loss_config = loss
        self.learning_rate, self.weight_decay, self.rows = learning_rate, weight_decay, rows
        self.network = build_network(network)
        self.errors = DepthErrors("median")
        self.closed_form_errors = DepthErrors("median")

    def forward(self, batch: FrameBatch) -> tuple[Tensor, Tensor]:
        """Distance (B, 1, H, W) and albedo as hue and saturation (B, 2, H, W)."""
        return self.network(batch.image, batch.mask, batch.rays, batch.light)

    def training_step(self, batch: FrameBatch, batch_idx: int) -> Tensor:
        distance, albedo_hs = self(batch)
        total, terms = training_loss(distance, albedo_hs, batch, self.loss_config)
        self.log("train/loss", total)
        self.log_dict({f"train/{name}": value for name, value in terms.items()})
        return total

    def validation_step(self, batch: FrameBatch, batch_idx: int) -> None:
        distance, albedo_hs = self(batch)
        total, terms = self_supervised_loss(distance, albedo_hs, batch, self.loss_config)
        size = len(batch.image)
        self.log("val/loss", total, batch_size=size, sync_dist=True)
        self.log_dict({f"val/{name}": value for name, value in terms.items()}, batch_size=size, sync_dist=True)

        ray_z = batch.rays[:, 2:3]
        truth = depth_from_distance(batch.true_distance, ray_z)
        valid = batch.true_valid & (ray_z > _MIN_RAY_Z)
        closed_form = log_closed_form(batch.image, batch.mask, batch.rays, batch.light).exp()
        self.errors.update(depth_from_distance(distance, ray_z), truth, valid)
        self.closed_form_errors.update(depth_from_distance(closed_form, ray_z), truth, valid)

    def on_validation_epoch_end(self) -> None:
        for prefix, metric in (("val/", self.errors), ("val/closed_form/", self.closed_form_errors)):
            if metric.frames > 0:
                self.log_dict({prefix + name: value.float() for name, value in metric.compute().items()})
            metric.reset()

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay)
        total = int(self.trainer.estimated_stepping_batches)
        schedule = _OneCycle(optimizer, max_lr=self.learning_rate, total_steps=total)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
