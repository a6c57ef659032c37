"""batch with surfaces as they are: by processes and jobs, the same to the last bit as by densify itself."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import pytest
from same_results import differences
from sequences import QUICK, batch, called, killed_after, made_sequences, stamps, table

import densify.batch.work
from densify.batch.cluster import submitted
from lightdepth.cli import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are watched by /proc")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("real") / "data"
    made_sequences(folder, 4)
    return folder


@pytest.mark.slow
def test_two_processes_make_what_densify_makes_of_each_to_the_last_bit(data, tmp_path):
    assert batch(f"{data}/case_0[01]", tmp_path / "out", "--jobs", "2", "--formats", "[ply, obj]") == 0
    runs = {int(name["frames"]): tmp_path / "out" / "sequences" / name["sequence"] for name in table(tmp_path / "out")}
    assert set(runs) == {4, 5}
    words = [*QUICK[2:], "--map", str(data / "case_00" / "slam"), "--formats", "[ply, obj]"]
    assert main(["densify", str(data / "case_00"), *words, "-o", str(tmp_path / "alone")]) == 0
    for path in ("mesh.ply", "cloud.ply", "mesh.obj", "keyframes.csv"):
        assert (runs[4] / "map_000" / path).read_bytes() == (tmp_path / "alone" / "map_000" / path).read_bytes()


@pytest.mark.slow
def test_a_share_that_was_killed_and_resumed_ends_as_one_that_nothing_stopped(data, tmp_path):
    assert called(data, tmp_path / "whole", "--jobs", "2")[0] == 0
    before = killed_after(1, data, tmp_path / "out", "--shard", "1/2")
    kept = stamps(tmp_path / "out")
    assert 1 <= before < 4
    assert called(data, tmp_path / "out", "--shard", "2/2")[0] == 0
    assert called(data, tmp_path / "out", "--shard", "1/2")[0] == 0
    assert {name: stamps(tmp_path / "out")[name] for name in kept} == kept
    assert table(tmp_path / "out") == table(tmp_path / "whole")
    made, whole = tmp_path / "out" / "sequences", tmp_path / "whole" / "sequences"
    assert [line for name in kept for line in differences(made / name, whole / name)] == []


@pytest.mark.slow
def test_jobs_by_submitit_make_the_same(data, tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setattr(densify.batch.work, "check_cluster", lambda: None)
    monkeypatch.setattr(densify.batch.work, "submitted", partial(submitted, cluster="local"))
    assert batch(data, tmp_path / "jobs", "--jobs", "2", "--executor", "slurm") == 0
    assert batch(data, tmp_path / "here") == 0
    assert table(tmp_path / "jobs") == table(tmp_path / "here")
    assert not (tmp_path / "jobs" / ".jobs").exists()
