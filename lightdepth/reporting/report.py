"""One offline HTML file: headings, sentences, tables, pictures and scenes, with nothing loaded from anywhere.

report.css and scene_*.js, beside this module, go into the page.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lightdepth.foreign_text import for_terminal
from lightdepth.reporting.figures import Chart
from lightdepth.reporting.scene import Scene

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; base-uri 'none'"
"""What a browser is told to refuse: all that does not stand in the page."""

_VIEWPORT = '<meta name="viewport" content="width=device-width, initial-scale=1">'
_KINDS = {b"\xff\xd8": "jpeg", b"RIFF": "webp"}
"""Pictures by how they begin; others are PNG."""
_SHORT = 14
"""Characters of a cell that stay in one line."""
_WIDE = 720
"""Width of a chart, pixels, from which on its words are too small to read when all of it is on a phone's page."""
SMALL = 110
"""Width of a tile of many, pixels of the page: three beside each other on a phone."""
_OF_EVERY_RUN = [
    ("config.yaml", "the settings of this run"),
    ("log.txt", "what it said"),
    ("run.json", "what was done, with figures, versions and warnings"),
]
_OPENERS = "MeshLab, CloudCompare and Blender"


@dataclass(frozen=True)
class Tile:
    """A picture (PNG, JPEG or WebP) among others, what is written below it, and the RGB colour of its frame."""

    picture: bytes
    label: str
    color: tuple[int, int, int] | None = None


