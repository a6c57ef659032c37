"""The report of a played sequence: the verdict, agreement with the map ahead, and where the time went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from densify.judging.ahead import Ahead, running
from densify.live.play import Played
from densify.scene import SURFACE_FILES
from lightdepth.counting import full_stop
from lightdepth.reporting.figures import chart, chart_png
from lightdepth.reporting.report import Report
from lightdepth.reporting.scene import Scene

FILES = {
    **SURFACE_FILES,
    "timings.csv": "what each keyframe's time went into",
}
"""What the files of a run are, by pattern."""


def live_page(
    verdict: str,
    judged: Mapping[int, Ahead],
    played: Sequence[Played],
    notes: Sequence[str],
    timings: bytes,
    scene: Scene | None = None,
) -> Report:
    """The whole page; `verdict` in words and `judged` by map, empty where nothing was, `notes` sentences on what was
    played and how long it took, `timings` the picture of that (PNG), `scene` the finished surfaces."""
    page = Report("Live surfaces")
    if verdict:
        page.text(full_stop(f"Verdict: {verdict}"))
    for note in notes:
        page.text(note)
    if scene is not None:
        page.heading("The surface in three dimensions")
        page.scene(scene)
    if verdict:
        _agreement(page, judged, played)
    page.heading("Time")
    page.wide_figures([(timings, "What each keyframe's time went into")])
    return page


def _agreement(page: Report, judged: Mapping[int, Ahead], played: Sequence[Played]) -> None:
    page.heading("Agreement with the map ahead")
    page.text(
        "How far the depth of the last aligned keyframe is from points that the map measured after it, as a share, in "
        "the median. This is agreement, not error: map and surface may have drifted together. New points lie beside "
        "points that were used, at the rim of what was known. A constant distance gets the same help, one scale or a "
        "bend, and is compared at the same points. When a surface is finished, the images judge it as well, by "
        "distances from parallax between its keyframes, which nothing was fitted to. Where they can judge, the verdict "
        "is theirs."
    )
    rows = []
    for number, found in judged.items():
        c = found.columns
        ways = [c.one_scale, c.bent, c.constant_one_scale, c.constant_bent]
        asked = found.surface
        images = [asked.points if asked else 0, asked.median_met if asked and asked.median_met is not None else "-"]
        rows.append([f"map {number}", c.count, found.by_points, *ways, *images])
    headers = ["", "new points", "as fused", "one scale", "bent", "constant, one scale", "constant, bent"]
    headers += ["pixels of the images", "surface from them"]
    page.table(headers, rows)
    for number, found in judged.items() if len(judged) > 1 else ():  # a single one is said above
        page.text(full_stop(f"Map {number}: {found.verdict}"))
    page.wide_figures(
        [(_running_picture(judged, played), "The same while the surfaces grew: medians up to each keyframe")]
    )


def _running_picture(judged: Mapping[int, Ahead], played: Sequence[Played]) -> bytes:
    figure, axes = chart((7.2, 2.6))
    place = np.arange(len(played))
    for count, number in enumerate(judged):
        rows = np.array([p.map == number for p in played])
        medians = 100 * running([p.ahead for p in played if p.map == number])
        for column, (color, label) in enumerate((("#2a6f97", "as fused"), ("#8c8c8c", "constant distance"))):
            axes.plot(place[rows], medians[:, column], color=color, label=None if count else label)
    axes.set_xlim(-0.5, len(played) - 0.5)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("keyframe")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("off by [%]")
    axes.legend(frameon=False, fontsize=8)
    return chart_png(figure)
