"""The folder that a user is in goes while a verb works: one sentence and exit code 5, whatever a library says."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lightdepth.cli import main
from lightdepth.errors import InputError
from lightdepth.reporting.run import run_folder


def no_input() -> None:
    raise InputError("../colon", "does not exist", "expected a folder of frames")


def in_a_run() -> None:
    with run_folder(Path("out"), "predict", {}):
        pass


@pytest.mark.parametrize("then", [os.getcwd, lambda: Path("camera.json").read_text("utf-8"), no_input, in_a_run])
def test_a_folder_that_goes_under_a_verb_is_told_as_such_whatever_stumbles_over_it(tmp_path, monkeypatch, capsys, then):
    def gone(*_):
        (tmp_path / "here").rmdir()
        then()

    monkeypatch.setattr("lightdepth.commands.convert_camera.read_camera", gone)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert main(["convert-camera", str(tmp_path / "a.json"), "-o", str(tmp_path / "b.json")]) == 5
    said = capsys.readouterr().err
    assert "the folder that you are in is gone" in said and len(said.splitlines()) == 1
    monkeypatch.chdir(tmp_path)
    assert not os.listdir(tmp_path)
