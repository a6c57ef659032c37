"""completion.json and completion.md: what the ways to complete came to, side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from pydantic import TypeAdapter

from densify.bench.completion.figures import CellFigures, RowFigures
from densify.bench.completion.methods import LMEDS, METHODS, OURS, POISSON, SHIFT, SHIFT_INVERSE
from densify.bench.completion.poisson import POISSON as POISSON_CONFIG
from densify.bench.completion.scenes import SEEDS, TUNING_SEEDS
from densify.bench.completion.work import DELIVERED
from densify.bench.curves import BANDS_MM
from densify.evaluation.records import SurfaceFigures
from densify.evaluation.tables import Table
from lightdepth.counting import full_stop

VERSION = 1
"""Figures of two versions are not comparable."""
BAR = 0.85
BEST_SHIFT = "scale and shift"
UNIT = (
    "mm; shares, abs_rel and bias of 1; depth along the axis below 100 mm, every pixel that is valid in prediction and "
    "truth, mean over a colon's keyframes, then over colons; surfaces: vertices against true points and back"
)
ALIGNMENT = "Sim(3) of the keyframes to the true ones (least ATE), one for all rows; depth is not aligned once more"
ERRORS = {"abs_rel": "AbsRel", "rmse_mm": "RMSE mm", "medae_mm": "median error mm"}
_SURFACE: dict[str, Callable[[SurfaceFigures], float]] = {
    "Chamfer mm": lambda s: s.chamfer_mm,
    "RMS mm": lambda s: s.rms_mm,
    "median mm": lambda s: s.median_mm,
    "truth to surface mm": lambda s: s.completeness.median_mm,
    "P / R / F 1 mm": lambda s: s.precision["1mm"],
    "P / R / F 2 mm": lambda s: s.precision["2mm"],
}


def read_cell(kept: object) -> CellFigures:
    """A cell as completion.json has it."""
    return TypeAdapter(CellFigures).validate_python(kept)


def record(cells: Sequence[CellFigures]) -> dict[str, object]:
    """What completion.json says, but for versions."""
    return {
        "kind": "bench completion",
        "version": VERSION,
        "unit": UNIT,
        "alignment": ALIGNMENT,
        "seeds": SEEDS,
        "tuning_seeds": TUNING_SEEDS,
        "poisson": POISSON_CONFIG,
        "bands_mm": BANDS_MM,
        "bar": BAR,
        "cells": cells,
    }


def better_shift(cell: CellFigures) -> str:
    """Which of the two ways of scale and shift errs less in a colon, by AbsRel against truth: more than a user could
    know."""
    return min((SHIFT, SHIFT_INVERSE), key=lambda name: _abs_rel(cell.rows[name]))


def _abs_rel(row: RowFigures) -> float:
    return row.depth.abs_rel if row.depth is not None else float("inf")


def shown_rows(cell: CellFigures) -> dict[str, RowFigures]:
    """The rows of the tables: of scale and shift the better one alone."""
    found: dict[str, RowFigures] = {}
    for name, row in cell.rows.items():
        if name == SHIFT:
            found[BEST_SHIFT] = cell.rows[better_shift(cell)]
        elif name != SHIFT_INVERSE:
            found[name] = row
    return found


def tables(cells: Sequence[CellFigures]) -> list[Table]:
    """Means by kind of error, each colon, and ratios to the baselines."""
    kinds = list(dict.fromkeys(cell.errors for cell in cells))
    return [table for kind in kinds for table in _of_kind([cell for cell in cells if cell.errors == kind], kind)]


def _of_kind(cells: Sequence[CellFigures], kind: str) -> list[Table]:
    rows = [shown_rows(cell) for cell in cells]
    names = list(dict.fromkeys(name for each in rows for name in each))
    means: list[list[object]] = []
    single: list[list[object]] = []
    for name in names:
        own = [each[name] for each in rows if name in each]
        depth = [row.depth for row in own if row.depth is not None]
        surface = [row.surface for row in own if row.surface is not None]
        count = sum(len(row.keyframes or ()) for row in own)
        means.append(
            [
                name,
                *(float(np.mean([getattr(d, key) for d in depth])) if depth else None for key in ERRORS),
                *(_surface_cell(title, surface) for title in _SURFACE),
                f"{count} of {sum(cell.keyframes for cell in cells)}",
            ]
        )
        single.append([name, *(_depth_cell(each.get(name)) for each in rows)])
    titles = ", ".join(ERRORS.values())
    left_out = sum(len(cell.left_out) for cell in cells)
    return [
        Table(
            f"30 % wrong points, {kind}: mean over {len(cells)} colons; {left_out} keyframes are left out of all rows, "
            "as their LMedS scale is not trusted. Depth, then the fused surface",
            ["method", *ERRORS.values(), *_SURFACE, "keyframes"],
            means,
        ),
        Table(
            f"30 % wrong points, {kind}, each colon: {titles}",
            ["method", *(f"{cell.scene} ({cell.seed})" for cell in cells)],
            single,
        ),
        *_ratios(cells, kind),
    ]


def _surface_cell(title: str, surfaces: Sequence[SurfaceFigures]) -> object:
    if not surfaces:
        return None
    if title.startswith("P / R / F"):
        key = "1mm" if "1 mm" in title else "2mm"
        shares = ([getattr(s, name)[key] for s in surfaces] for name in ("precision", "recall", "f_score"))
        return " / ".join(f"{np.mean(values):.2f}" for values in shares)
    return float(np.mean([_SURFACE[title](s) for s in surfaces]))


def _depth_cell(row: RowFigures | None) -> str:
    if row is None or row.depth is None:
        return "–"
    return " / ".join(
        f"{getattr(row.depth, key):.3f}" if key == "abs_rel" else f"{getattr(row.depth, key):.2f}" for key in ERRORS
    )


def ratios(cells: Sequence[CellFigures], ours: str, other: str) -> Mapping[str, np.ndarray]:
    """Error of a row over another's, colon by colon (n,), by error; colons without either are left out."""
    pairs = [(rows[ours].depth, rows[other].depth) for rows in map(shown_rows, cells)]
    known = [(mine, theirs) for mine, theirs in pairs if mine is not None and theirs is not None]
    return {key: np.array([getattr(mine, key) / getattr(theirs, key) for mine, theirs in known]) for key in ERRORS}


