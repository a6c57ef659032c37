"""What surfaces cost, in time and storage: a sum over keyframes, by whole runs that `lightdepth bench speed` measured.

A run over K keyframes of M megapixels each takes

    fixed + K (keyframe + megapixel M)

seconds, seconds of processors, or bytes; the three numbers, none below 0, are those that fit the measured runs best. A
dry run takes them from speed.json where there is one (LIGHTDEPTH_SPEED names it, else runs/speed), and else from a
table; times of another hour are scaled by how much slower the machine is now. docs/cost.md has what follows.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.optimize import nnls

from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.models import DepthModel
from lightdepth.reporting.plan import seconds_each, slowness, times
from lightdepth.sparse_map import SparseMap

GIVEN, FOUND = "LIGHTDEPTH_SPEED", Path("runs/speed/speed.json")
"""The variable that names a file of measured speeds, and where one is looked for: as `bench speed` writes it."""
MODEL_STEPS = ("read", "predict")
"""Steps that a dry run tries on the spot: the frames are at hand, and so is the model."""
_FIRST = 2.5
"""Seconds, on the machine of the tables, that a process takes to open what meshes and charts are drawn with, once."""
_LIGHT = 26 * 3
"""Predictions that finding a light on the map takes at the most: keyframes, by as many lights."""
_Positive = Annotated[float, Field(gt=0, le=1e15, allow_inf_nan=False)]
_Pixels = Annotated[int, Field(gt=0, le=100_000)]


class WholeRun(BaseModel):
    """A run of densify over one map, from frames and map to its page, in a process that had all modules loaded."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    size: tuple[_Pixels, _Pixels]
    """width and height of its frames"""
    keyframes: Annotated[int, Field(gt=0, le=10**9)]
    seconds: _Positive
    processor: _Positive
    """seconds of all its threads together"""
    bytes: _Positive
    """of its run folder"""
    steps: dict[str, Annotated[float, Field(ge=0, allow_inf_nan=False)]]
    """seconds by step, summed over the keyframes"""

    @property
    def megapixels(self) -> float:
        return self.size[0] * self.size[1] / 1e6

    @property
    def besides(self) -> float:
        """Seconds that are not the model's."""
        return max(0.0, self.seconds - sum(self.steps.get(step, 0.0) for step in MODEL_STEPS))


class SpeedFile(BaseModel):
    """What speed.json must have for costs."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    kind: Literal["bench speed"]
    slowness: Annotated[float, Field(ge=1e-4, le=1e4)]
    """how many times slower the machine was than the one of the tables"""
    runs: Annotated[list[WholeRun], Field(min_length=1)]


@dataclass(frozen=True)
class Cost:
    """What runs take, of one kind: seconds or bytes."""

    fixed: float
    """of a run, whatever it is of"""
    keyframe: float
    """of a keyframe, whatever its size"""
    megapixel: float
    """of a megapixel of a keyframe, besides"""

    def of(self, keyframes: float, megapixels: float, runs: float = 1.0) -> float:
        """Of runs over so many keyframes together, each of so many megapixels."""
        return runs * self.fixed + keyframes * (self.keyframe + self.megapixel * megapixels)

    def times(self, factor: float) -> Cost:
        return Cost(factor * self.fixed, factor * self.keyframe, factor * self.megapixel)


def fitted(runs: Sequence[WholeRun], amount: Callable[[WholeRun], float]) -> Cost:
    """The cost that fits measured runs best, by the least squares of the share that it is off."""
    rows = np.array([[1.0, run.keyframes, run.keyframes * run.megapixels] for run in runs])
    taken = np.array([max(amount(run), 1e-9) for run in runs])
    found, _ = nnls(rows / taken[:, None], np.ones(len(runs)))
    return Cost(*map(float, found))


TABLE = Cost(0.8, 0.35, 0.2)
"""Seconds of a core of what comes after prediction, on the machine of the tables."""


@dataclass(frozen=True)
class Known:
    """What surfaces cost besides their prediction, on this machine now, and by what that is known, in words."""

    cost: Cost
    by: str


def read_speed(path: Path) -> SpeedFile:
    """Raises InputError where it is no file of `bench speed`."""
    return checked_fields(SpeedFile, read_json(path), str(path))


def known_cost() -> Known:
    """By the file that LIGHTDEPTH_SPEED names (InputError where that is none), else by runs/speed/speed.json where it
    can be read, else by the table."""
    given = os.environ.get(GIVEN)
    path = Path(given) if given else FOUND
    if given or path.is_file():
        try:
            file = read_speed(path)
        except InputError as error:
            if given:
                raise error.within(GIVEN) from error
        else:
            return Known(fitted(file.runs, lambda run: run.besides).times(slowness() / file.slowness), f"by {path}")
    return Known(TABLE.times(slowness()), "by a table")


def surfaces_of(sparse_map: SparseMap, frames: FrameSequence) -> str:
    """What surfaces would be made of, in words."""
    submaps = sparse_map.submaps
    keyframes, points = sum(len(s.keyframes) for s in submaps), sum(len(s.points) for s in submaps)
    made = f"{counted(len(submaps), 'submap')} with {counted(keyframes, 'keyframe')} and {counted(points, 'point')}"
    return f"{made}, of {counted(len(frames), 'frame')} of {frames.source}, would be made dense"


def surface_steps(
    sparse_map: SparseMap, frames: FrameSequence, model: DepthModel, fit_light: bool = False, polish: bool = False
) -> list[Step]:
    """The poses where they are polished, prediction, the light where it is to be found, and the surfaces."""
    keyframes = [k for s in sparse_map.submaps for k in s.keyframes if k.number in frames.numbers]
    count, camera = len(keyframes), keyframes[0].camera
    some = dict.fromkeys(frames.numbers.index(k.number) for k in keyframes[:5])
    each = seconds_each(frames.at(list(some)), model)
    steps = [Step(f"polishing the poses of {counted(count, 'keyframe')}")] * polish
    steps.append(Step(f"predicting {counted(count, 'keyframe')} by {model.name}", times(count, each)))
    if fit_light and frames.first().light.assumed:
        steps.append(Step("finding the light on the map, at the most", times(min(_LIGHT, 3 * count), each)))
    known = known_cost()
    fused = known.cost.of(count, camera.width * camera.height / 1e6) + _FIRST * slowness()
    steps.append(Step(f"aligning, judging and fusing, {known.by}, {counted(count, 'keyframe')}", fused))
    return steps
