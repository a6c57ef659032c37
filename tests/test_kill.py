"""Verbs that are killed at events of the file system: four cases of each of three; all by `make kill`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the harness forks")


def test_what_a_killed_verb_leaves_is_old_or_whole_and_the_next_run_ends_as_one_that_nothing_stopped(tmp_path):
    program = Path(__file__).with_name("kill_matrix.py")
    # In a process of its own: this one has threads, and what is forked from it might hang.
    argv = [sys.executable, str(program), "--quick", "--seed", "1", "--into", str(tmp_path)]
    done = subprocess.run(
        argv, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(program.parents[1])}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    played = [json.loads(line) for line in (tmp_path / "1.jsonl").read_text(encoding="utf-8").splitlines()]
    assert len({row["case"] for row in played}) == 12 and {row["case"].split()[0] for row in played} == {
        "import",
        "convert-camera",
        "predict",
    }
