"""Every stage at every size, timed beside its floor and its reference, and whole runs of densify."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from densify.costs import WholeRun
from densify.speed.given import Given, write_colon
from densify.speed.machine import Kind, Machine, side_by_side
from densify.speed.runs import Size, colons_of, whole_run
from densify.speed.stages import STAGES, Stage
from lightdepth.checkpoint import ModelSource
from lightdepth.models import DepthModel, NetworkModel


@dataclass(frozen=True)
class StageTime:
    """One stage at one size. Times in seconds."""

    name: str
    what: str
    step: str
    """of densify, by its clock; empty where densify does no such thing"""
    operations: Mapping[Kind, float]
    bytes: float
    floor: float
    """the least that this machine can take for it"""
    seconds: float
    """the median of some times"""
    least: float
    rounds: int
    reference: str
    reference_seconds: float
    """the median of as many times"""

    @property
    def ratio(self) -> float:
        """Of the time to the floor."""
        return self.seconds / self.floor

    @property
    def faster(self) -> float:
        """How many times as long the reference takes."""
        return self.reference_seconds / self.seconds


def stages_of(model: DepthModel) -> list[Stage]:
    """Those that there are for a model: without those of networks where it is none."""
    return [stage for stage in STAGES if isinstance(model, NetworkModel) or not stage.network]


def timed_stage(stage: Stage, given: Given, machine: Machine, seconds: float) -> StageTime:
    """A stage and its reference, in turns, for about so many seconds together."""
    load = stage.load(given)
    works = [partial(stage.run, given), partial(stage.plain, given)]
    own, plain = side_by_side(works, seconds, given.device)
    return StageTime(
        name=stage.name,
        what=stage.what,
        step=stage.step,
        operations=load.operations,
        bytes=load.bytes,
        floor=machine.floor(load),
        seconds=float(np.median(own)),
        least=min(own),
        rounds=len(own),
        reference=stage.reference,
        reference_seconds=float(np.median(plain)),
    )


def timed_stages(
    colon: Path, model: DepthModel, machine: Machine, seconds: float, on_stage: Callable[[], None]
) -> list[StageTime]:
    """Every stage on a colon."""
    given, found = Given(colon, model), []
    for stage in stages_of(model):
        found.append(timed_stage(stage, given, machine, seconds))
        on_stage()
    return found


def measured(
    sizes: Sequence[Size],
    keyframes: int,
    model: DepthModel,
    predicting: ModelSource,
    machine: Machine,
    seconds: float,
    folder: Path,
    on_part: Callable[[], None],
) -> tuple[dict[Size, list[StageTime]], list[WholeRun]]:
    """Stages by size, and whole runs, of colons that are made in a folder, which is the caller's to remove. `on_part`
    is told `parts` times that a part is done."""
    stages: dict[Size, list[StageTime]] = {}
    runs = []
    for number, made in enumerate(colons_of(sizes, keyframes)):
        colon = folder / f"colon{number}"
        write_colon(colon, made.size, made.keyframes)
        if not number:  # what a process does once is no run's
            whole_run(colon, folder / "first", model, predicting)
        runs.append(whole_run(colon, folder / f"run{number}", model, predicting))
        on_part()
        if made.staged:
            stages[made.size] = timed_stages(colon, model, machine, seconds, on_part)
    return stages, runs


def parts(sizes: Sequence[Size], model: DepthModel) -> int:
    """How many parts `measured` has."""
    return len(colons_of(sizes, 1)) + len(sizes) * len(stages_of(model))
