"""Every stage at every size, timed beside its floor and its reference, and whole runs of densify."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from densify.costs import WholeRun
from densify.speed.given import Given, write_colon
from densify.speed.machine import Kind, Machine, Taken, side_by_side
from densify.speed.runs import Size, colons_of, whole_run
from densify.speed.stages import STAGES, Stage
from lightdepth.checkpoint import ModelSource
from lightdepth.models import DepthModel, NetworkModel


@dataclass(frozen=True)
class StageTime:
    """One stage at one size."""

    name: str
    what: str
    step: str
    """of densify, by its clock; empty where densify does no such thing"""
    device: str
    operations: Mapping[Kind, float]
    bytes: float
    floor: Taken
    """the least that this machine can take for it"""
    median: Taken
    least: Taken
    rounds: int
    reference: str
    reference_median: Taken
    """of as many times"""

    @property
    def ratio(self) -> float:
        """Of the time by the clock to the floor."""
        return self.median.clock / self.floor.clock

    @property
    def core_ratio(self) -> float:
        """The same by seconds of a core."""
        return self.median.core / self.floor.core

    @property
    def faster(self) -> float:
        """How many times as long the reference takes, by the clock."""
        return self.reference_median.clock / self.median.clock


def stages_of(model: DepthModel) -> list[Stage]:
    """Those that there are for a model: without those of networks where it is none."""
    return [stage for stage in STAGES if isinstance(model, NetworkModel) or not stage.network]


def timed_stage(stage: Stage, given: Given, machines: Sequence[Machine], seconds: float) -> StageTime:
    """A stage and its reference, in turns, for about so many seconds together. Of the machines the first is the
    processor, and the last what the model runs on."""
    load, machine = stage.load(given), machines[-1 if stage.with_model else 0]
    works = [partial(stage.run, given), partial(stage.plain, given)]
    own, plain = side_by_side(works, seconds, given.device)
    return StageTime(
        name=stage.name,
        what=stage.what,
        step=stage.step,
        device=machine.device,
        operations=load.operations,
        bytes=load.bytes,
        floor=Taken(machine.clock.floor(load), machine.core.floor(load)),
        median=_of_each(np.median, own),
        least=_of_each(np.min, own),
        rounds=len(own),
        reference=stage.reference,
        reference_median=_of_each(np.median, plain),
    )


def _of_each(choose: Callable[[Sequence[float]], float], taken: Sequence[Taken]) -> Taken:
    return Taken(float(choose([each.clock for each in taken])), float(choose([each.core for each in taken])))


def timed_stages(
    colon: Path, model: DepthModel, machines: Sequence[Machine], seconds: float, on_stage: Callable[[], None]
) -> list[StageTime]:
    """Every stage on a colon."""
    given, found = Given(colon, model), []
    for stage in stages_of(model):
        found.append(timed_stage(stage, given, machines, seconds))
        on_stage()
    return found


def measured(
    sizes: Sequence[Size],
    keyframes: int,
    model: DepthModel,
    predicting: ModelSource,
    machines: Sequence[Machine],
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
            stages[made.size] = timed_stages(colon, model, machines, seconds, on_part)
    return stages, runs


def parts(sizes: Sequence[Size], model: DepthModel) -> int:
    """How many parts `measured` has."""
    return len(colons_of(sizes, 1)) + len(sizes) * len(stages_of(model))