def _ratios(cells: Sequence[CellFigures], kind: str) -> list[Table]:
    lines: list[list[object]] = []
    for ours in (OURS, DELIVERED):
        for other in (POISSON, BEST_SHIFT, LMEDS):
            found = ratios(cells, ours, other)
            line: list[object] = [f"{ours} / {other}"]
            for values in found.values():
                each = " ".join(f"{value:.2f}" for value in values)
                line.append(f"{each}; {int((values <= BAR).sum())} of {len(values)}")
            lines.append(line)
    title = f"30 % wrong points, {kind}: ratios of the errors, colon by colon; on how many at most {BAR:g}"
    return [Table(title, ["ratio", *ERRORS.values()], lines)]


def notes(cells: Sequence[CellFigures]) -> list[str]:
    """What the figures mean, and which rows have none."""
    which = [f"{cell.scene}, {cell.errors}: {better_shift(cell).removeprefix('scale and shift ')}" for cell in cells]
    said = [
        f"Unit: {UNIT}. Alignment: {ALIGNMENT}.",
        f'"{BEST_SHIFT}" is, colon by colon, the better of two by AbsRel against truth: {"; ".join(which)}.',
        f'"{OURS}" has points and predictions alone, as the others; "{DELIVERED}" is what the verb delivers: images '
        "lessen its bends, and contradicted pixels are left out of its surface.",
    ]
    for cell in cells:
        lacking = {name: row for name, row in cell.rows.items() if name not in METHODS}
        for name, row in lacking.items():
            if row.error:
                said.append(full_stop(f"{cell.scene}, {cell.errors}, {name}: {row.error}"))
    return said
