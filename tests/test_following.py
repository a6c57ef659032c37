"""What a verb says comes next: with the names of its inputs where it goes to a terminal, without them elsewhere."""

from __future__ import annotations

import io
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import colon, slam

from lightdepth.cli import main
from lightdepth.command_line.following import PLACES, Input, command, given
from lightdepth.command_line.outcome import end
from lightdepth.datasets import SequenceSource
from lightdepth.detective import PairingConfig
from lightdepth.tube.export import write_synthetic


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_command_has_names_for_a_terminal_and_words_elsewhere():
    said = command("measure", Input("RUN", Path("a run")), options={"--points": PLACES, "-o": Path("my lengths.json")})
    assert said.said(io.StringIO()) == f"lightdepth measure RUN --points '{PLACES}' -o 'my lengths.json'"
    assert said.said(Terminal()) == f"lightdepth measure 'a run' --points '{PLACES}' -o 'my lengths.json'"


def test_a_name_like_an_option_stays_a_name_and_one_that_cannot_be_shown_is_not():
    assert command("view", Input("RUN", Path("-x"))).named == "lightdepth view ./-x"
    hidden = command("view", Input("RUN", Path("a\u200fb")))
    assert hidden.said(Terminal()) == "lightdepth view RUN"


def test_settings_that_are_as_usual_are_not_said():
    assert given(PairingConfig()) == {}
    assert given(PairingConfig(map_fps=25.0, trust_map=True)) == {"--map-fps": "25.0", "--trust-map": "true"}


def test_what_was_not_given_is_not_said():
    source = SequenceSource(Path("data"), "c3vd", light="gamma=2.2,mu=0", bit_depth=10)
    said = command("densify", Input("DATA", source.data), options={"--map": Input("MAP", None), **source.typed()})
    assert said.anonymous == "lightdepth densify DATA --format c3vd --light gamma=2.2,mu=0 --bit-depth 10"
    left = command("densify", options={**source.typed("--light", "--format")})
    assert left.named == "lightdepth densify --bit-depth 10"


@pytest.mark.parametrize(("stream", "name"), [(Terminal, "Doe"), (io.StringIO, "RUN")])
def test_only_a_terminal_is_told_the_names(stream, name, monkeypatch):
    out = stream()
    monkeypatch.setattr(sys, "stdout", out)
    end(then=command("view", Input("RUN", Path("Doe"))))
    assert out.getvalue().startswith(f"next: lightdepth view {name}\n")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("following") / "Doe, John: 1"
    frames = colon(0, 8).frames
    write_synthetic(frames, slam(frames), place)
    return place


def test_the_command_after_frames_were_chosen_runs_as_it_is_said(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert (
        main(["select", str(data), "--map", str(data / "slam"), "--no-frames", "-o", str(tmp_path / "list.txt")]) == 0
    )
    then = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("next: "))
    words = shlex.split(then.removeprefix("next: "))
    monkeypatch.chdir(tmp_path)
    assert main([*words[1:], "--dry-run"]) == 0


@pytest.mark.parametrize("camera", [[], ["--camera", "auto"]])
def test_a_board_without_a_camera_is_told_what_a_board_needs(camera, tmp_path, capsys):
    (tmp_path / "board").mkdir()
    cv2.imwrite(str(tmp_path / "board" / "000000.png"), np.full((60, 80, 3), 128, np.uint8))
    words = ["calibrate-light", str(tmp_path / "board"), *camera, "--position", "charuco", "--board.squares", "[9,7]"]
    words += ["--board.square-mm", "4", "--board.marker-mm", "3", "-o", str(tmp_path / "light.json")]
    assert main(words) == 3
    said = capsys.readouterr().err
    assert "convert-camera" in said and "calibrated camera alone" in said
    assert "give --camera auto" not in said and "--map" not in said
