"""The report of `bench completion`: tables, curves, and a keyframe of each cell with where every way errs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from densify.bench.completion.figures import CellFigures
from densify.bench.completion.methods import LMEDS, METHODS, OURS, POISSON
from densify.bench.completion.tables import BEST_SHIFT, better_shift, notes, shown_rows, tables
from densify.bench.completion.work import DELIVERED, Judged
from densify.bench.curve_pictures import band_means, draw_front, legend_below, name_front, panels_for
from densify.bench.curves import SortedPoint
from densify.evaluation.errors import true_depth
from lightdepth.geometry import depth_from_distance
from lightdepth.reporting.figures import (
    BAD,
    GOOD,
    chart_png,
    colored_distance,
    jpeg,
    marked_points,
    signed_colors,
    thumbnail,
)
from lightdepth.reporting.report import Report, Tile

_WORST = 0.25
"""Relative error that is drawn in full red (too far) or full blue (too near)."""
_COLORS = ["#888888", "#444444", "#e0a030", "#c03030", "#60a0d8", "#1060b0", "#108040", "#a040a0", "#60c0a0"]


def keyframe_pictures(judged: Judged) -> list[Tile]:
    """Of a cell's middle keyframe: the image with its points (green in, red out), true depth, and the errors of some
    ways, red where the wall is put too far, blue where too near."""
    task = judged.task
    k = task.keyframes[len(task.keyframes) // 2]
    name, frame = k.keyframe.name, task.seen[k.keyframe.name].frame
    assert frame is not None and frame.true_distance is not None and k.observed is not None
    good = np.isin(k.observed.point_ids, k.alignment.inlier_ids)
    truth, known = true_depth(frame, 100.0)
    shown = {
        "points": marked_points(frame.image, [(k.observed.pixels[~good], BAD), (k.observed.pixels[good], GOOD)], 320),
        "true depth": thumbnail(colored_distance(truth, known), 320),
    }
    rows = {LMEDS: LMEDS, BEST_SHIFT: better_shift(judged.figures), POISSON: POISSON, OURS: OURS, DELIVERED: DELIVERED}
    rows |= {row: row for row in judged.completed if row not in (*METHODS, DELIVERED)}
    for title, row in rows.items():
        prediction = judged.completed[row].get(name)
        if prediction is not None:
            depth = depth_from_distance(prediction.distance, frame.camera.rays()[0][..., 2])
            ratio = judged.mm_per_unit * depth / np.where(known, truth, 1)
            shown[title] = thumbnail(signed_colors((ratio - 1) / _WORST, known & prediction.valid), 320)
    return [Tile(jpeg(picture), title) for title, picture in shown.items()]


def band_picture(cells: Sequence[CellFigures]) -> bytes:
    """AbsRel and bias by true depth, every row a line, over the pixels of all colons; a row of panels for each kind."""
    kinds = list(dict.fromkeys(cell.errors for cell in cells))
    figure, panels = panels_for([f"{what}, {kind}" for kind in kinds for what in ("AbsRel", "bias")])
    for i, kind in enumerate(kinds):
        of = [shown_rows(cell) for cell in cells if cell.errors == kind]
        for color, name in zip(_COLORS, of[0], strict=False):
            rows = [row for each in of if (row := each.get(name)) is not None]
            places, values = band_means([band for row in rows for band in row.bands])
            for j in (0, 1):
                width = 2.2 if name in (OURS, DELIVERED) else 1.3
                panels[2 * i + j].plot(places, 100 * values[j], label=name, color=color, linewidth=width)
        for axes in panels[2 * i : 2 * i + 2]:
            axes.set_xlabel("true depth [mm]")
            axes.set_ylabel("%")
        panels[2 * i].set_ylim(0)
        panels[2 * i + 1].axhline(0, color="black", linewidth=0.6)
    legend_below(figure, panels[0])
    return chart_png(figure)


def front_picture(cells: Sequence[CellFigures]) -> bytes:
    """Error against coverage: the surface's median error over the share of the truth within 2 mm of it, by expected
    error and by views, a thin line for each colon and a thick one for their mean; and the depth's AbsRel over the
    share of pixels kept."""
    kinds = list(dict.fromkeys(cell.errors for cell in cells))
    figure, panels = panels_for([f"{what}, {kind}" for kind in kinds for what in ("surface", "depth")])
    for i, kind in enumerate(kinds):
        of = [cell for cell in cells if cell.errors == kind]
        surface, depth = panels[2 * i], panels[2 * i + 1]
        for by, color in (("expected error", "#1060b0"), ("views", "#e0a030")):
            draw_front(surface, [cell.front for cell in of], by, color)
        stated = [cell.sorted for cell in of if cell.sorted]
        ways: dict[str, Callable[[SortedPoint], float]] = {
            "by predicted uncertainty": lambda p: p.by_uncertainty,
            "by the error itself": lambda p: p.by_error,
        }
        for (label, value), color in zip(ways.items(), ("#1060b0", "#888888"), strict=True):
            if stated:
                curve = np.mean([[value(p) for p in points] for points in stated], 0)
                depth.plot([100 * p.kept_share for p in stated[0]], 100 * curve, color=color, label=label)
        name_front(surface)
        depth.set_xlabel("pixels kept [%]")
        depth.set_ylabel("AbsRel [%]")
        depth.set_ylim(0)
        for axes in (surface, depth):
            if axes.get_legend_handles_labels()[0]:
                axes.legend(frameon=False, fontsize=8)
    return chart_png(figure)


def page(cells: Sequence[CellFigures], pictures: Sequence[tuple[Sequence[Tile], str]]) -> Report:
    """The whole page; `pictures` are keyframes with captions."""
    report = Report("Completion from sparse points")
    for note in notes(cells):
        report.text(note)
    for table in tables(cells):
        report.heading(table.title)
        report.table(table.headers, table.rows)
    report.heading("Error by true depth")
    report.wide_figures(
        [(band_picture(cells), "AbsRel and bias (above 0: too far) by true depth, pixels of all colons")]
    )
    report.heading("Error against coverage, of what densify delivers")
    caption = (
        "Surface: median error over the share of the truth that is met, vertices dropped from the least trusted on. "
        "Depth: AbsRel over the share of pixels kept, the most uncertain dropped first"
    )
    report.wide_figures([(front_picture(cells), caption)])
    report.heading("A keyframe of each colon")
    for tiles, caption in pictures:
        report.tiles(tiles, caption, 220)
    return report
