"""speed.json and speed.md: stages beside floors and references, whole runs, and what procedures cost by them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from densify.bench.scenes import scenes
from densify.costs import Cost, WholeRun, fitted
from densify.evaluation.tables import Table
from densify.speed.machine import Machine, Rates
from densify.speed.runs import Size
from densify.speed.work import StageTime
from lightdepth.reporting.report import number

VERSION = 1
_CORES, _BUSY = 16, 0.9
"""Of the machine whose days are told, and the share of them that sequences side by side keep at work."""
_ENDOMAPPER_HOURS, _FPS = 24, 50


@dataclass(frozen=True)
class Workload:
    """Procedures to be made dense."""

    name: str
    procedures: int
    keyframes: float
    """of all together"""
    maps: float
    """of all together: submaps"""
    size: Size


@dataclass(frozen=True)
class Price:
    """What a workload takes."""

    processor_hours: float
    days: float
    """of a machine of 16 cores, sequences side by side"""
    gigabytes: float
    """of run folders"""


def workloads() -> list[Workload]:
    """A screening as the benchmark has it, shaped like one of the densification paper's; ten thousand; and EndoMapper,
    whose some 24 hours of video are taken to have as many keyframes a frame. All at the size of EndoMapper's frames."""
    screening = scenes("full")[-1]
    endomapper = _ENDOMAPPER_HOURS * 3600 * _FPS / screening.frames
    counts = ("a screening procedure", 1, 1.0), ("a hospital's year", 10_000, 10_000.0), ("EndoMapper", 96, endomapper)
    return [
        Workload(name, procedures, as_many * screening.keyframes, as_many * screening.maps, (1440, 1080))
        for name, procedures, as_many in counts
    ]


def priced(load: Workload, runs: Sequence[WholeRun]) -> Price:
    """By measured runs. What is fixed of a run is paid for each submap: it is mostly its page and its files."""
    megapixels = load.size[0] * load.size[1] / 1e6
    processor, size = (fitted(runs, amount) for amount in (lambda run: run.processor, lambda run: run.bytes))
    hours = processor.of(load.keyframes, megapixels, load.maps) / 3600
    return Price(hours, hours / (24 * _CORES * _BUSY), size.of(load.keyframes, megapixels, load.maps) / 1e9)


def record(
    machines: Sequence[Machine],
    threads: Mapping[str, int],
    slowness: float,
    stages: Mapping[Size, Sequence[StageTime]],
    runs: Sequence[WholeRun],
) -> dict[str, object]:
    """What speed.json says, but for versions."""
    return {
        "kind": "bench speed",
        "version": VERSION,
        "unit": "seconds, bytes, operations; rates a second",
        "machines": machines,
        "threads": threads,
        "slowness": slowness,
        "sizes": [
            {
                "size": size,
                "stages": [asdict(s) | _ratios(s) for s in found],
            }
            for size, found in stages.items()
        ],
        "runs": [run.model_dump() for run in runs],
        "cost": {load.name: {**asdict(load), **asdict(priced(load, runs))} for load in workloads()},
    }


def tables(stages: Mapping[Size, Sequence[StageTime]], runs: Sequence[WholeRun]) -> list[Table]:
    """Stages by size, whole runs, costs."""
    return [*(_stages(size, found) for size, found in stages.items()), _runs(runs), _costs(runs)]


def _ratios(stage: StageTime) -> dict[str, float]:
    return {"ratio": stage.ratio, "core_ratio": stage.core_ratio, "faster": stage.faster}


def _ms(seconds: float) -> str:
    return number(1000 * seconds)


def _stages(size: Size, found: Sequence[StageTime]) -> Table:
    rows = [
        [
            stage.name,
            stage.step or "–",
            number(sum(stage.operations.values()) / 1e6),
            number(stage.bytes / 1e6),
            _ms(stage.floor.clock),
            _ms(stage.median.clock),
            number(stage.ratio),
            _ms(stage.median.core),
            number(stage.core_ratio),
            stage.reference,
            _ms(stage.reference_median.clock),
            number(stage.faster),
        ]
        for stage in found
    ]
    headers = ["stage", "step of densify", "million operations", "MB", "floor ms", "ms", "over the floor"]
    headers += ["core ms", "over a core's floor"]
    headers += ["reference", "its ms", "reference over ours"]
    return Table(f"{size[0]}x{size[1]}: stages, median times", headers, rows)


def _runs(runs: Sequence[WholeRun]) -> Table:
    steps = list(dict.fromkeys(step for run in runs for step in run.steps))
    rows = []
    for run in runs:
        shares = [f"{run.steps.get(step, 0.0) / run.seconds:.0%}" for step in steps]
        rest = 1 - sum(run.steps.values()) / run.seconds
        each = [_ms(run.seconds / run.keyframes), _ms(run.processor / run.keyframes)]
        told = [f"{run.size[0]}x{run.size[1]}, {run.keyframes} keyframes", number(run.seconds), *each]
        rows.append([*told, number(run.bytes / 1e6), *shares, f"{rest:.0%}"])
    headers = ["run", "s", "ms a keyframe", "processor ms a keyframe", "MB", *steps, "files and page"]
    return Table("whole runs of densify, and the share of their time that each step takes", headers, rows)


def _costs(runs: Sequence[WholeRun]) -> Table:
    rows = []
    for load in workloads():
        price = priced(load, runs)
        told = [number(load.keyframes), number(price.processor_hours), number(price.days), number(price.gigabytes)]
        rows.append([load.name, f"{load.procedures}", *told])
    title = f"cost of densify by these runs, 1440x1080: hours of a core; days of {_CORES} cores; GB of run folders"
    return Table(title, ["what", "procedures", "keyframes", "core hours", "days", "GB"], rows)


def notes(machines: Sequence[Machine], threads: Mapping[str, int], model: str, runs: Sequence[WholeRun]) -> list[str]:
    """What the figures were taken on, and how they are read."""
    used = ", ".join(f"{count} of {library}" for library, count in threads.items())
    return [
        *map(_of_machine, machines),
        f"Threads of stages: {used}. Model: {model}.",
        "A floor is the time of the bytes at the copy's rate or of the operations at the product's (comparisons: at a "
        "sort's), whichever is longer. Stage and reference were timed in turns. Milliseconds of a core, of all threads "
        "together, are hardly changed by other work on the machine; those of the clock are.",
        f"Model of cost: seconds besides prediction {_said(fitted(runs, lambda run: run.besides))}; seconds of "
        f"processors {_said(fitted(runs, lambda run: run.processor))}.",
    ]


def _of_machine(machine: Machine) -> str:
    return f"{machine.device}, {machine.threads} threads: {_rates(machine.clock)}; a core: {_rates(machine.core)}."


def _rates(rates: Rates) -> str:
    done = ", ".join(f"{number(rate / 1e9)} ({kind})" for kind, rate in rates.operations.items())
    return f"a copy moves {number(rates.bandwidth / 1e9)} GB/s, thousand million operations a second: {done}"


def _said(cost: Cost) -> str:
    each = f"{number(cost.keyframe)} + {number(cost.megapixel)} a megapixel"
    return f"{number(cost.fixed)} a run, and for each keyframe {each}"
