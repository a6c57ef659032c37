"""The report of a light that was found from a printed board."""

from __future__ import annotations

import numpy as np

from lightdepth.light.fit_on_board import BoardFit, lens_said
from lightdepth.reporting.figures import chart, chart_png
from lightdepth.reporting.report import Report


def board_page(found: BoardFit, what: str) -> Report:
    """The whole page; `what` says what it was found from."""
    lamps, light = found.fit.lamps, found.light
    page = Report("Position of the endoscope's light")
    page.text(f"{what}. The light is {found.summary()}.")
    page.heading("Position")
    rows = [
        [f"{axis} [mm], {towards}", at, wide, deviation]
        for axis, towards, at, wide, deviation in zip(
            "xyz",
            ("to the right", "down", "into the scene"),
            map(float, lamps.middle),
            map(float, found.half_width),
            map(float, found.deviation),
            strict=True,
        )
    ]
    page.table(["from the camera's centre", "found", "half of the 90 % interval", "standard deviation"], rows)
    page.text(
        "The interval is the larger of two: that of fits to frames drawn anew, and that of the fit itself. It does not "
        "contain what the model leaves out: gloss, a bent board, tone mapping."
    )
    if len(lamps.shares) > 1:
        page.heading("Lamps")
        page.table(
            ["share of the light", "x [mm]", "y [mm]", "z [mm]"],
            [[float(share), *map(float, place)] for share, place in zip(lamps.shares, lamps.places, strict=True)],
        )
    page.heading("Light and response")
    page.table(
        ["", "found"],
        [
            ["gamma", light.gamma],
            ["mu, seen through the lens", light.mu],
            ["of it, the lens's own", found.lens_mu],
            ["axis: degrees from the camera's", float(np.degrees(np.arccos(np.clip(lamps.axis[2], -1, 1))))],
            ["stray light, as a share of the lamps' own", lamps.stray],
        ],
    )
    if said := lens_said(found.lens_mu):
        page.text(f"The lens's own mu is {found.lens_mu:.2f}{said}.")
    page.heading("Frames kept from the fit")
    page.table(
        ["lamps", "what they leave (median, in deviations of the noise)"],
        [[str(number), error] for number, error in found.withheld.items()],
    )
    page.heading("Boards")
    page.figures([(_chart(found), "What is left of the white's brightness, by frame")])
    page.table(
        ["frame", "distance [mm]", "tilt [degrees]", "corners [pixels off]", "white places", "saturated", "left over"],
        [
            [white.name, white.pose.distance, white.pose.tilt, white.pose.error, len(white), white.clipped, float(left)]
            for white, left in zip(found.whites, found.left_by_frame, strict=True)
        ],
    )
    return page


def _chart(found: BoardFit) -> bytes:
    figure, axes = chart((6.4, 2.6))
    axes.bar(range(len(found.whites)), 100 * found.left_by_frame, color="#2a6f97")
    axes.set_xlabel("frame")
    axes.set_ylabel("left over [%]")
    return chart_png(figure)
