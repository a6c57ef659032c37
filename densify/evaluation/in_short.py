"""What `lightdepth evaluate` shows: the few figures that tell whether a surface or a prediction is any good.

Of maps each submap and all together, of several sequences each sequence: the trajectory's error, how far surface and
truth are from each other both ways, and the F-score at one distance, of the best model that there is. Of depth the
means. Every other figure is in the files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from densify.evaluation.pictures import MODELS
from densify.evaluation.records import DepthJudged, Evaluation, MapsJudged, Sources, SurfaceFigures
from densify.evaluation.tables import Cell, Table, depth_table, source_notes, withheld_table
from densify.judging.withheld import WithheldOfMap


def in_short(
    found: Mapping[str, Evaluation[DepthJudged | MapsJudged]],
    withheld: Sequence[WithheldOfMap] = (),
    sources: Sources | None = None,
) -> str:
    """The text of a few tables, and what could not be judged."""
    notes = [*not_judged(found), *source_notes(sources)]
    return "\n".join([*(t.markdown() for t in short_tables(found, withheld)), *notes]).rstrip()


def short_tables(
    found: Mapping[str, Evaluation[DepthJudged | MapsJudged]], withheld: Sequence[WithheldOfMap] = ()
) -> list[Table]:
    """Depth's means, a line for each map or sequence, and agreement with hidden blocks of the maps."""
    results = {name: e.judged for name, e in found.items()}
    depth = {name: j for name, j in results.items() if isinstance(j, DepthJudged)}
    posed = {name: j for name, j in results.items() if isinstance(j, MapsJudged)}
    tables = []
    if depth:
        whole = depth_table(depth)
        rows = [row for row in whole.rows if len(depth) == 1 or str(row[1]).startswith("mean over")]
        tables.append(Table(whole.title, whole.headers, rows))
    if posed:
        tables.append(_maps_table(posed))
    if withheld:
        tables.append(withheld_table(withheld))
    return tables


def _maps_table(results: Mapping[str, MapsJudged]) -> Table:
    """A row for each submap and for all, or for each sequence where there are several."""
    thresholds = next(iter(results.values())).thresholds_mm
    at = f"{thresholds[len(thresholds) // 2]:g}mm"
    rows: list[list[Cell]] = []
    surfaces = any(judged.pooled for judged in results.values())
    for name, judged in results.items():
        if len(results) == 1:
            for m in judged.maps:
                ate = None if m.aligned is None else m.aligned.rms_ate_mm
                rows.append([f"map {m.map_id}", m.keyframes, ate, *(_surface(m.clouds, at) if surfaces else [])])
        trajectory = judged.trajectory
        ate = trajectory.rms_ate_mm if trajectory.submaps_aligned else None
        of = "all" if len(results) == 1 else name
        rows.append([of, trajectory.keyframes, ate, *(_surface(judged.pooled, at) if surfaces else [])])
    headers = ["", "# KF", "RMS ATE"]
    headers += ["Model", "RMS", "Median", "Truth to it, median", f"F-score {at}"] if surfaces else []
    title = "In short: the trajectory after Sim(3)"
    title += ", and the model's points to the closest true point and back; mm, shares of 1." if surfaces else "; mm."
    return Table(title, headers, rows)


def _surface(clouds: Mapping[str, SurfaceFigures | None], at: str) -> list[Cell]:
    """The figures of the densest of a map's models."""
    for key in reversed(MODELS):
        figures = clouds.get(key)
        if figures is not None:
            there = figures.completeness.median_mm
            return [MODELS[key], figures.rms_mm, figures.median_mm, there, figures.f_score[at]]
    return [None] * 5


def not_judged(found: Mapping[str, Evaluation[DepthJudged | MapsJudged]]) -> list[str]:
    """A line for each map that has no error of its own, with the reason."""
    return [
        f"{name}, map {m.map_id}: {why}\n"
        for name, evaluation in found.items()
        if isinstance(evaluation.judged, MapsJudged)
        for m in evaluation.judged.maps
        for why in (m.error, m.surface_error)
        if why
    ]
