"""The site of README, docs/ and cards: built strictly, whole, and fit to be read without a network."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config

ROOT = Path(__file__).resolve().parents[1]
FETCHED = re.compile(r"<(?:script|img|link|iframe)[^>]+(?:src|href)=\"https?://")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the generator's own
def test_the_site_is_built_strictly_and_asks_the_network_for_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path), strict=True))
    pages = {
        path.relative_to(tmp_path).as_posix(): path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.html")
    }
    written = {path.with_suffix(".html").name for path in (ROOT / "docs").glob("*.md")}
    assert {"index.html", "CHANGELOG.html", "data/index.html", "data/c3vd/index.html"} | written <= set(pages)
    assert [name for name, text in pages.items() if FETCHED.search(text)] == []
    assert 'id="bench-per-frame"' in pages["command-line.html"] and "--fusion.voxel" in pages["command-line.html"]
    assert 'src="pictures/frames.jpg"' in pages["index.html"] and 'href="training.html"' in pages["index.html"]
