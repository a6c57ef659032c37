"""Forty small sequences: two shares, one of them killed and resumed, make the table of one run that nothing stopped.

And how much faster two jobs are than one. Run by `make bench`; where no two cores are free the second says nothing.
"""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest
from sequences import QUICK, called, killed_after, made_sequences, stamps, table

COUNT = int(os.environ.get("SEQUENCES", 40))
AT_LEAST = 1.8
"""Times as fast as one job, on two free cores."""
COARSE = (*QUICK, "--fusion.voxels-per-distance", "25")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("batch") / "data"
    made_sequences(folder, COUNT)
    return folder


@pytest.fixture(scope="module")
def timed(data, tmp_path_factory) -> dict[int, tuple[Path, float, float]]:
    """By the number of jobs: the output, seconds, and seconds of processors."""
    found = {}
    for jobs in (1, 2):
        output, before = tmp_path_factory.mktemp("jobs") / "out", _used()
        code, seconds = called(data, output, "--jobs", jobs, quick=COARSE)
        assert code == 0
        found[jobs] = output, seconds, _used() - before
        print(f"\n{jobs} jobs, {COUNT} sequences: {seconds:.1f} s, {found[jobs][2]:.1f} s of processors", flush=True)
    return found


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_two_shares_one_killed_and_resumed_make_the_table_of_one_run(data, timed, tmp_path):
    output = tmp_path / "out"
    there = killed_after(COUNT // 5, data, output, "--shard", "1/2", "--jobs", "2", quick=COARSE)
    kept = stamps(output)
    assert called(data, output, "--shard", "2/2", "--jobs", "2", quick=COARSE)[0] == 0
    assert called(data, output, "--shard", "1/2", "--jobs", "2", quick=COARSE)[0] == 0
    print(f"\nkilled with {there} runs finished, {len(stamps(output))} at the end", flush=True)
    assert {name: stamps(output)[name] for name in kept} == kept
    assert table(output) == table(timed[1][0]) == table(timed[2][0])


def test_two_jobs_are_almost_twice_as_fast_as_one(timed):
    ratio = timed[1][1] / timed[2][1]
    print(f"\n2 jobs are {ratio:.2f} times as fast as 1", flush=True)
    assert ratio >= AT_LEAST
