"""The panel beside the scene: what it is made of, and what stands in it as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import viser

from densify.thumbnails import said
from densify.viewing.drawn import Parts
from lightdepth.foreign_text import for_terminal
from lightdepth.reporting.scene import Layer, Surface

SHOWN = ("Surface", "Cameras", "Path")
"""What is shown at first; points are not."""
_CLOUDS = ("Points used", "Points found wrong", "Points not judged")
NEAR = "Near wall"
"""Wall that is seen from behind: from outside it hides what is in the lumen."""
_FINE = 16  # colours of a palette, from which on it is a bar


@dataclass(frozen=True, eq=False)
class Panel:
    """The controls, and the texts that change."""

    note: viser.GuiHtmlHandle
    maps: viser.GuiFolderHandle
    together: viser.GuiHtmlHandle
    layer: viser.GuiDropdownHandle[str]
    legend: viser.GuiHtmlHandle
    parts: dict[str, viser.GuiCheckboxHandle]
    size: viser.GuiSliderHandle[float]
    keyframe: viser.GuiSliderHandle[int]
    inside: viser.GuiCheckboxHandle
    outside: viser.GuiButtonHandle
    picture: viser.GuiImageHandle
    caption: viser.GuiHtmlHandle
    row: viser.GuiImageHandle
    row_said: viser.GuiHtmlHandle
    measuring: viser.GuiCheckboxHandle
    measured: viser.GuiHtmlHandle
    clear: viser.GuiButtonHandle

    @classmethod
    def of(cls, gui: viser.GuiApi) -> Panel:
        """A new one, before any map is known."""
        gui.set_panel_label("lightdepth view")
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        gui.main_panel.dock_right()
        note = gui.add_html("")
        with gui.add_folder("Maps") as maps:
            together = gui.add_html(_text("Each map has a frame of reference of its own: shown together, maps are "
                                          "not placed as they are in the body."), visible=False)  # fmt: skip
        with gui.add_folder("Shown"):
            layer = gui.add_dropdown("Colour", ("Of the images",), hint="What the colours of the surface tell")
            legend = gui.add_html("")
            order = (SHOWN[0], NEAR, *SHOWN[1:], *_CLOUDS)
            hints = {NEAR: "Wall that is seen from behind, which from outside hides what is inside"}
            parts = {title: gui.add_checkbox(title, title in SHOWN, hint=hints.get(title)) for title in order}
            size = gui.add_slider("Camera size", min=0.2, max=5.0, step=0.1, initial_value=1.0)
        with gui.add_folder("Measure"):
            hint = "Two clicks on the wall give the length between them"
            measuring = gui.add_checkbox("Click two places", False, hint=hint)
            measured = gui.add_html("")
            clear = gui.add_button("Clear", visible=False)
        with gui.add_folder("Along the path"):
            keyframe = gui.add_slider("Keyframe", min=0, max=1, step=1, initial_value=0)
            inside = gui.add_checkbox("Look from inside", False, hint="From where the keyframe was taken")
            outside = gui.add_button("Look from outside")
            caption = gui.add_html("")
            picture, row = (gui.add_image(np.full((3, 4, 3), 200, np.uint8), visible=False) for _ in range(2))
            row_said = gui.add_html(lines(f"From the left: {', '.join(said().values())}."), visible=False)
        return cls(
            note, maps, together, layer, legend, parts, size, keyframe, inside, outside, picture, caption, row,
            row_said, measuring, measured, clear,
        )  # fmt: skip

    def chosen(self) -> Parts:
        """What is to be shown."""
        shown = frozenset(title for title, box in self.parts.items() if box.value)
        return Parts(self.layer.value, NEAR not in shown, shown, float(self.size.value))

    def offer(self, surfaces: Sequence[Surface]) -> None:
        """The ways to colour these surfaces, and the kinds of points that they have."""
        titles = tuple(dict.fromkeys(layer.title for s in surfaces for layer in s.layers))
        if titles and tuple(self.layer.options) != titles:
            self.layer.options = titles
        clouds = {cloud.title for surface in surfaces for cloud in surface.clouds}
        for title in _CLOUDS:
            self.parts[title].visible = title in clouds

    def explain(self, surfaces: Sequence[Surface]) -> None:
        """What the colours mean, of the first surface that has them."""
        layers = [layer for s in surfaces for layer in s.layers if layer.title == self.layer.value]
        self.legend.content = legend(layers[0]) if layers else ""


def put_value(control: Any, value: object) -> None:
    """Sets a control; viser's annotations take its value for read-only."""
    control.value = value


def _text(words: str) -> str:
    return f'<div style="padding: 0 0.75em 0.5em; font-size: 0.85em; line-height: 1.35">{escape(words)}</div>'


def lines(*said: str) -> str:
    """Sentences, each on a line of its own, as HTML."""
    return "".join(_text(for_terminal(words)) for words in said if words)


def legend(layer: Layer) -> str:
    """What the colours of a layer mean, as HTML."""
    if not layer.legend or layer.palette is None:
        return ""
    colors = [f"rgb({r},{g},{b})" for r, g, b in layer.palette.tolist()]
    if len(colors) > _FINE:
        stops = ", ".join(colors[:: len(colors) // _FINE] + colors[-1:])
        marks = "".join(f"<span>{escape(words)}</span>" for _, words in layer.legend)
        return (
            '<div style="padding: 0 0.75em 0.5em; font-size: 0.8em">'
            f'<div style="height: 0.7em; background: linear-gradient(to right, {stops})"></div>'
            f'<div style="display: flex; justify-content: space-between">{marks}</div></div>'
        )
    swatch = (
        '<span style="display: inline-block; width: 0.8em; height: 0.8em; margin-right: 0.4em; background: {}"></span>'
    )
    rows = [
        f"<div>{swatch.format(colors[round(place * (len(colors) - 1))])}{escape(words)}</div>"
        for place, words in layer.legend
    ]
    return f'<div style="padding: 0 0.75em 0.5em; font-size: 0.8em">{"".join(rows)}</div>'
