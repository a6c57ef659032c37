"""bench.json and bench.md: what a run of the benchmark found, and by what.

bench.json has one cell for each scene and share of wrong points, or case of errors that come together, and in it the
figures of each row; distances in mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from densify.bench.scenes import SUITE_VERSION
from densify.bench.work import INLIERS, SPARSE, BenchConfig
from densify.evaluation.tables import Table
from lightdepth.counting import full_stop
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.reporting.record import git_revision, versions
from lightdepth.reporting.run import plain

COLUMNS = {
    "points": "#MP (×10³)",
    "rms_mm": "RMS Acc. mm",
    "median_mm": "MedA Acc. mm",
    "completeness_median_mm": "Completeness mm",
    "chamfer_mm": "Chamfer mm",
    "precision.1mm": "Precision 1 mm",
    "recall.1mm": "Recall 1 mm",
    "f_score.1mm": "F 1 mm",
    "precision.2mm": "Precision 2 mm",
    "recall.2mm": "Recall 2 mm",
    "f_score.2mm": "F 2 mm",
    "sharp_edges": "Edges over 30 deg",
    "depth_abs_rel": "Depth AbsRel",
    "scale_error": "Scale error",
    "unaligned_share": "KF left out",
}
UNITS = (
    "mm; shares, depth_abs_rel and scale_error of 1. rms_mm, median_mm, p90_mm: from each model point to the closest "
    "true point; completeness: from each true point to the closest model point; chamfer_mm: mean of the mean distances "
    "both ways; precision, recall, f_score: shares of model and true points within a distance, and their harmonic "
    "mean; sharp_edges: share of the mesh's edges at which it turns by more than 30 degrees; depth_*: of the aligned "
    "keyframes' depth, mean over keyframes; scale_error: |median of predicted / true depth - 1| of a keyframe, mean "
    "over keyframes; keyframes are left out where their alignment is not trusted"
)
ALIGNMENT = (
    "Sim(3) of each submap's keyframes to the true ones (least ATE), for surfaces and depth alike; depth is not "
    "aligned once more"
)
MASK = (
    "true points inside the octagon and the lens's field; every model point counts; depth: where prediction and truth "
    "are valid, below 100 mm"
)

_ALSO_COMPARED = ("depth_abs_rel", "scale_error", "keyframes", "keyframes_aligned")


class Cell(BaseModel):
    """One scene at one share of wrong points, or in one case: a row has figures, or `error`, why it has none."""

    model_config = ConfigDict(extra="ignore")
    scene: str
    seed: int
    wrong_share: Annotated[float, Field(ge=0, lt=1)]
    case: str = ""
    rows: dict[str, dict[str, Any]]


class BenchFile(BaseModel):
    """What bench.json must have to be compared with another."""

    model_config = ConfigDict(extra="ignore")
    kind: Literal["bench"]
    suite_version: int
    config: dict[str, Any]
    cells: Annotated[list[Cell], Field(min_length=1)]
    revision: str | None = None

    @property
    def seeds(self) -> dict[str, int]:
        """By scene."""
        return {cell.scene: cell.seed for cell in self.cells}


def record(config: BenchConfig, cells: Sequence[Mapping[str, object]], seconds: Mapping[str, float]) -> dict[str, Any]:
    """What bench.json says. All but `seconds` is the same when made twice."""
    result: dict[str, Any] = plain(
        {
            "kind": "bench",
            "suite_version": SUITE_VERSION,
            "unit": UNITS,
            "alignment": ALIGNMENT,
            "mask": MASK,
            "config": config,
            "cells": cells,
            "versions": versions(),
            "revision": git_revision(),
            "seconds": seconds,
        }
    )
    return result


def read_bench(path: Path) -> BenchFile:
    """bench.json, or the one in a folder. Raises InputError when it is none, or has a figure that is no number."""
    path = path / "bench.json" if path.is_dir() else path
    data = read_json(path)
    if not isinstance(data, dict) or data.get("kind") != "bench":
        raise InputError(path, "not a result of lightdepth bench", "expected its bench.json, or the folder it is in")
    found = checked_fields(BenchFile, data, str(path))
    for cell in found.cells:
        for name, row in cell.rows.items():
            needed = () if "error" in row else ("rms_mm", "median_mm")
            for key in (*needed, *(k for k in _ALSO_COMPARED if k in row)):
                value, least = row.get(key), 0 if key in _ALSO_COMPARED else 1e-9
                if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value < np.inf:
                    raise InputError(
                        path,
                        f"{cell.scene} at {cell.wrong_share:.0%} wrong points, row {name!r}: {key} is {value!r}",
                        f"expected a number {'of at least 0' if least == 0 else 'above 0'}",
                    )
    return found


def figure(row: Mapping[str, Any], key: str) -> float | None:
    """A column's value in a row; None where it has none."""
    if key == "completeness_median_mm":
        return row["completeness"]["median_mm"] if row.get("completeness") else None
    if "." in key:  # shares within a distance, which runs of earlier versions have as well
        shares, _, distance = key.partition(".")
        share: float | None = row.get(shares, {}).get(distance)
        return share
    if key == "unaligned_share":
        return 1 - row["keyframes_aligned"] / row["keyframes"] if row.get("keyframes") else None
    value = row.get(key)
    return value / 1000 if key == "points" and value is not None else value


