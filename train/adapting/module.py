"""Adapting a network to another endoscope or organ without truth: what learns, what is minimised, what may not be lost.

Notation: t distance of the network, t_start that of the checkpoint it started from, on the same image. The loss is the
self-supervised one, free of gain, on frames of the target; on top of it

    anchor · mean |r - median r|,  r = log t - log t_start          (the start's shape holds, its scale need not)

and in the second half of each batch, where there is replay, synthetic colons with the loss that the start learned from.
Where a map teaches (train.adapting.map_teacher), its two terms come on top, from one or two more images in every step.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.utils import parametrize

from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch
from lightdepth.losses import LossConfig, masked_median, mean_over_images
from lightdepth.models import NetworkModel
from lightdepth.module import LightDepth
from lightdepth.network import DepthNetwork
from lightdepth.network.model import full_precision
from train.adapting.map_teacher import MapTeacher, map_terms

What = Literal["all", "decoder", "norms", "low_rank"]
WHAT = ("all", "decoder", "norms", "low_rank")
_ENCODERS = ("stem", "encoder", "backbone")
_NORMS = (nn.GroupNorm, nn.LayerNorm, _BatchNorm)


class LowRank(nn.Module):
    """W + up · down, of rank at most `rank`, as a parametrisation of a weight (outputs, ...); at first it adds zero."""

    def __init__(self, weight: Tensor, rank: int, generator: torch.Generator | None = None) -> None:
        super().__init__()
        outputs, inputs = weight.shape[0], weight[0].numel()
        rank = min(rank, outputs, inputs)
        self.down = nn.Parameter(torch.randn(rank, inputs, generator=generator) / inputs**0.5)
        self.up = nn.Parameter(torch.zeros(outputs, rank))

    def forward(self, weight: Tensor) -> Tensor:
        return weight + (self.up @ self.down).reshape(weight.shape)


def let_learn(network: DepthNetwork, what: What, rank: int = 4, generator: torch.Generator | None = None) -> int:
    """Freezes all of the network but what is named; returns the number of weights that learn.

    all but the uncertainty head; decoder: all behind the encoder; norms: scale and shift of the normalisations;
    low_rank: an addition of that rank to each convolution and linear layer, drawn from the generator.
    """
    if what not in WHAT or rank < 1:
        raise InputError(
            "what, rank", f"{what!r}, {rank}", f"expected one of {', '.join(WHAT)} and a rank of at least 1"
        )
    network.requires_grad_(False)
    if what == "all":
        network.body.requires_grad_(True)
    elif what == "decoder":
        for name, part in network.body.named_children():
            part.requires_grad_(name not in _ENCODERS)
    elif what == "norms":
        for part in network.body.modules():
            if isinstance(part, _NORMS):
                part.requires_grad_(True)
    else:
        for part in list(network.body.modules()):
            if isinstance(part, (nn.Conv2d, nn.Linear)):
                parametrize.register_parametrization(part, "weight", LowRank(part.weight, rank, generator))
    return sum(p.numel() for p in network.parameters() if p.requires_grad)


def merge_low_rank(network: DepthNetwork) -> None:
    """Puts low-rank additions into the weights that they were added to, so that the network is a plain one again."""
    for part in list(network.modules()):
        if parametrize.is_parametrized(part, "weight"):
            parametrize.remove_parametrizations(part, "weight", leave_parametrized=True)


def anchor_loss(distance: Tensor, start: Tensor, mask: Tensor) -> Tensor:
    """Mean |log t - log t_start| inside the mask, after each image's median of it is taken out. All (B, 1, H, W)."""
    ratio = distance.log() - start.log()
    return mean_over_images((ratio - masked_median(ratio, mask)).abs(), mask)


class Adaptation(LightDepth):
    """A checkpoint that goes on learning, from images without truth.

    The first frames of a batch are the target's, and their truth is not looked at, if there is any; with `replay` the
    second half are colons of the source. `map_weights` are those of the teacher's terms, by name.
    """

    def __init__(
        self,
        start: NetworkModel,
        loss: LossConfig,
        learning_rate: float,
        rows: int,
        anchor: float = 0.0,
        replay: bool = False,
        what: What = "all",
        rank: int = 4,
        generator: torch.Generator | None = None,
        teacher: MapTeacher | None = None,
        map_weights: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        super().__init__(start.network.config, loss, learning_rate, weight_decay=0.0, rows=rows)
        if not anchor >= 0:
            raise InputError("anchor", f"{anchor}", "expected a weight of at least 0")
        weights = {name: value.detach().cpu().clone() for name, value in start.network.state_dict().items()}
        self.network.load_state_dict(weights)
        self.learning = let_learn(self.network, what, rank, generator)
        self.anchor, self.replay = anchor, replay
        self.teacher, self.map_weights = teacher, map_weights
        self.start = start.network.requires_grad_(False).eval() if anchor > 0 else None

    def batch_loss(self, batch: FrameBatch) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        _hold_still(self)
        count = len(batch.image)
        targets = count - count // 2 if self.replay else count
        known = batch.true_valid.clone()
        known[:targets] = False
        total, terms, distance = super().batch_loss(batch._replace(true_valid=known))
        if self.start is not None:
            with torch.no_grad(), full_precision(self.device):
                inputs = (batch.image, batch.mask, batch.rays, batch.light)
                before = self.start(*inputs)[0][:targets]
            terms["anchor"] = anchor_loss(distance[:targets], before, batch.mask[:targets])
            total = total + self.anchor * terms["anchor"]
        if self.teacher is not None:
            lesson = self.teacher.lesson(self.global_step)
            found = lesson.batch.to(self.device)
            estimated = self.estimate(found).distance
            with full_precision(self.device):
                taught = map_terms(estimated, lesson)
            terms |= {f"map_{name}": value for name, value in taught.items()}
            total = total + sum(self.map_weights.get(name, 0.0) * value for name, value in taught.items())
        return total, terms, distance


def _hold_still(module: nn.Module) -> None:
    """What does not learn does not gather statistics either."""
    for part in module.modules():
        if isinstance(part, _BatchNorm) and not any(p.requires_grad for p in part.parameters()):
            part.eval()
