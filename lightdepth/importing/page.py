"""The report of an import: what is wrong first, then numbers and charts, then pictures where they are wanted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from lightdepth.counting import counted
from lightdepth.image_quality import Measures
from lightdepth.importing.findings import Finding, exposure_jumps
from lightdepth.importing.selection import KEPT
from lightdepth.reporting.figures import BAD, GOOD, chart, chart_png, jpeg, png
from lightdepth.reporting.report import SMALL, Report, Tile

Picture = tuple[np.ndarray, str, bool]
"""A thumbnail (h, w, 3), its label, and whether the frame was kept."""


FILES = {
    "frames.csv": "every frame with its measures, and why it was left out",
    "camera.json": "the camera",
    "light.json": "the light",
    "mask.png": "white where tissue shows",
    "times.csv": "when each frame was taken",
}
"""What the files of a run are, by pattern."""


def import_page(
    facts: Sequence[Sequence[Any]],
    findings: Sequence[Finding],
    measures: Measures,
    fate: np.ndarray,
    axis: tuple[np.ndarray, str],
    pictures: Sequence[Picture],
    tissue: np.ndarray | None,
) -> Report:
    """`axis` is what the charts run over (n,) and its name; without `pictures` and `tissue` no image of the patient is
    in it."""
    page = Report("Import")
    page.heading("What is wrong, and what to do")
    if findings:
        page.table(["found", "what to do"], [[f.found, f.cure] for f in findings])
    else:
        page.text("Nothing was found wrong.")
    page.heading("What was imported")
    page.table(["", ""], facts)
    page.table(["frames", "count"], [[name, count] for name, count in Counter(fate.tolist()).most_common()])
    page.heading("Frame by frame")
    page.table(["", "median", "lowest tenth", "highest tenth"], _rows(measures))
    page.text(
        f"Brightness jumps by more than 15 % from one frame to the next {counted(exposure_jumps(measures), 'time')}."
    )
    page.figures(_charts(measures, fate, axis))
    if pictures:
        page.heading("Pictures")
        tiles = [Tile(jpeg(picture), label, GOOD if kept else BAD) for picture, label, kept in pictures]
        page.tiles(tiles, "Green: kept. Red: left out. What was blacked out is black here too.", SMALL)
    if tissue is not None:
        page.wide_figures([(png(np.repeat(tissue[..., None], 3, 2).astype(np.uint8) * 255), "White: taken as tissue.")])
    return page


def _rows(measures: Measures) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for label, values, factor in (
        ("brightness, of 255", measures.brightness, 1),
        ("saturated tissue, %", measures.saturated, 100),
        ("dark tissue, %", measures.dark, 100),
        ("sharpness (deviation of the Laplacian / brightness)", measures.sharpness, 1),
        ("change from frame to frame, of 255", measures.change, 1),
        ("combing (1.1 and more: interlaced)", measures.combing, 1),
    ):
        known = values[np.isfinite(values)] * factor
        quantiles = np.quantile(known, (0.5, 0.1, 0.9)) if len(known) else [np.nan] * 3
        rows.append([label, *map(float, quantiles)])
    return rows


def _charts(measures: Measures, fate: np.ndarray, axis: tuple[np.ndarray, str]) -> list[tuple[bytes, str]]:
    where, label = axis
    kept = fate == KEPT
    drawn: list[tuple[bytes, str]] = []
    for title, series in (
        ("Sharpness; dots are the frames kept", [(measures.sharpness, "sharpness", 1)]),
        ("Brightness of the tissue, of 255", [(measures.brightness, "brightness", 1)]),
        ("Share of the tissue", [(measures.saturated, "saturated, %", 100), (measures.dark, "dark, %", 100)]),
        ("Change from frame to frame, of 255; zero where the picture is frozen", [(measures.change, "change", 1)]),
    ):
        figure, axes = chart((5.2, 2.4))
        for values, name, factor in series:
            finite = np.where(np.isfinite(values), values, np.nan) * factor
            axes.plot(where, finite, lw=0.9, label=name)
            if name == "sharpness":
                axes.plot(where[kept], finite[kept], ".", ms=3, color="#00a040")
        axes.set_xlabel(label)
        axes.set_ylim(bottom=0)
        if len(series) > 1:
            axes.legend(frameon=False, fontsize=8)
        drawn.append((chart_png(figure), title))
    return drawn
