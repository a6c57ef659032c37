"""Compiled loops work wherever the package is installed."""

from __future__ import annotations

import os
from pathlib import Path

import numba
import numpy as np
import pytest
from raising import warned

from lightdepth import compiled as module
from lightdepth.compiled import cache_folder, compiled, open_to_others


def twice(values):
    out = np.empty_like(values)
    for i in range(len(values)):
        out[i] = 2 * values[i]
    return out


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="Numba is off, to count lines")
def test_machine_code_is_kept_where_the_user_wants_it(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    assert compiled(twice)(np.arange(3)).tolist() == [0, 2, 4]
    assert [p.suffix for p in sorted(tmp_path.rglob("*twice*"))] == [".nbc", ".nbi"]


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="Numba is off, to count lines")
def test_a_loop_is_told_of_while_it_is_compiled_and_not_while_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    told: list[bool] = []
    monkeypatch.setattr(module, "compiles", lambda loop, begins: told.append(begins))
    compiled(twice)(np.arange(3))
    assert told == [True, False]
    told.clear()
    compiled(twice)(np.arange(3))
    assert told == [False]


def test_where_nothing_can_be_written_each_process_makes_its_own(monkeypatch):
    monkeypatch.setattr(module._Place, "_locator_classes", [])  # none of the places can be written
    assert compiled(twice)(np.arange(3.0)).tolist() == [0, 2, 4]


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="Numba is off, to count lines")
@pytest.mark.parametrize("damage", ["index cut", "code cut", "code of a bit less", "index of others", "a folder"])
def test_damaged_machine_code_is_thrown_away_with_a_line_and_made_anew(damage, tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    compiled(twice)(np.arange(3))
    (index,), (code,) = tmp_path.rglob("*.nbi"), tmp_path.rglob("*.nbc")
    file = index if damage.startswith("index") else code
    content = file.read_bytes()
    changed = bytes([content[-40] ^ 1])
    made = {"index cut": content[:-20], "code cut": content[: len(content) // 2], "index of others": b"none"}
    if damage == "a folder":
        code.unlink()
        code.mkdir()
        assert compiled(twice)(np.arange(3)).tolist() == [0, 2, 4]
        return
    file.write_bytes(made.get(damage, content[:-40] + changed + content[-39:]))
    with warned("damaged"):
        assert compiled(twice)(np.arange(3)).tolist() == [0, 2, 4]
    again = compiled(twice)
    assert again(np.arange(3)).tolist() == [0, 2, 4] and sum(again.stats.cache_hits.values()) == 1


@pytest.mark.skipif(numba.config.DISABLE_JIT or os.name == "nt", reason="needs Numba and modes of files")
def test_the_users_own_folder_is_closed_to_others_and_one_that_is_not_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compiled(twice)(np.arange(3))
    assert cache_folder() == tmp_path / "lightdepth" / "compiled"
    assert cache_folder().stat().st_mode & 0o777 == 0o700 and len(list(tmp_path.rglob("*.nbc"))) == 1
    cache_folder().chmod(0o777)
    again = compiled(twice)
    assert open_to_others(cache_folder()) and again(np.arange(3)).tolist() == [0, 2, 4]
    assert not again.stats.cache_hits


@pytest.mark.skipif(os.name == "nt", reason="needs modes of files")
def test_a_folder_is_open_where_its_group_or_all_may_write_to_it_and_one_that_is_not_there_is_not(tmp_path):
    assert not open_to_others(tmp_path / "none")
    for mode, is_open in ((0o700, False), (0o755, False), (0o720, True), (0o702, True), (0o700, False)):
        tmp_path.chmod(mode)
        assert open_to_others(tmp_path) == is_open


def test_machine_code_lies_in_the_users_folder_and_is_stamped_by_the_content_of_its_file(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "loops.py"
    file.write_text("# one\n", encoding="utf-8")
    place = module._Own(twice, str(file))
    place.ensure_cache_path()
    assert cache_folder() in Path(place.get_cache_path()).parents and Path(place.get_cache_path()).is_dir()
    stamp = place.get_source_stamp()
    assert place.get_source_stamp() == stamp
    file.write_text("# another\n", encoding="utf-8")
    assert place.get_source_stamp() != stamp
