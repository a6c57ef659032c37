"""Whether the adapted network is better than the one it started from, on frames that nothing was learned from.

It is judged by the most trustworthy of three: true distance; those of the map's points that no training sees; the loss,
which needs neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import lightning.pytorch as pl

from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.light.views import LightView, map_views, withheld_error
from lightdepth.models import DepthModel, NetworkModel
from lightdepth.reporting.report import number
from lightdepth.reporting.run import Run
from lightdepth.sparse_map import SparseMap

from ..datamodule import FrameDataModule, held_out_count
from .module import Adaptation

LEAST_VIEWS = 3
"""Held-out keyframes below which the map's other keyframes judge too."""
_NAMES = {
    "truth": "AbsRel of the held-out frames with truth",
    "map": "median error at the map's points",
    "label_free": "held-out self-supervised loss",
}
_KEYS = {"truth": "abs_rel_median", "label_free": "loss"}


@dataclass(frozen=True)
class Judgement:
    """How good a model is on held-out frames."""

    errors: Mapping[str, float]
    """errors by name, as validation gives them"""
    at_points: float | None
    """median error at the points of a map, where there is a usable one"""

    def by(self, criterion: str) -> float | None:
        """The criterion's value, or None where it cannot be had."""
        return self.at_points if criterion == "map" else self.errors.get(_KEYS[criterion])

    def record(self) -> dict[str, float | None]:
        """For run.json."""
        return {"map": self.at_points, **self.errors}


@dataclass(frozen=True)
class Verdict:
    """Start and adapted network by the most trustworthy criterion there is."""

    criterion: str
    """truth, map or label_free"""
    before: float
    """the criterion's value for the start"""
    after: float
    """the criterion's value for the adapted network"""

    @property
    def better(self) -> bool:
        return self.after <= self.before  # false where it is not a number

    def __str__(self) -> str:
        word = "better or equal" if self.better else "worse"
        change = 100 * (self.after / self.before - 1) if self.before else math.nan
        return f"{_NAMES[self.criterion]} {number(self.before)} -> {number(self.after)} ({change:+.1f} %): {word}"


@dataclass(frozen=True)
class Outcome:
    """What adapting came to."""

    before: Judgement
    """how good the start is"""
    after: Judgement
    """how good the adapted network is"""
    closed_form_at_points: float | None
    """median error of the closed form at the map's points, where there is a usable map"""
    keep_worse: bool
    """whether the model is written even where it got worse"""

    @property
    def verdict(self) -> Verdict:
        return verdict(self.before, self.after)

    @property
    def written(self) -> bool:
        """Whether the model is worth a file."""
        return self.verdict.better or self.keep_worse


def verdict(before: Judgement, after: Judgement) -> Verdict:
    """By truth where there is any, else by the map's points, else by the loss."""
    for criterion in _NAMES:
        first, second = before.by(criterion), after.by(criterion)
        if first is not None:
            return Verdict(criterion, first, math.nan if second is None else second)
    raise AssertionError("the loss is always there")


def parted(frames: FrameSequence, share: float) -> tuple[FrameSequence, FrameSequence]:
    """The frames to learn from, and those at the end that judge, as FrameDataModule parts them."""
    first = len(frames) - held_out_count(len(frames), share)
    if first < 1:
        raise InputError(frames.source, f"{len(frames)} frame", "expected at least two, one of them to judge by")
    return frames[:first], frames[first:]


def judging_views(run: Run, frames: FrameSequence, held: FrameSequence, sparse_map: SparseMap) -> list[LightView]:
    """Keyframes whose points judge: held-out ones, or of the whole sequence where these are few."""
    views = map_views(held, sparse_map, frames[0].camera)
    if len(views) >= LEAST_VIEWS:
        return views
    run.log(f"{len(views)} keyframes of the map are held-out frames: all of its keyframes judge")
    return map_views(frames, sparse_map, frames[0].camera)


def map_error(views: Sequence[LightView], model: DepthModel) -> float | None:
    """Median error of a model at the points of a map; None where there are no points or it is not a number."""
    if not views:
        return None
    error = withheld_error(views, model, views[0].frame.light)
    return error if math.isfinite(error) else None


def judged(module: Adaptation, data: FrameDataModule, model: NetworkModel, views: Sequence[LightView]) -> Judgement:
    """Errors of the module on the validation frames, and of the model, the same network, at the map's points."""
    trainer = pl.Trainer(
        devices=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    found = trainer.validate(module, datamodule=data, verbose=False)[0]
    errors = {name.removeprefix("val/"): float(value) for name, value in found.items()}
    model.network.eval()
    return Judgement(errors, map_error(views, model))
