"""Work in small that `make soak` does for hours: what it leaves in the process."""

from __future__ import annotations

import sys

import pytest
from soak import last_three_quarters, soaked

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what a process holds is read from /proc")


@pytest.mark.slow
def test_a_process_holds_after_live_and_a_dozen_sequences_with_failures_what_it_held_before():
    rows, wrong = soaked(keyframes=60, sequences=12, every=4, samples=6, noise_kb=4096, objects=30)
    assert wrong == []
    assert [str(row) for row in rows if not row.flat] == []


def test_what_grows_steadily_is_found_and_one_jump_at_the_beginning_is_not():
    at = list(range(0, 100, 10))
    assert not last_three_quarters("leak", at, [5.0 + 0.1 * n for n in at], 3.0).flat
    assert last_three_quarters("start", at, [0.0, 0.0] + [9.0] * 8, 3.0).flat
