"""The table of an ablation: errors as ratios to the closed form's, over seeds, and differences to the base.

Notation: ratio, an error of a network divided by the closed form's on the same frames; overall, the geometric mean of a
training's ratios over all sets and metrics. Differences are taken seed by seed, because the trainings of a seed share
colons and weights' seed; one is clear where its mean is larger than its spread (greatest minus least) over the seeds.
"""

from __future__ import annotations

import csv
import io
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np

from lightdepth.files.writing import write_whole
from lightdepth.foreign_text import for_table
from lightdepth.reporting.record import git_revision

from ..colons import TubeData, colon_seeds
from .rows import JudgedColons, Row

HEADING = "# What each ingredient of `"
"""How every table begins."""

METRICS = {"abs_rel": "AbsRel", "rmse_mm": "RMSE", "medae_mm": "MedAE"}
_TOLD = {"true": "the true one", "wrong": "one .3 too high", "estimated": "one estimated per colon, without truth"}
_SHOWN_POINTS = 6
_IN_EVERY_SEED = "in every seed, but by less than the seeds differ"
_HEADINGS = {
    "dropped": {
        "worse": "Rows that are clearly worse, so that what they leave out earns its place",
        "worse in every seed": f"Rows that are worse {_IN_EVERY_SEED}, so that what they leave out may help",
        "no clear difference": "Rows whose seeds do not agree on a difference; what they leave out did not help",
        "better in every seed": f"Rows that are better {_IN_EVERY_SEED}, so that what they leave out may harm",
        "better": "Rows that are clearly better, so that what they leave out did harm here",
        "one seed": "Left out with one seed",
    },
    "instead": {
        "better": "Instead of what the first row has, clearly better",
        "better in every seed": f"Instead of what the first row has, better {_IN_EVERY_SEED}",
        "no clear difference": "Instead of what the first row has, no difference that the seeds agree on",
        "worse in every seed": f"Instead of what the first row has, worse {_IN_EVERY_SEED}",
        "worse": "Instead of what the first row has, clearly worse",
        "one seed": "Instead of what the first row has, with one seed",
    },
    "reference": {"": "To compare with"},
}


@dataclass(frozen=True)
class Result:
    """One training: `errors` by what it was told at judging, by set, by metric; `failed` says why there are none."""

    row: str
    seed: int
    steps: int
    parameters: int
    seconds: float
    curve: list[tuple[int, float]]
    errors: dict[str, dict[str, dict[str, float]]]
    closed_form: dict[str, dict[str, float]]
    failed: str = ""

    def ratios(self, told: str) -> np.ndarray:
        """(sets, metrics)."""
        of = self.errors[told]
        return np.array([[of[name][key] / self.closed_form[name][key] for key in METRICS] for name in self.closed_form])

    def overall(self, told: str | None = None) -> float:
        return float(np.exp(np.log(self.ratios(told or next(iter(self.errors)))).mean()))


@dataclass(frozen=True)
class AblationTable:
    """What was asked for and what came out."""

    title: str
    rows: Sequence[Row]
    judged: Sequence[JudgedColons]
    results: Sequence[Result]
    tube: TubeData
    size: tuple[int, int]
    batch_size: int


@dataclass(frozen=True)
class Line:
    """A line of the table: `values` by seed, each (sets, metrics), and the same of the base, which may have other
    seeds."""

    name: str
    row: Row
    is_base: bool
    values: dict[int, np.ndarray]
    base: dict[int, np.ndarray]

    @property
    def seeds(self) -> list[int]:
        return sorted(self.values.keys() & self.base.keys())

    def cells(self) -> np.ndarray:
        """(seeds, sets, metrics)."""
        return np.stack(list(self.values.values()))

    def overall(self) -> np.ndarray:
        """(seeds,)"""
        return _overall(self.cells())

    def differences(self) -> np.ndarray:
        """Of the cells to the base's, (seeds, sets, metrics), for the seeds that both have."""
        shared = [self.values[seed] - self.base[seed] for seed in self.seeds]
        return np.stack(shared) if shared else self.cells()[:0]

    def overall_differences(self) -> np.ndarray:
        """(seeds,)"""
        return np.array([float(_overall(self.values[s]) - _overall(self.base[s])) for s in self.seeds])

    def mean_difference(self) -> float:
        return float(self.overall_differences().mean())

    def verdict(self) -> str:
        """worse or better, the same "in every seed" where it is not clear, no clear difference, one seed, or none."""
        found = self.overall_differences()
        if len(found) < 2:
            return "one seed" if len(found) else "no seed that the first row has"
        side = "worse" if found.mean() > 0 else "better"
        if clear(found):
            return side
        return f"{side} in every seed" if abs(np.sign(found).sum()) == len(found) else "no clear difference"


