"""The tables of `lightdepth evaluate`, and the sentences below them.

Tables 1 and 2 are laid out as the densification paper's: methods and metrics down, sequences across, their mean last.
A table is headers and rows; the first `words` columns are text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from densify.evaluation.pictures import MODELS
from densify.evaluation.records import (
    DepthJudged,
    DistanceFigures,
    Evaluation,
    MapGap,
    MapsJudged,
    Sources,
    SurfaceFigures,
    TrajectoryFigures,
)
from densify.evaluation.suite import Suite, alone
from densify.judging.withheld import WithheldOfMap
from lightdepth.foreign_text import for_line
from lightdepth.reporting.report import number

_METRICS = {
    "abs_rel": "AbsRel",
    "sq_rel_mm": "SqRel mm",
    "rmse_mm": "RMSE mm",
    "mae_mm": "MAE mm",
    "medae_mm": "MedAE mm",
    "rmse_log": "RMSE log",
    "delta1": "δ < 1.25",
    "delta2": "δ < 1.25²",
    "delta3": "δ < 1.25³",
}
Cell = str | float | None
_Found = TypeVar("_Found")


@dataclass(frozen=True)
class Table:
    """A title that says what it holds and in which unit, headers, and rows of words and numbers; None is a dash."""

    title: str
    headers: Sequence[str]
    rows: Sequence[Sequence[object]]

    def markdown(self) -> str:
        cells = [self.headers, ["---"] * len(self.headers), *([cell_text(c) for c in row] for row in self.rows)]
        lines = [f"| {' | '.join(str(c).replace('|', '/') for c in row)} |" for row in cells]
        return f"{self.title}\n\n" + "\n".join(lines) + "\n"

    def latex(self) -> str:
        """A tabular with rules as in the paper; a word above its like is not repeated."""
        lines = [
            r"\begin{table}",
            r"    \centering",
            rf"    \begin{{tabular}}{{|{'c|' * len(self.headers)}}}",
            r"        \hline",
            f"        {' & '.join(_tex(h) for h in self.headers)} \\\\",
            r"        \hline",
        ]
        before: object = None
        for row in self.rows:
            repeated = row[0] == before and len(self.headers) > 2 and isinstance(row[1], str)
            if not repeated and before is not None and isinstance(row[1], str):
                lines.append(r"        \hline")
            before = row[0]
            cells = [_tex(cell_text(c)) for c in row]
            lines.append(f"        {' & '.join(['' if repeated else cells[0], *cells[1:]])} \\\\")
        title = _tex(self.title)
        lines += [r"        \hline", r"    \end{tabular}", rf"    \caption{{{title}}}", r"\end{table}"]
        return "\n".join(lines) + "\n"


def cell_text(cell: object) -> str:
    """A cell of a table in text: names with ends of lines in them would end its row."""
    return for_line(cell) if isinstance(cell, str) else number(cell)


_TEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "$": r"\$",
        "&": r"\&",
        "%": r"\%",
        "_": r"\_",
        "#": r"\#",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "δ": r"$\delta$",
        "<": "$<$",
        "²": "$^2$",
        "³": "$^3$",
        "×": r"$\times$",
        "≤": r"$\le$",
        "–": "--",
        "∞": r"$\infty$",
        "→": r"$\to$",
    }
)
"""All at once: what one sign becomes has others in it."""


def _tex(text: str) -> str:
    return text.translate(_TEX)


# One or several sequences: what was judged by name, columns as a suite has them.


def trajectory_table(results: Mapping[str, MapsJudged], suite: Suite | None = None) -> Table:
    """The paper's table 1, with the shares and the other alignments below it, and published rows below those."""
    suite = suite or alone(list(results))
    found = {name: judged.trajectory for name, judged in results.items()}
    figures: dict[str, Callable[[TrajectoryFigures], float | None]] = {
        "# Frames": lambda t: t.frames,
        "# KF": lambda t: t.keyframes,
        "KF time ms": lambda t: t.ms_per_keyframe,
        "RMS ATE mm, Sim(3)": lambda t: t.rms_ate_mm,
        "RMS ATE mm, SE(3)": lambda t: t.rms_ate_se3_mm,
        "RMS RPE mm, Sim(3)": lambda t: t.rms_rpe_mm,
        "ATE mm, CLiMB": lambda t: t.climb_ate_mm,
        "Frames localised %": lambda t: None if t.localised_share is None else 100 * t.localised_share,
        "# Submaps aligned": lambda t: t.submaps_aligned,
        "# Submaps": lambda t: t.submaps,
    }
    rows: list[list[Cell]] = [[title, *_row(found, suite.groups, figure)] for title, figure in figures.items()]
    rows += [[title, *values] for title, values in suite.trajectory.items()]
    title = "Table 1. Trajectory. ATE in mm, each submap after its own alignment."
    return Table(title, _headers(suite.groups, "Metrics"), rows)


