"""The image of the Dockerfile, as far as it can be told without building it: what it needs is there, and the program
works where no network is."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest
from colons import colon

from lightdepth.checkpoint import DEFAULT_CHECKPOINT, bundled
from lightdepth.cli import main
from lightdepth.datasets import write_folder
from lightdepth.native import SYSTEM_LIBRARIES

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / "Dockerfile").read_text()


def test_the_image_has_the_system_libraries_that_are_needed():
    assert set(SYSTEM_LIBRARIES.values()) <= set(re.findall(r"lib[\w-]+", DOCKERFILE))


def test_all_that_the_image_copies_is_there_and_is_let_in():
    copied = [word for line in re.findall(r"^COPY (.+) \S+$", DOCKERFILE, re.MULTILINE) for word in line.split()]
    let_in = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert set(copied) == let_in and all((ROOT / name).exists() for name in copied)
    assert {"lightdepth", "densify", "train", "configs"} <= set(copied)  # lightdepth/configs is a link to configs


def test_the_image_asks_no_hub_and_the_weights_are_in_the_package():
    assert "HF_HUB_OFFLINE=1" in DOCKERFILE and DEFAULT_CHECKPOINT in bundled()


def test_the_program_predicts_where_no_network_is(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refused)
    monkeypatch.setattr(socket, "getaddrinfo", refused)
    write_folder(colon().frames[:1], tmp_path / "data")
    with pytest.raises(AssertionError):
        socket.create_connection(("example.org", 80))
    assert main(["predict", str(tmp_path / "data"), "-o", str(tmp_path / "out")]) == 0