class Report:
    """Collects the parts of a page in order."""

    def __init__(self, title: str):
        self._title, self._heading, self._drawn = title, title, False
        self._parts = [f"<h1>{_shown(title)}</h1>"]

    def heading(self, text: str) -> None:
        self._heading = text
        self._parts.append(f"<h2>{_shown(text)}</h2>")

    def text(self, text: str) -> None:
        self._parts.append(f"<p>{_shown(text)}</p>")

    def table(self, headers: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Numbers are shown with three significant digits; give strings where that is not wanted."""
        of_words = [bool(rows) and isinstance(rows[0][i], str) for i in range(len(headers))]
        head = f"<thead><tr>{''.join(map(_header, headers, of_words))}</tr></thead>" if any(headers) else ""
        body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
        name = f"Table: {_shown(self._heading)}"  # one that is wider than a phone is scrolled in a box, by keys too
        self._parts.append(
            f'<div class="table" role="group" tabindex="0" aria-label="{name}">'
            f"<table>{head}<tbody>{body}</tbody></table></div>"
        )

    def files(self, folder: Path, what: Mapping[str, str], of_a_run: bool = True) -> None:
        """Links to files that lie beside the page: `what` says what those of a pattern are, in the order in which they
        are shown; then, of a run, come those that every run writes last."""
        found = [
            (path.relative_to(folder).as_posix(), said)
            for pattern, said in what.items()
            for path in sorted(folder.glob(pattern))
            if path.is_file()
        ]
        self.links([*found, *(_OF_EVERY_RUN if of_a_run else ())])

    def links(self, files: Sequence[tuple[str, str]]) -> None:
        """Links to files by their path from the page, and what each is."""
        self.heading("Files")
        links = (f'<li><a href="{quote(name)}">{_shown(name)}</a>: {_shown(said)}</li>' for name, said in files)
        self._parts.append(f'<ul class="files">{"".join(links)}</ul>')
        if any(name.endswith((".ply", ".obj", ".glb", ".stl")) for name, _ in files):
            self.text(f"Open surfaces and points with {_OPENERS}.")

    def scene(self, scene: Scene) -> None:
        """A scene that turns; a still picture where a browser cannot draw it."""
        still = _figure(scene.still, "The surface from outside, a still picture").replace("<figure", _STILL, 1)
        said = "Without JavaScript there is a still picture here, and no scene that turns."
        self._parts.append(
            f'<div class="scene">{still}<noscript><p>{said}</p></noscript>'
            f'<script type="application/json">{scene.text()}</script></div>'
        )
        self._drawn = True

    def figures(self, pictures: Sequence[tuple[bytes, str]]) -> None:
        """Pictures (PNG, JPEG or WebP) with captions, beside each other where there is room."""
        self._parts.append('<div class="figures">' + "".join(_figure(*p) for p in pictures) + "</div>")

    def wide_figures(self, pictures: Sequence[tuple[bytes, str]]) -> None:
        """Pictures (PNG, JPEG or WebP) with captions, one below the other."""
        self._parts += [_figure(*p) for p in pictures]

    def tiles(self, tiles: Sequence[Tile], caption: str, width: int = 300) -> None:
        """Small pictures in rows, as many in one as there is room for at some `width` each, in pixels of the page, and
        one caption for all. Words stand below them, and not in them: on a phone they are as large as elsewhere."""
        made = "".join(f"<figure{_edge(t.color)}>{_image(t.picture, f'{t.label}, {self._heading}')}"
                       f"<figcaption>{_shown(t.label)}</figcaption></figure>" for t in tiles)  # fmt: skip
        self._parts.append(
            f'<figure class="tiles" style="--wide: {width}px"><div>{made}</div>'
            f"<figcaption>{_shown(caption)}</figcaption></figure>"
        )

    def write(self, path: Path) -> None:
        head = (
            f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}">{_VIEWPORT}'
            f"<title>{_shown(self._title)}</title><style>{_beside('report.css')}</style>"
        )
        drawing = f"<script>{_drawing()}</script>" if self._drawn else ""
        path.write_text(
            f'<!doctype html><html lang="en"><head>{head}</head>'
            f"<body><main>{''.join(self._parts)}</main>{drawing}</body></html>\n",
            encoding="utf-8",
            errors="backslashreplace",  # names that are not UTF-8
        )


_STILL = '<figure class="scene-still"'


@cache
def _beside(name: str) -> str:
    """A text that is installed beside this module."""
    return package_files("lightdepth.reporting").joinpath(name).read_text(encoding="utf-8")


def _drawing() -> str:
    """What draws scenes, as one strict function."""
    return f'(() => {{\n"use strict";\n{_beside("scene_surface.js")}\n{_beside("scene_viewer.js")}}})();'


def _shown(text: str) -> str:
    """A text in which names of strangers are neither markup nor turn the direction of writing round."""
    return html.escape(for_terminal(text))


def _figure(data: bytes, caption: str) -> str:
    image = _image(data, caption)
    if isinstance(data, Chart) and data.width > _WIDE:
        image = f'<div class="broad" role="group" tabindex="0" aria-label="{_shown(caption)}">{image}</div>'
    return f"<figure>{image}<figcaption>{_shown(caption)}</figcaption></figure>"


def _image(data: bytes, words: str) -> str:
    kind = next((kind for begin, kind in _KINDS.items() if data.startswith(begin)), "png")
    drawn = f' class="chart" style="--drawn: {data.width}px"' if isinstance(data, Chart) else ""
    return f'<img{drawn} alt="{_shown(words)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}">'


def _edge(color: tuple[int, int, int] | None) -> str:
    return "" if color is None else f' style="--edge: rgb({", ".join(map(str, color))})"'


def _header(text: str, of_words: bool) -> str:
    kind = ' class="text"' if of_words else ""
    return f'<th scope="col"{kind}>{_shown(text)}</th>' if text else f"<td{kind}></td>"


def _cell(value: Any) -> str:
    if isinstance(value, str):
        kind = "text short" if len(value) <= _SHORT else "text"
        return f'<td class="{kind}">{_shown(value)}</td>'
    return f"<td>{number(value)}</td>"


def number(value: Any) -> str:
    """A number for people: integers whole, others with three significant digits, nothing as a dash."""
    if value is None or (isinstance(value, float) and value != value):
        return "–"
    if isinstance(value, int):
        return str(value)
    if value == float("inf"):
        return "∞"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
