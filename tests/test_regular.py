"""What is named like a file and is none: a named pipe, a socket, a device. Opened, it would be waited for."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from raising import refused

from lightdepth.cli import main
from lightdepth.datasets.folder import read_times
from lightdepth.files.schema import read_json
from lightdepth.files.text import read_text, text_lines
from lightdepth.prediction import read_prediction
from lightdepth.regular import irregular, regular
from train.frame_lists import read_frame_list

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
READERS = {
    "text": lambda path: read_text(path, "expected a text"),
    "lines": text_lines,
    "JSON": read_json,
    "times": read_times,
    "prediction": read_prediction,
    "names": read_frame_list,
}


@pytest.fixture
def pipe(tmp_path) -> Path:
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_what_is_no_regular_file_is_told_by_its_kind(tmp_path, pipe, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a socket's name may have a hundred letters
    with socket.socket(socket.AF_UNIX) as made:
        made.bind("socket")
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(pipe)
    kinds = {name: irregular(tmp_path / name) for name in ("pipe", "link", "socket", ".", "file", "none", "\0")}
    assert kinds == {
        "pipe": "a named pipe",
        "link": "a named pipe",
        "socket": "a socket",
        ".": "a folder",
        "file": "",
        "none": "",
        "\0": "",
    }
    assert irregular(os.devnull) == "a device"
    assert regular(tmp_path / "file") == tmp_path / "file"


@pytest.mark.parametrize("kind", READERS)
def test_a_pipe_in_a_files_place_is_refused_and_not_waited_for(pipe, kind):
    with refused(where=str(pipe), found="a named pipe"):
        READERS[kind](pipe)


def test_settings_from_a_pipe_are_refused(pipe, tmp_path, capsys):
    assert main(["predict", "D", "-o", str(tmp_path / "out"), "--config", str(pipe)]) == 3
    assert "a named pipe" in capsys.readouterr().err