_SurfaceFigure = Callable[[SurfaceFigures], float | None]


def surface_table(results: Mapping[str, MapsJudged], suite: Suite | None = None) -> Table:
    """The paper's table 2: model points, RMS and median accuracy; published rows below ours."""
    suite = suite or alone(list(results))
    figures: dict[str, _SurfaceFigure] = {
        "#MP (×10³)": lambda f: f.points / 1000,
        "RMS Acc.": lambda f: f.rms_mm,
        "MedA Acc.": lambda f: f.median_mm,
    }
    rows = _model_rows(results, suite, figures)
    rows += [[method, metric, *values] for method, of in suite.surface.items() for metric, values in of.items()]
    title = "Table 2. Maps. Accuracy in mm, each model point to the closest true point."
    return Table(title, _headers(suite.surface_groups, "Method", "Metrics"), rows)


def completeness_table(results: Mapping[str, MapsJudged], suite: Suite | None = None) -> Table:
    """What the paper's tables leave out: Chamfer distance, distance to the true mesh, completeness, F-score."""
    suite = suite or alone(list(results))
    figures: dict[str, _SurfaceFigure] = {"Chamfer": lambda f: f.chamfer_mm}
    for title, distance in _DISTANCES.items():
        figures[f"{title} to true mesh"] = partial(_to_mesh, distance)
        figures[f"{title} from truth (completeness)"] = partial(_completeness, distance)
    thresholds = [f"{t:g}mm" for t in list(results.values())[-1].thresholds_mm]
    for title, share in _SHARES.items():
        for t in thresholds:
            figures[f"{title} {t}"] = partial(_at, share, t)
    figures["Edges over 30 deg"] = lambda f: f.sharp_edges
    title = "Table 3. Maps. Distances in mm; precision, recall: shares of model and true points within the threshold."
    return Table(title, _headers(suite.surface_groups, "Method", "Metrics"), _model_rows(results, suite, figures))


_Distance = Callable[[DistanceFigures], float]
_Share = Callable[[SurfaceFigures], Mapping[str, float]]
_DISTANCES: dict[str, _Distance] = {"RMS": lambda d: d.rms_mm, "Median": lambda d: d.median_mm}
_SHARES: dict[str, _Share] = {
    "Precision": lambda f: f.precision,
    "Recall": lambda f: f.recall,
    "F-score": lambda f: f.f_score,
}


def _to_mesh(distance: _Distance, figures: SurfaceFigures) -> float | None:
    return None if figures.to_mesh is None else distance(figures.to_mesh)


def _completeness(distance: _Distance, figures: SurfaceFigures) -> float:
    return distance(figures.completeness)


def _at(share: _Share, threshold: str, figures: SurfaceFigures) -> float:
    return share(figures)[threshold]


def _model_rows(
    results: Mapping[str, MapsJudged], suite: Suite, figures: Mapping[str, _SurfaceFigure]
) -> list[list[Cell]]:
    rows: list[list[Cell]] = []
    for key, name in MODELS.items():
        found = {column: judged.pooled[key] for column, judged in results.items() if key in judged.pooled}
        if found:
            rows += [[name, title, *_row(found, suite.surface_groups, figure)] for title, figure in figures.items()]
    return rows


def depth_table(results: Mapping[str, DepthJudged], suite: Suite | None = None) -> Table:
    """Depth errors under every alignment: mean over frames, and over sequences where there are several; published rows
    below."""
    rows: list[list[Cell]] = []
    judged = list(results.values())
    for alignment in judged[0].alignment:
        keys = [f"{key}_{alignment}" for key in _METRICS]
        scale = {j.predicted_unit for j in judged} - {"mm"} if alignment == "none" else set()
        label = f"{alignment} ({', '.join(sorted(scale))})" if scale else alignment
        rows += [[label, name, *(j.mean.errors[key] for key in keys)] for name, j in results.items()]
        if len(judged) > 1:
            weights = [j.frames_judged for j in judged]
            values = [[j.mean.errors[key] for j in judged] for key in keys]
            rows.append([label, "mean over sequences", *(float(np.mean(v)) for v in values)])
            rows.append([label, "mean over frames", *(float(np.average(v, weights=weights)) for v in values)])
    for method, published in (suite.depth if suite else {}).items():
        rows.append(["not stated", method, *(published.get(key) for key in _METRICS)])
    return Table("Depth errors. Mean over frames.", ["Alignment", "Sequence", *_METRICS.values()], rows)


