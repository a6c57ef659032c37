"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import errno
import os

import pytest

from lightdepth.errors import InputError
from lightdepth.files.writing import move_whole, write_together, write_whole


def test_text_bytes_and_what_a_function_writes_arrive_and_nothing_else(tmp_path):
    write_whole(tmp_path / "new" / "a.txt", "grün\n")
    write_whole(str(tmp_path / "b.bin"), b"\0\1")
    write_whole(tmp_path / "c.npy", lambda path: path.write_text(path.suffix))
    assert (tmp_path / "new" / "a.txt").read_text("utf-8") == "grün\n"
    assert (tmp_path / "b.bin").read_bytes() == b"\0\1" and (tmp_path / "c.npy").read_text() == ".npy"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.bin", "c.npy", "new"]


def test_what_was_there_stays_when_a_writer_fails_half_way(tmp_path):
    write_whole(tmp_path / "a", "old")

    def half(path):
        path.write_text("ne")
        raise RuntimeError("the power went")

    with pytest.raises(RuntimeError):
        write_together({tmp_path / "first": "new", tmp_path / "a": half})
    assert (tmp_path / "a").read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["a"]


def test_a_place_that_cannot_be_written_to_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError) as refused:
        write_whole(tmp_path / "file" / "below.txt", "x")
    assert str(tmp_path / "file") in str(refused.value)


def test_file_and_folder_are_on_the_disk_before_and_after_the_rename(tmp_path, monkeypatch):
    """The order that survives a power cut: the file's bytes, the rename, the folder's names."""
    order: list[str] = []
    real = os.fsync, os.replace, os.rename
    monkeypatch.setattr(os, "fsync", lambda d: (order.append(os.readlink(f"/proc/self/fd/{d}")), real[0](d)))
    monkeypatch.setattr(os, "replace", lambda a, b: (order.append("replace"), real[1](a, b)))
    monkeypatch.setattr(os, "rename", lambda a, b: (order.append("rename"), real[2](a, b)))
    write_whole(tmp_path / "a", "x")
    names = [os.path.basename(o) for o in order]
    assert names[0].startswith(".partial-") and names[0].endswith("-a") and names[1:] == ["replace", tmp_path.name]
    order.clear()
    (tmp_path / "made" / "in").mkdir(parents=True)
    (tmp_path / "made" / "in" / "f").write_text("x")
    move_whole(tmp_path / "made", tmp_path / "done")
    assert sorted(map(os.path.basename, order[:3])) == ["f", "in", "made"] and order[3:] == ["rename", str(tmp_path)]


def test_a_file_system_that_cannot_sync_folders_loses_nothing_and_a_full_one_is_said(tmp_path, monkeypatch):
    def failing(code):
        def fsync(descriptor):
            raise OSError(code, os.strerror(code))

        return fsync

    monkeypatch.setattr(os, "fsync", failing(errno.EINVAL))
    write_whole(tmp_path / "a", "x")
    assert (tmp_path / "a").read_text() == "x"
    monkeypatch.setattr(os, "fsync", failing(errno.ENOSPC))
    with pytest.raises(OSError, match="No space left"):  # the machine's failure, not the user's
        write_whole(tmp_path / "a", "y")
    assert (tmp_path / "a").read_text() == "x"