def tables(found: Mapping[str, Any]) -> list[Table]:
    """One table for each share of wrong points and each case, as the paper's table 2, and the SLAM's as its table 1."""
    cells = found["cells"]
    kinds = list(dict.fromkeys((cell.get("case", ""), cell["wrong_share"]) for cell in cells))
    made = [_slam_table(cells)]
    for case, share in kinds:
        of = [cell for cell in cells if (cell.get("case", ""), cell["wrong_share"]) == (case, share)]
        rows: list[list[Any]] = []
        for name in of[0]["rows"]:
            for key, title in COLUMNS.items():
                values = [figure(cell["rows"][name], key) for cell in of]
                if any(v is not None for v in values):
                    rows.append([name, title, *values, *_mean(values)])
        average = ["avg"] if len(of) > 1 else []
        named = f"Errors that come together: {case}; " if case else ""
        title = f"{named}{share:.0%} wrong points. Accuracy: each model point to the closest true point."
        made.append(Table(title, ["Method", "Metrics", *(_column(cell) for cell in of), *average], rows))
    return made


def _slam_table(cells: Sequence[Mapping[str, Any]]) -> Table:
    first = {cell["scene"]: cell for cell in reversed(cells)}
    of = [first[name] for name in dict.fromkeys(cell["scene"] for cell in cells)]
    lines: list[list[Any]] = [["# Frames", *(cell["frames"] for cell in of)]]
    for title, key in (
        ("# KF", "keyframes"),
        ("RMS ATE mm, Sim(3)", "rms_ate_mm"),
        ("RMS RPE mm, Sim(3)", "rms_rpe_mm"),
        ("# Submaps", "submaps"),
    ):
        if any(key in cell["trajectory"] for cell in of):
            lines.append([title, *(cell["trajectory"].get(key) for cell in of)])
    rows = [[*line, *_mean(line[1:])] for line in lines]
    average = ["avg"] if len(of) > 1 else []
    return Table("The simulated SLAM.", ["Metrics", *(_column(cell) for cell in of), *average], rows)


def _column(cell: Mapping[str, Any]) -> str:
    return f"{cell['scene']} ({cell['seed']})"


def _mean(values: Sequence[float | None]) -> list[Any]:
    known = [v for v in values if v is not None]
    if len(values) < 2:
        return []
    if not known:
        return [None]
    mean = float(np.mean(known))
    return [mean if len(known) == len(values) else f"{mean:.3g} ({len(known)} of {len(values)})"]


def notes(found: Mapping[str, Any]) -> list[str]:
    """What the figures mean, and which rows have none."""
    said = [f"Unit: {found['unit']}.", f"Alignment: {found['alignment']}. Mask: {found['mask']}."]
    said.append(
        f"Synthetic colons, suite {found['suite_version']}, seeds in brackets; the SLAM is simulated. "
        f'"{SPARSE}" is its export, "{INLIERS}" what the last row keeps of it.'
    )
    for cell in found["cells"]:
        for name, row in cell["rows"].items():
            if "error" in row:
                place = cell.get("case") or f"{cell['wrong_share']:.0%} wrong"
                said.append(full_stop(f"{cell['scene']}, {place}, {name}: {row['error']}"))
    return said