def clear(differences: np.ndarray) -> np.ndarray:
    """Whether the mean over seeds (the first axis, at least two) is larger than the spread."""
    result: np.ndarray = (len(differences) > 1) & (np.abs(differences.mean(0)) > np.ptp(differences, axis=0))
    return result


def _overall(ratios: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.exp(np.log(ratios).mean((-2, -1)))
    return result


def lines(table: AblationTable) -> list[Line]:
    """Of the rows that were trained; the base first, if it was."""
    first = table.rows[0]
    base = {r.seed: r.ratios(first.told[0]) for r in table.results if r.row == first.name and not r.failed}
    found = []
    for row in table.rows:
        of = [r for r in table.results if r.row == row.name and not r.failed]
        for told in row.told if of else ():
            name = f"{row.name}; told {_TOLD[told]}" if len(row.told) > 1 else row.name
            is_base = row is first and told == first.told[0]
            found.append(Line(name, row, is_base, {r.seed: r.ratios(told) for r in of}, base))
    return found


def write_table(table: AblationTable, output: Path, copy: Path | None) -> None:
    """ablation.md (and its copy), .csv with every number, .json with what the table says."""
    text = markdown(table)
    output.mkdir(parents=True, exist_ok=True)
    summary = [_summary(line) for line in lines(table)]
    write_whole(output / "ablation.json", json.dumps(summary, indent=1) + "\n")
    write_whole(output / "ablation.csv", _csv(table))
    write_whole(output / "ablation.md", text)
    if copy is not None:
        write_whole(copy, text)


class _Summary(TypedDict):
    """A line of the table in ablation.json."""

    row: str
    seeds: list[int]
    overall: list[float]
    difference: list[float]
    verdict: str
    ratios: list[list[float]]


def _summary(line: Line) -> _Summary:
    overall, difference = line.overall(), line.overall_differences()
    return {
        "row": line.name,
        "seeds": list(line.values),
        "overall": overall.round(4).tolist(),
        "difference": difference.round(4).tolist(),
        "verdict": line.verdict(),
        "ratios": line.cells().mean(0).round(4).tolist(),
    }


def _csv(table: AblationTable) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["row", "seed", "told", "colons", "metric", "error", "closed_form", "ratio"])
    for r in table.results:
        for told, sets in r.errors.items():
            for name, errors in sets.items():
                for key in METRICS:
                    mine, closed = errors[key], r.closed_form[name][key]
                    writer.writerow(
                        [
                            for_table(r.row),
                            r.seed,
                            told,
                            name,
                            key,
                            f"{mine:.6g}",
                            f"{closed:.6g}",
                            f"{mine / closed:.4f}",
                        ]
                    )
    return text.getvalue()


def markdown(table: AblationTable) -> str:
    found = lines(table)
    parts = [_head(table), _overall_table(found), _says(found), _closed_form(table)]
    for i, colons in enumerate(table.judged):
        parts.append(_set_table(colons, i, found))
    parts += [_curves(table), _failures(table)]
    return "\n".join(part for part in parts if part)


def _head(table: AblationTable) -> str:
    seeds = sorted({r.seed for r in table.results})
    tube, (width, height) = table.tube, table.size
    colons = "the sequences of its settings, "
    if tube.scenes:
        trained = ", ".join(_span(colon_seeds(tube, seed)[0]) for seed in seeds)
        colons = f"{tube.scenes} {tube.family} colons (seeds {trained}),\n{tube.frames} frames each, "
    judged = "\n".join(f"- {c.name}: seeds {_span(c.seeds)}, {c.frames} frames each" for c in table.judged)
    steps = next(r.steps for r in table.results)
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    revision = git_revision() or "unknown"
    return f"""{HEADING}{table.title}` is worth

Made by `{command}`
(program of revision {revision}); not to be edited.

Every row is the first one with one change, trained anew with seeds {", ".join(map(str, seeds))}:
{colons}{width}x{height} pixels, {steps} steps of {table.batch_size} frames unless the row says
otherwise. The rows of a seed share frames and order. Judged on colons that no row saw, by depth along the axis, one
median scale per frame, ray_z > .15, depth < 100 mm, inside the mask:

{judged}

Numbers are **ratios to the errors of the blurred closed form** on the same frames (1: as good as one line of algebra):
mean over the seeds (least to greatest). Overall: the geometric mean of AbsRel, RMSE and MedAE over all judged colons.
Differences are to the first row, seed by seed; bold where their mean is larger than their spread (greatest minus least)
over the seeds. Those are rules of thumb: with three seeds and no difference at all, one row in twelve would be bold,
and one in four would have the same sign in every seed. Images are small and training is short: these are directions
and sizes of effects, not records.
"""


