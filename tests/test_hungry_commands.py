"""Inputs that announce more than there is memory for are refused as any others, within 1.5 GB."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from hungry_commands import ROWS, prepared

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory are Linux's")
MOST_MB = 1500


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory) -> dict[str, dict]:
    """What came of each command, by what was typed."""
    here = tmp_path_factory.mktemp("hungry") / "here"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        prepared(here)
    program = Path(__file__).with_name("hungry_commands.py")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(program.parents[1])}
    argv = [sys.executable, str(program), str(here), *map(str, range(len(ROWS)))]
    done = subprocess.run(argv, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return {one["typed"]: one for one in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize(
    "command",
    [pytest.param(c, id=c.typed, marks=[pytest.mark.xfail(strict=True, reason=c.fault)] * bool(c.fault)) for c in ROWS],
)
def test_what_announces_more_than_there_is_memory_for_is_refused_within_1500_mb(outcomes, command):
    one = outcomes[command.typed]
    assert "Traceback" not in one["said"], one["said"]
    assert one["code"] == command.code, one
    assert command.words in one["said"]
    assert one["mb"] <= MOST_MB and one["left"] == []


def test_there_are_thirty_of_them():
    assert len({c.typed for c in ROWS}) == len(ROWS) >= 30


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        prepared(Path(folder) / "here")
        program = Path(__file__).with_name("hungry_commands.py")
        subprocess.run([sys.executable, str(program), str(Path(folder) / "here"), *map(str, range(len(ROWS)))])
