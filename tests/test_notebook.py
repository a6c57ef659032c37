"""The notebook runs from its first cell to its last, shows what it says, and is kept without what it showed."""

from __future__ import annotations

import re
import time
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LINK = re.compile(r"\]\(([^)#]+)")


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def test_notebooks_are_kept_without_outputs_and_their_links_lead_somewhere():
    assert NOTEBOOKS
    for path in NOTEBOOKS:
        notebook = read(path)
        nbformat.validate(notebook)
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert [cell for cell in code if cell.outputs or cell.execution_count is not None] == [], "clear all outputs"
        links = {link for cell in notebook.cells if cell.cell_type == "markdown" for link in LINK.findall(cell.source)}
        assert [link for link in links if not (path.parent / link).exists()] == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # jupyter's own
def test_the_notebook_ends_with_a_surface_that_is_better_than_its_points_where_confidence_tells_how_good(
    tmp_path, monkeypatch
):
    from nbclient import NotebookClient

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    notebook = read(ROOT / "notebooks" / "tube-to-surface.ipynb")
    start = time.perf_counter()
    where = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=None, kernel_name="python3", resources=where).execute()
    print(f"{time.perf_counter() - start:.0f} s")
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    said = "".join(output.get("text", "") for output in outputs)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    share = {name: float(off) for name, off in re.findall(r"^(\S+) +is off by ([\d.]+) %", said, re.M)}
    assert share["lightdepth-both"] < share["decline"] < share["constant"]
    assert "12 of 12 keyframes aligned" in said and "verdict, without the truth: green" in said
    within = {what: float(mm) for what, mm in re.findall(r"^(\w+) \w+: .*nine in ten within ([\d.]+) mm", said, re.M)}
    assert within["dense"] < 4 < within["sparse"]
    assert "Open3D" not in said  # no window system of its own is started
    assert list(tmp_path.glob("*/data")) == []  # what it made, it took away
