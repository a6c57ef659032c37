"""The card of a checkpoint that was trained from the start, and its sentences on what it learned from."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from lightdepth.checkpoint import HUB, bundled
from lightdepth.module import LightDepth
from lightdepth.network.pretrained import IMAGENET
from lightdepth.reporting.same import input_hash

from .card import Card
from .colons import TubeData
from .datamodule import FrameDataModule
from .watching import FitConfig


@dataclass(frozen=True, kw_only=True)
class TrainedCard(Card):
    """The card of a checkpoint that was trained from the start."""

    fit: FitConfig
    """how the run was watched, averaged and stopped"""
    tube: TubeData | None
    """synthetic colons that it was trained or validated on, if any"""

    def record(self) -> dict[str, object]:
        shared = super().record()
        errors, version = shared.pop("errors"), shared.pop("version")
        own = {
            "fit": asdict(self.fit),
            "uncertainty": self.uncertainty,
            "tube": None if self.tube is None else asdict(self.tube),
        }
        return {**shared, **own, "errors": errors, "version": version}


def trained_on(model: LightDepth, data: FrameDataModule) -> str:
    tube = data.tube
    parts = [f"{len(data.sequences)} sequences{_of_split(data.split)}"] if data.sequences else []
    if tube.scenes:
        parts.append(f"{tube.scenes} synthetic colons of {tube.frames} frames each")
    truth = "with true distance in the loss" if model.loss_config.supervised > 0 else "no truth in the loss"
    if model.loss_config.uncertainty > 0:
        truth += " of distance; the uncertainty head alone learned from true distance"
    return f"{' and '.join(parts)}, {data.size[0]}x{data.size[1]} pixels; {truth}.{_began_with(model)}"


def _began_with(model: LightDepth) -> str:
    """What others trained, in a sentence, and thereby which images it saw besides; a file is told by its hash, as its
    name may be a patient's."""
    said, (encoder, start) = "", model.began_with
    if encoder is not None:
        what = "ImageNet" if encoder == IMAGENET else f"the file {input_hash(Path(encoder))[:8]}"
        said = f" Its encoder began with the weights of {what}."
    if start is not None:
        named = start in bundled() or start.startswith(HUB)
        what = start if named else f"the checkpoint {input_hash(Path(start))[:8]}"
        said += f" All its weights began with those of {what}."
    return said


def shared_by(model: LightDepth, data: FrameDataModule, processes: int, synchronised: bool) -> str:
    """A sentence on how processes shared the work; none where there was one."""
    if processes == 1:
        return ""
    own = ""
    if any(isinstance(layer, torch.nn.BatchNorm2d) for layer in model.modules()):
        own = ", batch statistics of " + ("all together" if synchronised else "each one's own frames")
    return f" {processes} processes, batches of {data.batch_size} in each{own}."


def _of_split(split: str | None) -> str:
    """The split's data set and name: comparisons are only between models of the same one."""
    if split is None:
        return ""
    path = Path(split).resolve()
    return (
        f" of the split {path.parent.parent.name}/{path.stem}" if path.parent.name == "splits" else f" of {path.name}"
    )
