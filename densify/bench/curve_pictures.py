"""Pictures of curves: error against coverage, and error by true depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from densify.bench.curves import Band, FrontPoint
from lightdepth.reporting.figures import chart_png


def panels_for(titles: Sequence[str]) -> tuple[Any, Sequence[Any]]:
    """A figure with axes for each title, two in a row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    down = len(titles) // 2
    layout = ConstrainedLayoutEngine(h_pad=0.12)  # with less, a title touches the name of the axis above it
    figure = Figure(figsize=(9.8, 3.5 * down + 0.6), dpi=110, layout=layout)
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(down, 2, squeeze=False).ravel())
    for axes, title in zip(panels, titles, strict=True):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
        axes.set_title(title, fontsize=10)
    return figure, panels


def legend_below(figure: Any, axes: Any) -> None:
    """The lines of some axes, named below all of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)


def band_means(bands: Sequence[Band]) -> tuple[list[float], np.ndarray]:
    """Middles of the bands, and AbsRel and bias (2, n) of each, weighted by pixels."""
    edges = sorted({(band.from_mm, band.to_mm) for band in bands})
    values = []
    for edge in edges:
        own = [band for band in bands if (band.from_mm, band.to_mm) == edge]
        weights = [band.pixels for band in own]
        values.append([np.average([getattr(b, key) for b in own], weights=weights) for key in ("abs_rel", "bias")])
    return [(low + high) / 2 for low, high in edges], np.array(values).T.reshape(2, -1)


def draw_front(axes: Any, fronts: Sequence[Sequence[FrontPoint]], by: str, color: str, name: str = "") -> None:
    """Median error over recall of surfaces that are kept `by` something: a thin line for each, and a thick one for
    their mean where all have as many points."""
    lines = [[(p.recall_2mm, p.median_mm) for p in front if p.by == by] for front in fronts]
    lines = [line for line in lines if line]
    for line in lines:
        axes.plot(*np.array(line).T, color=color, linewidth=0.7, alpha=0.5, marker=".", markersize=3)
    label = name or f"kept by {by}"
    if lines and len({len(line) for line in lines}) == 1:
        axes.plot(*np.mean(lines, 0).T, color=color, linewidth=2.4, label=label)
    elif lines:
        axes.plot([], [], color=color, linewidth=0.7, label=f"{label}, each colon")


def name_front(axes: Any) -> None:
    """Names the axes of `draw_front`."""
    axes.set_xlabel("true points within 2 mm (recall)")
    axes.set_ylabel("median error [mm]")
    axes.set_ylim(0)


def bench_picture(cells: Sequence[Mapping[str, Any]]) -> bytes | None:
    """bench.png, of the cells of bench.json: for each share of wrong points and each case the front of each dense row,
    by expected error, and its AbsRel by true depth. None where no row has curves."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for cell in cells:
        if any(row.get("bands") for row in cell["rows"].values()):
            groups.setdefault(cell.get("case") or f"{cell['wrong_share']:.0%} wrong points", []).append(cell)
    if not groups:
        return None
    figure, panels = panels_for([f"{what}, {group}" for group in groups for what in ("surface", "AbsRel")])
    for i, of in enumerate(groups.values()):
        surface, depth = panels[2 * i], panels[2 * i + 1]
        names = dict.fromkeys(name for cell in of for name, row in cell["rows"].items() if row.get("bands"))
        for k, name in enumerate(names):
            rows = [cell["rows"][name] for cell in of if name in cell["rows"]]
            fronts = [[FrontPoint(**point) for point in row.get("front", ())] for row in rows]
            draw_front(surface, fronts, "expected error", f"C{k}", name)
            places, values = band_means([Band(**band) for row in rows for band in row.get("bands", ())])
            depth.plot(places, 100 * values[0], color=f"C{k}", label=name)
        name_front(surface)
        depth.set_xlabel("true depth [mm]")
        depth.set_ylabel("%")
        depth.set_ylim(0)
        depth.legend(frameon=False, fontsize=8)
    return chart_png(figure)
