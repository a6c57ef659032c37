"""When `view --rerun` writes over a file; the package that draws a recording stands aside, as few have it."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
from view_runs import write_run

from lightdepth.cli import main


@pytest.fixture
def recording(monkeypatch) -> None:
    """What is recorded is a text that begins as a recording does."""
    made = SimpleNamespace(BEGINNING="RRF2", recorded=lambda maps, known: f"RRF2 {len(maps)} new".encode())
    monkeypatch.setitem(sys.modules, "densify.viewing.recording", made)


def test_a_recording_that_is_there_is_replaced_only_where_that_is_asked(recording, tmp_path, capsys):
    run, file = write_run(tmp_path / "run"), tmp_path / "run.rrd"
    words = ["view", str(run), "--rerun", str(file)]
    assert main(words) == 0 and file.read_text() == "RRF2 1 new"
    file.write_text("RRF2 of an hour's work")
    assert main(words) == 3 and file.read_text() == "RRF2 of an hour's work"
    assert f"{file}: already there; choose another name, or give --overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0 and file.read_text() == "RRF2 1 new"
    file.write_text("another program's")
    assert main([*words, "--overwrite"]) == 3 and file.read_text() == "another program's"
    assert "was not made by this verb" in capsys.readouterr().err


def test_overwrite_without_a_file_to_write_is_refused(tmp_path, capsys):
    assert main(["view", str(tmp_path), "--overwrite"]) == 3
    assert "--overwrite: given without --rerun: nothing is written" in capsys.readouterr().err
