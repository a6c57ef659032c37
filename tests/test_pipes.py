"""A reader of a verb's output that leaves, and settings that YAML reads as something else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from test_cli import SMALL, lightdepth

from lightdepth.command_line.warned import warnings_as_sentences


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("piped") / "seq"
    argv = ["--frames", 8, "--size", "[96, 80]", "--travel-mm", 10, "--lens", "pinhole", "--slam.keyframe-every", 1]
    assert lightdepth("synth", "-o", folder, *argv, *SMALL) == 0
    return folder


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_run_stands_when_nobody_reads_what_it_says(data, tmp_path, monkeypatch, stream):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w", buffering=1) as gone:
        monkeypatch.setattr(sys, stream, gone)
        assert lightdepth("predict", data, "--checkpoint", "decline", "-o", tmp_path / "run") == 0
        monkeypatch.undo()
    assert json.loads((tmp_path / "run" / "run.json").read_text())["failures"] == []
    assert len(list((tmp_path / "run").rglob("*.npz"))) == 8 and not list(tmp_path.glob(".run-*"))


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_run_stands_where_what_it_says_finds_no_room_and_the_end_says_so(data, tmp_path, monkeypatch, stream):
    with open("/dev/full", "w", buffering=1) as full:
        monkeypatch.setattr(sys, stream, full)
        code = lightdepth("predict", data, "--checkpoint", "decline", "-o", tmp_path / "run", "--resume")
        monkeypatch.undo()
    assert code == 5 and (tmp_path / "run" / "run.json").is_file()
    assert len(list((tmp_path / "run").rglob("*.npz"))) == 8


@pytest.mark.parametrize(("closed", "code"), [("", 0), ("nothing", 2)])
def test_a_program_without_a_terminal_at_all_ends_as_it_would_with_one(closed, code):
    streams = "<&- >&- 2>&-" if closed else ">&-"
    words = f'"{sys.executable}" -m lightdepth {closed or "--help"} {streams}'
    done = subprocess.run(["sh", "-c", words], stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (code, "")


def test_in_a_folder_that_is_gone_a_verb_says_so(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert lightdepth("synth", "-o", "x") == 5
    assert "the folder that you are in is gone" in capsys.readouterr().err


def test_a_warning_is_one_sentence_without_a_place_in_the_code(tmp_path):
    (tmp_path / "k.yaml").write_text("{image_width: 640, image_height: 480, K: [0.9, 1.1, 0.5, 0.5], D: [0, 0, 0, 0]}")
    argv = [sys.executable, "-m", "lightdepth", "convert-camera", "k.yaml", "-o", "camera.json"]
    done = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("warning: k.yaml: camera_matrix is in fractions of the image's sides") and ".py" not in line


def test_how_warnings_look_is_changed_for_the_command_alone(tmp_path):
    before = warnings.formatwarning
    with warnings_as_sentences():
        assert warnings.formatwarning("two\nlines", UserWarning, "a.py", 3) == "warning: two lines\n"
        assert "a.py:3: DeprecationWarning" in warnings.formatwarning("old", DeprecationWarning, "a.py", 3)
    assert warnings.formatwarning is before


@pytest.mark.parametrize("group", ["judge", "judge.parallax", "bending"])
def test_a_switch_is_read_from_yaml_without_quotes(group, tmp_path, capsys):
    text = "on: false"
    for name in reversed(group.split(".")):
        text = f"{name}: {{{text}}}"
    (tmp_path / "settings.yaml").write_text(text)
    for config in (tmp_path / "settings.yaml", text):
        assert lightdepth("densify", "frames", "-o", "out", "--config", config, "--print_config") == 0
        shown = capsys.readouterr().out
        assert f"{group}: on is False" in _switches(shown), shown


def _switches(text: str) -> list[str]:
    """The switches of printed settings, each with its group and what it is."""
    import yaml

    def below(node: object, above: str) -> list[str]:
        if not isinstance(node, dict):
            return []
        own = [f"{above}: on is {value}" for key, value in node.items() if key in ("on", True)]
        return own + [s for key, value in node.items() for s in below(value, f"{above}.{key}".lstrip("."))]

    return below(yaml.safe_load(text), "")


def test_a_mistyped_setting_beside_a_switch_is_still_named(tmp_path, capsys):
    (tmp_path / "settings.yaml").write_text("judge:\n  on: false\n  fold: 3\n")
    assert lightdepth("densify", "frames", "-o", "out", "--config", tmp_path / "settings.yaml") == 2
    assert "judge.fold" in capsys.readouterr().err
