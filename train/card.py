"""The card of a checkpoint: what it was trained on, with which settings, and how well it does."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TypedDict

from lightdepth.losses import LossConfig
from lightdepth.network import NetworkConfig


def chosen_said(measure: str) -> str:
    """What errors are worth on frames that chose the checkpoint, in two sentences."""
    return (
        f"These frames also chose the checkpoint, the one with their least {measure}: errors on them flatter it. "
        "To see how good it is, predict and evaluate frames with truth that were used neither to train nor to choose."
    )


class Sparsification(TypedDict):
    """Areas between the sparsification curve and the best one there could be, as shares of a random order's."""

    mean: float
    rms: float


class Doubt(TypedDict):
    """The calibration of an uncertainty head, and how good it is on the frames that it was found on."""

    exponent: float
    scale: float
    sparsification: Sparsification
    coverage: dict[str, float]
    frames: int


@dataclass(frozen=True, kw_only=True)
class Card:
    """What the cards of trained and of adapted checkpoints share."""

    trained_on: str
    """what the network learned from, in words"""
    rows: int
    """rows of the images that it is run at"""
    steps: int
    """number of training steps"""
    seed: int
    """number that drew weights, order and augmentation"""
    checkpoint: str
    """which checkpoint of the run it is: best or last"""
    network: NetworkConfig
    """how the network is built"""
    loss: LossConfig
    """what was minimised"""
    errors: Mapping[str, float]
    """errors on the validation frames, by name"""
    version: str
    """version of this program"""
    uncertainty: Doubt | None = None
    """how good its uncertainty is, where it has a calibrated one"""
    chosen_by: str = ""
    """the measure that chose this checkpoint on the validation frames; empty where they chose nothing"""

    def record(self) -> dict[str, object]:
        """As the file of a model holds it."""
        return {
            "trained_on": self.trained_on,
            "rows": self.rows,
            "steps": self.steps,
            "seed": self.seed,
            "checkpoint": self.checkpoint,
            "network": self.network.to_dict(),
            "loss": asdict(self.loss),
            "errors": dict(self.errors),
            "version": self.version,
        }

    def text(self, name: str) -> str:
        """The card as a page to read."""
        errors, shown = self.errors, ("steps", "seed", "checkpoint", "rows", "version")
        lines = [f"# {name}", "", self.trained_on, "", *(f"- {key}: {getattr(self, key)}" for key in shown)]
        lines += [
            f"- network: `{json.dumps(self.network.to_dict())}`",
            f"- loss: `{json.dumps(asdict(self.loss))}`",
            "",
        ]
        if "abs_rel_median" in errors:
            lines += ["On the validation frames, depth median-aligned per frame:", ""]
            lines += ["| | AbsRel | RMSE mm | MedAE mm | share within 1.25 |", "|---|---|---|---|---|"]
            for prefix, who in (("", "network"), ("closed_form/", "closed form")):
                values = [errors[f"{prefix}{key}_median"] for key in ("abs_rel", "rmse_mm", "medae_mm", "delta1")]
                lines.append(f"| {who} | " + " | ".join(f"{value:.3f}" for value in values) + " |")
        else:
            lines.append(f"Validation loss (no truth): {errors.get('loss', math.nan):.4f}")
        if self.chosen_by:
            lines += ["", chosen_said(self.chosen_by)]
        if self.uncertainty is not None:
            found = self.uncertainty["sparsification"]
            shares = ", ".join(f"{level}: {share:.1%}" for level, share in self.uncertainty["coverage"].items())
            lines += [
                "",
                f"Uncertainty, calibrated on those frames: sparsification error {found['mean']:.2f} (mean error), "
                f"{found['rms']:.2f} (RMS) of a random order's; share of pixels inside the intervals of {shares}.",
            ]
        return "\n".join(lines) + "\n"
