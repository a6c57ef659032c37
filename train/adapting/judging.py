"""Whether the adapted network is better than the one it started from, on frames or points that taught nothing.

It is judged by true distance or, without that, by blocks of wall (train.adapting.wall_judge). The loss judges nothing:
it says how well the light explains the images, and it can fall while distance gets worse. Where neither is there, or
the map is too poor to tell, the verdict is that nothing judged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame, readable
from lightdepth.models import DepthModel, NetworkModel
from lightdepth.module import MIN_RAY_Z
from lightdepth.reporting.report import number

from ..datamodule import FrameDataModule
from ..frame_sets import held_out_count
from ..running import trainer_of_one
from .module import Adaptation
from .wall_judge import WallErrors, WallJudge, compared

Criterion = Literal["truth", "map", "none"]
Word = Literal["better", "not better", "worse", "not judged"]

MOST_INCONSISTENT = 3.0
"""Times the start's inconsistency, above which an adapted network is not accepted, whatever the map says."""
MOST_INCONSISTENT_UNJUDGED = 1.25
"""The same where nothing judged."""
_SURE = 2.5  # standard deviations by which blocks of wall must err less
_FRAMES_WORSE = 0.02  # share by which held-out frames may err more
_NAMES = {"truth": "AbsRel of the held-out frames with truth", "map": "error at withheld blocks of wall"}


@dataclass(frozen=True)
class Judgement:
    """How good a model is on held-out frames."""

    errors: Mapping[str, float]
    """errors by name, as validation gives them"""
    truth: float | None = None
    """AbsRel of depth, median-aligned per frame, where the held-out frames have truth"""
    wall: WallErrors | None = None
    """errors at blocks of wall, where there is a map"""

    @property
    def at_wall(self) -> float | None:
        """Median error at the map's points that judge, where there are any."""
        return None if self.wall is None else self.wall.median

    def record(self) -> dict[str, float | None]:
        """For run.json."""
        return {"truth": self.truth, "map": self.at_wall, **self.errors}


@dataclass(frozen=True)
class Verdict:
    """Start and adapted network by the judge, and what follows from it."""

    criterion: Criterion
    """what judged"""
    word: Word
    """what it came to"""
    before: float | None = None
    """the judge's number for the start"""
    after: float | None = None
    """the judge's number for the adapted network"""
    why: str = ""
    """what decided, in words, besides the numbers"""
    accepted: bool = False
    """whether the network may be used in place of the start"""

    @property
    def better(self) -> bool:
        return self.word == "better"

    @property
    def caution(self) -> str:
        """What the judge's numbers cannot say, in a sentence; empty where nothing judged."""
        if self.criterion == "none":
            return ""
        what = "held-out frames" if self.criterion == "truth" else "blocks of wall"
        return (
            f"The same {what} decided whether the network is kept, so that the numbers of a kept one are a little too "
            "good: for numbers to quote, run `evaluate` on a sequence that adapting never saw"
        )

    def __str__(self) -> str:
        if self.criterion == "none":
            return f"Not judged: {self.why}"
        return f"{_NAMES[self.criterion]} {number(self.before)} -> {number(self.after)}{self.why}: {self.word}"


@dataclass(frozen=True)
class Outcome:
    """What adapting came to."""

    before: Judgement
    """how good the start is"""
    after: Judgement
    """how good the adapted network is"""
    closed_form: Judgement
    """how good the closed form is, by what judges"""
    verdict: Verdict
    """which of them is better"""
    keep_worse: bool
    """whether the model is written even where it is not accepted"""

    @property
    def written(self) -> bool:
        """Whether the model is worth a file."""
        return self.verdict.accepted or self.keep_worse

    def kept(self, start: str) -> str:
        """What became of the model, in words; `start` is the name of the one that it started from."""
        if self.verdict.accepted:
            return "The model was written"
        if self.keep_worse:
            return "The model was written all the same, as --keep-worse asks"
        return f"No model was written: nothing better than {start} was found. --keep-worse writes it"