def withheld_table(withheld: Sequence[WithheldOfMap]) -> Table:
    """The withheld-point error of the maps, without any truth, and the constant distance's."""
    rows: list[list[Cell]] = []
    for entry in withheld:
        where = f"{entry.sequence}, map {entry.map_id}" if entry.sequence else f"map {entry.map_id}"
        for name, found in (("this depth", entry.withheld), ("constant distance", entry.constant)):
            if found is not None:
                rows.append([where, name, found.points, found.median, found.p90, found.miss])
    title = (
        "Agreement with the sparse map: |distance - point| / point along the ray, of each keyframe's depth as it was "
        "delivered to the surface, without the finer grid of its bend, at points in blocks of wall that were hidden "
        "from the alignment (the median is in densify's log). It needs no truth, and it is no error."
    )
    return Table(title, ["Map", "Depth", "Points", "Median", "90th percentile", "Share that misses"], rows)


def _headers(groups: Sequence[Sequence[str]], *words: str) -> list[str]:
    return [*words, *(name for group in groups for name in [*group, *(["avg"] if len(group) > 1 else [])])]


def _row(
    results: Mapping[str, _Found], groups: Sequence[Sequence[str]], figure: Callable[[_Found], float | None]
) -> list[Cell]:
    """A figure of each sequence, and the mean of each group of several; one that lacks values says how many it has."""
    row: list[Cell] = []
    for group in groups:
        values = [figure(results[name]) if name in results else None for name in group]
        row += values
        known = [v for v in values if v is not None]
        if len(group) < 2:
            continue
        if not known:
            row.append(None)
            continue
        mean = float(np.mean(known))
        mean = round(mean) if all(isinstance(v, int) for v in known) else mean
        row.append(mean if len(known) == len(values) else f"{number(mean)} ({len(known)} of {len(values)})")
    return row


def tables_of(
    found: Mapping[str, Evaluation[DepthJudged | MapsJudged]],
    withheld: Sequence[WithheldOfMap] = (),
    suite: Suite | None = None,
) -> list[Table]:
    """Every table that there is something for."""
    results = {name: e.judged for name, e in found.items()}
    depth = {name: j for name, j in results.items() if isinstance(j, DepthJudged)}
    posed = {name: j for name, j in results.items() if isinstance(j, MapsJudged)}
    tables = [depth_table(depth, suite)] if depth else []
    if posed:
        tables.append(trajectory_table(posed, suite))
    if any(j.pooled for j in posed.values()):
        tables += [surface_table(posed, suite), completeness_table(posed, suite)]
    return [*tables, withheld_table(withheld)] if withheld else tables


def notes_of(found: Mapping[str, Evaluation[DepthJudged | MapsJudged]], sources: Sources | None = None) -> list[str]:
    """Sentences below the tables: what the numbers mean, and which maps have none."""
    results = {name: e.judged for name, e in found.items()}
    notes = []
    first = next(iter(results.values()), None)
    if isinstance(first, DepthJudged):
        named = "; ".join(f"{name}: {what}" for name, what in first.alignment.items())
        notes.append(f"Mask: {first.mask}.\n\nAlignment of each frame: {named}.\n")
    for name, judged in results.items():
        if isinstance(judged, DepthJudged):
            notes.append(
                f"{name}: {judged.frames_judged} of {judged.frames_predicted} predicted frames judged (the sequence "
                f"has {judged.frames_of_truth}), on {judged.mean.share_of_image:.1%} of the image in the mean, "
                f"{judged.mean.share_of_truth:.1%} of the valid truth; predictions are {judged.predicted_unit}.\n"
            )
        else:
            truth = judged.truth
            notes.append(f"{name}: truth {truth.cloud}; true mesh: {truth.mesh or 'none'}.\n")
            if truth.sharp_edges is not None:
                notes.append(f"The true mesh turns by more than 30° at {truth.sharp_edges:.2%} of its edges.\n")
            if truth.cloud_spacing_mm is not None:
                notes.append(f"Neighbouring true points are {number(truth.cloud_spacing_mm)} mm apart (median).\n")
            notes += [f"{name}, map {m.map_id}: {m.error}\n" for m in judged.maps if m.error]
            notes += [f"{name}, map {m.map_id}: {m.surface_error}\n" for m in judged.maps if m.surface_error]
            notes.append(f"Alignment: {judged.alignment}. CLiMB: {judged.trajectory.climb_rule}.\n")
            if judged.trajectory.localised_share is None:
                notes.append(f"Share of frames localised {judged.trajectory.localised_of}.\n")
    return [*notes, *source_notes(sources)]


def source_notes(sources: Sources | None) -> list[str]:
    """The gap between two submaps, and how maps were made dense for the evaluation."""
    if sources is None:
        return []
    gap = [] if sources.gap is None else [gap_note(sources.gap)]
    return [*gap, f"{sources.made}.\n"] if sources.made else gap


def gap_note(gap: MapGap) -> str:
    """The gap between two submaps in a sentence."""
    return (
        f"Maps {gap.first} and {gap.second}: gap median {gap.gap.median:.2%}, 90th percentile {gap.gap.p90:.2%} of "
        f"the distance to the camera, over {gap.gap.rays} rays.\n"
    )
