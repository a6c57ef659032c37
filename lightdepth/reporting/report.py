"""One offline HTML file: headings, sentences, tables and pictures, with nothing loaded from anywhere."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightdepth.foreign_text import for_terminal

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1080px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; margin: .8rem 0; } th, td { padding: .25rem .8rem; text-align: right; }
th { border-bottom: 2px solid #888; font-weight: 600; } td { border-bottom: 1px solid #e5e5e5; }
th:first-child, td:first-child { text-align: left; } td.text, th.text { text-align: left; }
figure { margin: 1rem 0; } figure img { max-width: 100%; } figcaption { color: #555; font-size: .9rem; }
h1, h2, p, figcaption { overflow-wrap: anywhere; }  td.text { overflow-wrap: anywhere; min-width: 5rem; }
.figures { display: flex; flex-wrap: wrap; gap: 1rem; } .figures figure { margin: 0; flex: 1 1 300px; }
"""


class Report:
    """Collects the parts of a page in order."""

    def __init__(self, title: str):
        self._title = title
        self._parts = [f"<h1>{_shown(title)}</h1>"]

    def heading(self, text: str) -> None:
        self._parts.append(f"<h2>{_shown(text)}</h2>")

    def text(self, text: str) -> None:
        self._parts.append(f"<p>{_shown(text)}</p>")

    def table(self, headers: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Numbers are shown with three significant digits; give strings where that is not wanted."""
        of_words = [bool(rows) and isinstance(rows[0][i], str) for i in range(len(headers))]
        classes = [' class="text"' if words else "" for words in of_words]
        head = "".join(f"<th{c}>{_shown(h)}</th>" for h, c in zip(headers, classes, strict=True))
        body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
        self._parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")

    def figures(self, pictures: Sequence[tuple[bytes, str]]) -> None:
        """PNG pictures with captions, beside each other where there is room."""
        self._parts.append('<div class="figures">' + "".join(_figure(*p) for p in pictures) + "</div>")

    def wide_figures(self, pictures: Sequence[tuple[bytes, str]]) -> None:
        """PNG pictures with captions, one below the other."""
        self._parts += [_figure(*p) for p in pictures]

    def write(self, path: Path) -> None:
        head = f'<meta charset="utf-8"><title>{_shown(self._title)}</title><style>{_STYLE}</style>'
        path.write_text(
            f"<!doctype html><html lang=en><head>{head}</head><body>{''.join(self._parts)}</body></html>\n",
            encoding="utf-8",
            errors="backslashreplace",  # names that are not UTF-8
        )


def _shown(text: str) -> str:
    """A text in which names of strangers are neither markup nor turn the direction of writing round."""
    return html.escape(for_terminal(text))


def _figure(data: bytes, caption: str) -> str:
    source = base64.b64encode(data).decode()
    text = _shown(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{source}"><figcaption>{text}</figcaption></figure>'


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return f'<td class="text">{_shown(value)}</td>'
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