def verdict(before: Judgement, after: Judgement, unjudged: str) -> Verdict:
    """By truth where there is any, else by blocks of wall; `unjudged` says why there are none of these."""
    if before.truth is not None:
        return _by_truth(before.truth, math.nan if after.truth is None else after.truth)
    unsteady = _unsteady(before, after)
    if before.wall is not None and after.wall is not None:
        found = _by_wall(before.wall, after.wall, unsteady)
        if found is not None:
            return found
        unjudged = "the map has too few points to judge"
    why = f"{unjudged}. A lower loss does not say that distance got better"
    rise = unsteady > MOST_INCONSISTENT_UNJUDGED
    if rise:
        why += f". Its inconsistency rose to {_times(unsteady)} the start's, so it is not accepted"
    return Verdict("none", "not judged", why=why, accepted=not rise)


def _by_truth(before: float, after: float) -> Verdict:
    word: Word = "better" if after < before else "not better" if after == before else "worse"
    return Verdict("truth", word, before, after, _percent(before, after), word == "better")


def _by_wall(before: WallErrors, after: WallErrors, unsteady: float) -> Verdict | None:
    change = compared(before, after)
    if change is None:
        return None
    shared = sorted(before.frames.keys() & after.frames.keys())
    frames = _mean_change([before.frames[k] for k in shared], [after.frames[k] for k in shared])
    why = f" ({100 * change.change:+.1f} ± {100 * change.deviation:.1f} % over {change.blocks} blocks"
    why += ")" if frames is None else f"; held-out frames {100 * frames:+.1f} %)"
    word: Word = "not better"
    if change.change > change.deviation:
        word = "worse"
    elif change.change < -_SURE * change.deviation and (frames is None or frames <= _FRAMES_WORSE):
        word = "better"
    if word == "better" and not unsteady <= MOST_INCONSISTENT:
        word = "not better"
        why += f", but its inconsistency rose to {_times(unsteady)} the start's"
    return Verdict("map", word, change.before, change.after, why, word == "better")


def _unsteady(before: Judgement, after: Judgement) -> float:
    """Times the start's inconsistency that the adapted network's is."""
    first, second = before.errors.get("inconsistency", 0.0), after.errors.get("inconsistency", 0.0)
    if not math.isfinite(second):
        return math.inf
    return second / first if first > 0 else 1.0 if second <= 0 else math.inf


def _times(ratio: float) -> str:
    return f"{ratio:.2g} times" if math.isfinite(ratio) else "many times"


def _percent(before: float, after: float) -> str:
    change = 100 * (after / before - 1) if before > 0 else math.nan
    return f" ({change:+.1f} %)" if math.isfinite(change) else ""


def _mean_change(before: Sequence[float], after: Sequence[float]) -> float | None:
    if not before or not sum(before) > 0:
        return None
    return sum(after) / sum(before) - 1


def parted(frames: FrameSequence, share: float) -> tuple[FrameSequence, FrameSequence]:
    """The frames to learn from, and those at the end that judge, as FrameDataModule parts them."""
    first = len(frames) - held_out_count(len(frames), share)
    if first < 1:
        raise InputError(frames.source, f"{len(frames)} frame", "expected at least two, one of them to judge by")
    return frames[:first], frames[first:]


def true_error(held: FrameSequence, model: DepthModel) -> float | None:
    """Mean AbsRel of depth over the held-out frames with truth, one median scale each; None where none has any."""
    read = readable(held, range(len(held)))
    found = [error for frame in read if (error := _abs_rel(frame, model)) is not None]
    return float(np.mean(found)) if found else None


def _abs_rel(frame: Frame, model: DepthModel) -> float | None:
    if frame.true_distance is None:
        return None
    prediction, z = model(frame), frame.camera.rays()[0][..., 2]
    valid = prediction.valid & (frame.true_distance > 0) & (z > MIN_RAY_Z)
    if not valid.any():
        return None
    ratio = frame.true_distance[valid] / prediction.distance[valid]  # depth's is the same: both are times z
    return float(np.abs(np.median(ratio) / ratio - 1).mean())


def looked_at(model: DepthModel, held: FrameSequence, wall: WallJudge | None) -> Judgement:
    """A model against truth and at the map's blocks."""
    return Judgement({}, true_error(held, model), None if wall is None else wall.errors(model))


def judged(
    module: Adaptation, data: FrameDataModule, model: NetworkModel, held: FrameSequence, wall: WallJudge | None
) -> Judgement:
    """Errors of the module on the validation frames, and of the model, the same network, against truth and at the
    map's blocks."""
    found = trainer_of_one().validate(module, datamodule=data, verbose=False)[0]
    errors = {name.removeprefix("val/"): float(value) for name, value in found.items()}
    model.network.eval()
    return replace(looked_at(model, held, wall), errors=errors)
