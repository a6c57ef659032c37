"""Work in small that `make soak` does for hours: what it leaves in the process."""

from __future__ import annotations

import sys

import pytest
from soak import soaked

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what a process holds is read from /proc")


def test_a_process_holds_after_live_and_a_dozen_sequences_with_failures_what_it_held_before():
    rows, wrong = soaked(keyframes=60, sequences=12, every=4, samples=6, noise_kb=4096, objects=30)
    assert wrong == []
    assert [str(row) for row in rows if not row.flat] == []
