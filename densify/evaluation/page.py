"""report.html of `lightdepth evaluate`, and of benchmarks: tables, pictures, what they mean, and the files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from densify.evaluation.files import CURVES, prefix_of
from densify.evaluation.in_short import not_judged, short_tables
from densify.evaluation.pictures import error_surface
from densify.evaluation.records import DepthJudged, Evaluation, MapsJudged, Sources
from densify.evaluation.suite import Suite
from densify.evaluation.tables import Table, notes_of, tables_of
from densify.judging.withheld import WithheldOfMap
from lightdepth.reporting.figures import Chart
from lightdepth.reporting.report import Report
from lightdepth.reporting.scene import Scene

FILES = {
    "metrics.md": "every table",
    "metrics.tex": "the same as a paper has them",
    "metrics.csv": "every figure, one a line",
    "metrics.json": "every figure, for programs",
    f"*{CURVES}.csv": "share of model points, or of pixels, within each error",
    "*_error.ply": "the surface, coloured by its error",
    "*[0-9]_error.png": "a picture of that",
    f"*{CURVES}.png": "the same as curves",
}

_LONG = 120
"""Characters of a title beyond which what stands after its colon becomes a sentence below it."""


def tables_page(
    title: str, said: Sequence[str], tables: Sequence[Table], pictures: Sequence[tuple[bytes, str]] = ()
) -> Report:
    """Sentences, pictures with captions (PNG), and tables."""
    report = Report(title)
    for sentence in said:
        report.text(sentence)
    if pictures:
        report.heading("Pictures")
        report.wide_figures(pictures)
    _show(report, tables)
    return report


def evaluation_page(
    found: Mapping[str, Evaluation[DepthJudged | MapsJudged]],
    folder: Path,
    withheld: Sequence[WithheldOfMap] = (),
    sources: Sources | None = None,
    suite: Suite | None = None,
    failed: Sequence[str] = (),
) -> Report:
    """The page of an evaluation whose files write_evaluations has put into `folder`; `failed` names what could not be
    judged."""
    report = Report("Errors against truth" if found else "Agreement with the sparse map")
    if failed:
        report.text(f"Not judged: {', '.join(failed)}; run.json has the reasons.")
    for line in not_judged(found):
        report.text(line)
    short = short_tables(found, withheld)
    _show(report, short)
    for name, evaluation in found.items():
        prefix, of = prefix_of(name, found), f"{name}: " if len(found) > 1 else ""
        pictures: list[tuple[bytes, str]] = []
        if evaluation.curves:
            share = "pixels" if isinstance(evaluation.judged, DepthJudged) else "model points"
            caption = f"{of or 'Share'}{of and 'share'} of {share} within each error"
            pictures.append((Chart((folder / f"{prefix}{CURVES}.png").read_bytes()), caption))
        scene = Scene.of([*map(error_surface, evaluation.meshes)])
        if pictures or scene is not None:
            report.heading(f"Where it errs{f', {name}' if len(found) > 1 else ''}")
        if scene is not None:
            report.text("Each surface, in the true world, is coloured by its distance to the true surface.")
            report.scene(scene)
        report.wide_figures(pictures)
    _show(report, [table for table in tables_of(found, withheld, suite) if table not in short])
    if notes := notes_of(found, sources):
        report.heading("What the figures mean")
    for note in notes:
        report.text(note)
    report.files(folder, FILES)
    return report


def _show(report: Report, tables: Sequence[Table]) -> None:
    for table in tables:
        name, _, rest = table.title.partition(": ") if len(table.title) > _LONG else (table.title, "", "")
        report.heading(name.rstrip("."))
        if rest:
            report.text(f"{rest[0].upper()}{rest[1:]}")
        report.table(table.headers, table.rows)