def _span(seeds: range) -> str:
    return f"{seeds[0]}-{seeds[-1]}" if len(seeds) > 1 else str(seeds[0])


def _number(value: float, signed: bool = False) -> str:
    text = f"{value:+.3f}" if signed else f"{value:.3f}"
    return text.replace("0.", ".", 1) if abs(value) < 1 else text


def _spread(values: np.ndarray) -> str:
    mean = _number(float(values.mean()))
    return mean if len(values) == 1 else f"{mean} ({_number(float(values.min()))}-{_number(float(values.max()))})"


def _difference(values: np.ndarray) -> str:
    if not len(values):
        return ""
    text = _number(float(values.mean()), signed=True)
    return f"**{text}**" if clear(values) else text


def _overall_table(found: Sequence[Line]) -> str:
    text = ["## All together", "", "| row | what is different | overall | difference | |", "|---|---|---|---|---|"]
    for line in found:
        difference, verdict = ("", "") if line.is_base else (_difference(line.overall_differences()), line.verdict())
        text.append(f"| {line.name} | {line.row.change} | {_spread(line.overall())} | {difference} | {verdict} |")
    return "\n".join([*text, ""])


def _says(found: Sequence[Line]) -> str:
    """Which ingredients earn their place and which do not, by the rule of the table."""
    text = ["## What it says", ""]
    for part, headings in _HEADINGS.items():
        of = [line for line in found if line.row.part == part and line.seeds and not line.is_base]
        of.sort(key=lambda line: -line.mean_difference())
        for verdict, heading in headings.items():
            names = [
                f"{line.name} ({_number(line.mean_difference(), signed=True)})"
                for line in of
                if verdict in ("", line.verdict())
            ]
            if names:
                text.append(f"- {heading}: {'; '.join(names)}.")
    return "\n".join([*text, ""])


def _closed_form(table: AblationTable) -> str:
    text = ["## The closed form's own errors", "", "| colons | AbsRel | RMSE mm | MedAE mm |", "|---|---|---|---|"]
    for name, errors in table.results[0].closed_form.items():
        text.append(f"| {name} | {errors['abs_rel']:.4f} | {errors['rmse_mm']:.2f} | {errors['medae_mm']:.2f} |")
    return "\n".join([*text, ""])


def _set_table(colons: JudgedColons, index: int, found: Sequence[Line]) -> str:
    header = " | ".join(f"{name} | difference" for name in METRICS.values())
    text = [f"## Judged on {colons.name}", "", f"| row | {header} |", "|---|" + "---|---|" * len(METRICS)]
    for line in found:
        values = line.cells()[:, index]
        differences = (line.differences()[:0] if line.is_base else line.differences())[:, index]
        cells = [f"{_spread(values[:, k])} | {_difference(differences[:, k])}" for k in range(len(METRICS))]
        text.append(f"| {line.name} | {' | '.join(cells)} |")
    return "\n".join([*text, ""])


def _curves(table: AblationTable) -> str:
    shown = [r for r in table.results if any(row.curve and row.name == r.row for row in table.rows) and r.curve]
    if not shown:
        return ""
    text = [
        "## Has it converged?",
        "",
        "Validation loss without truth, each row's own (not to be compared between rows):",
        "",
    ]
    text += ["| row | seed | steps: loss | change over the last third |", "|---|---|---|---|"]
    for r in shown:
        chosen = [r.curve[i] for i in np.unique(np.linspace(0, len(r.curve) - 1, _SHOWN_POINTS).round().astype(int))]
        before = next(
            loss for step, loss in reversed(r.curve) if 3 * step <= 2 * r.curve[-1][0] or step == r.curve[0][0]
        )
        change = 100 * (r.curve[-1][1] / before - 1)
        curve = ", ".join(f"{step}: {loss:.4g}" for step, loss in chosen)
        text.append(f"| {r.row} | {r.seed} | {curve} | {change:+.1f} % |")
    return "\n".join([*text, ""])


def _failures(table: AblationTable) -> str:
    failed = [f"- {r.row}, seed {r.seed}: {r.failed}" for r in table.results if r.failed]
    return "\n".join(["## Failed", "", *failed, ""]) if failed else ""
