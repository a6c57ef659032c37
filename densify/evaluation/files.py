"""What `lightdepth evaluate` writes: metrics.json, .md, .tex, .csv, cumulative error curves, error-coloured meshes."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from densify.evaluation.pictures import MODELS, curve_picture, error_picture, write_error_mesh
from densify.evaluation.records import (
    EDGES_MM,
    DepthJudged,
    Evaluation,
    MapsJudged,
    Sources,
    SurfaceFigures,
    metrics_record,
)
from densify.evaluation.suite import Suite
from densify.evaluation.tables import Cell, notes_of, tables_of
from densify.judging.withheld import WithheldOfMap
from lightdepth.errors import InputError
from lightdepth.files.schema import read_json
from lightdepth.foreign_text import for_table

METRICS = "metrics.json"
CURVES = "cumulative_error"
"""Name of the files with cumulative error curves, after the sequence's where there are several."""


def prefix_of(name: str, found: Mapping[str, object]) -> str:
    """What the names of a sequence's files begin with."""
    return f"{name}_" if len(found) > 1 else ""


def check_no_truth_lost(folder: Path) -> None:
    """Raises InputError where a folder, which metrics without truth would replace, has metrics against truth."""
    try:
        record = read_json(folder / METRICS)
    except InputError:  # none, or spoilt: nothing is lost
        return
    if isinstance(record, Mapping) and record.get("truth_folder") is not None:
        cure = "give --truth DATA again, another -o for metrics without truth, or --overwrite to lose those"
        raise InputError(folder, "holds metrics against truth, which metrics without truth would replace", cure)


def write_evaluations(
    found: Mapping[str, Evaluation[DepthJudged | MapsJudged]],
    folder: Path,
    withheld: Sequence[WithheldOfMap] = (),
    sources: Sources | None = None,
    suite: Suite | None = None,
) -> None:
    """Everything but a page, into the folder."""
    record = metrics_record(found, withheld, sources)
    (folder / METRICS).write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    results = {name: e.judged for name, e in found.items()}
    tables, notes = tables_of(found, withheld, suite), notes_of(found, sources)
    text = "\n".join([*(t.markdown() for t in tables), *notes])
    (folder / "metrics.md").write_text(text.rstrip() + "\n", encoding="utf-8", errors="backslashreplace")
    comments = "".join(f"% {line}\n" for note in notes for line in note.splitlines() if line)
    (folder / "metrics.tex").write_text(
        "\n".join([comments, *(t.latex() for t in tables)]), encoding="utf-8", errors="backslashreplace"
    )
    with (folder / "metrics.csv").open("w", newline="", encoding="utf-8", errors="surrogateescape") as file:
        rows = long_rows(results)
        csv.writer(file).writerows([for_table(v) if isinstance(v, str) else v for v in row] for row in rows)
    for name, evaluation in found.items():
        prefix = prefix_of(name, found)
        if evaluation.curves:
            (folder / f"{prefix}{CURVES}.png").write_bytes(curve_picture(evaluation))
            with (folder / f"{prefix}{CURVES}.csv").open(
                "w", newline="", encoding="utf-8", errors="surrogateescape"
            ) as file:
                shares = np.stack(list(evaluation.curves.values()), 1)
                rows = [[f"{v:.6g}" for v in (edge, *row)] for edge, row in zip(EDGES_MM, shares, strict=True)]
                csv.writer(file).writerows([["error_mm", *evaluation.curves], *rows])
        for mesh in evaluation.meshes:
            write_error_mesh(mesh, folder / f"{prefix}{mesh.name}_error.ply")
            (folder / f"{prefix}{mesh.name}_error.png").write_bytes(error_picture(mesh))


def long_rows(results: Mapping[str, DepthJudged | MapsJudged]) -> list[list[Cell]]:
    """Headers and every single figure: sequence, frame or map (or mean, all), model, metric with its unit, value."""
    rows: list[list[Cell]] = [["sequence", "part", "model", "metric", "value"]]

    def add(name: str, part: str, model: str, figures: Mapping[str, object], prefix: str = "") -> None:
        for metric, value in figures.items():
            if isinstance(value, Mapping):
                add(name, part, model, value, f"{prefix}{metric}_")
            elif isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
                rows.append([name, part, model, prefix + metric, value])

    for name, judged in results.items():
        if isinstance(judged, DepthJudged):
            for frame, figures in {**judged.frames, "mean": judged.mean}.items():
                add(name, frame, "", figures.record())
            continue
        add(name, "all", "", asdict(judged.trajectory))
        parts: list[tuple[str, Mapping[str, object], Mapping[str, SurfaceFigures | None]]]
        parts = [("all", {}, judged.pooled), *((f"map {m.map_id}", m.alone(), m.clouds) for m in judged.maps)]
        for part, alone_figures, clouds in parts:
            add(name, part, "", alone_figures)
            for model in MODELS:
                found = clouds.get(model)
                add(name, part, model, {} if found is None else asdict(found))
    return rows
