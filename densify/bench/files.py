"""What benchmarks write beside each other: tables as text and on a page, and every figure for programs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from densify.evaluation.page import tables_page
from densify.evaluation.tables import Table
from lightdepth.reporting.run import Run, plain


def write_tables(
    run: Run,
    name: str,
    title: str,
    shown: Sequence[Table],
    said: Sequence[str],
    pictures: Sequence[tuple[bytes, str]],
) -> None:
    """Tables and the sentences below them as NAME.md, in the log, and with the pictures on a page."""
    text = "\n".join([*(table.markdown() for table in shown), *(f"{line}\n" for line in said)])
    (run.folder / f"{name}.md").write_text(text, encoding="utf-8", errors="backslashreplace")
    page = tables_page(title, said, shown, pictures)
    page.files(run.folder, {f"{name}.md": "the tables", f"{name}.json": "every figure, for programs"})
    page.write(run.folder / "report.html")
    run.log(text)


def write_json(run: Run, name: str, data: Mapping[str, object]) -> None:
    """Every figure, as a file of the run."""
    (run.folder / name).write_text(json.dumps(plain(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")
