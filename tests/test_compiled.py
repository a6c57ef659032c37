"""Compiled loops work wherever the package is installed."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numba.core.caching import CacheImpl

from densify.fusion.compiled import compiled


def twice(values):
    out = np.empty_like(values)
    for i in range(len(values)):
        out[i] = 2 * values[i]
    return out


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="Numba is off, to count lines")
def test_machine_code_is_kept_beside_the_source_or_where_the_user_wants_it(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    assert compiled(twice)(np.arange(3)).tolist() == [0, 2, 4]
    assert [p.suffix for p in sorted(tmp_path.rglob("*twice*"))] == [".nbc", ".nbi"]


def test_where_nothing_can_be_written_each_process_makes_its_own(monkeypatch):
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])  # none of the places can be written
    assert compiled(twice)(np.arange(3.0)).tolist() == [0, 2, 4]
