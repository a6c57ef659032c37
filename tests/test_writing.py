"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import sqlite3
import subprocess
import sys

import pytest

from lightdepth.errors import InputError
from lightdepth.files.machine import machine_failure
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


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("Error while serializing: I/O error: No space left on device (os error 28)"), "disk is full"),
        (sqlite3.OperationalError("database or disk is full"), "disk is full"),
        (sqlite3.OperationalError("disk I/O error"), "could not be read or written"),
        (ValueError("I/O error: No such file or directory (os error 2)"), None),
        (InputError("a.bin", "(os error 28)", "copy it again"), None),
    ],
)
def test_what_libraries_say_of_a_full_disk_in_words_is_a_failure_of_the_machine(tmp_path, error, said):
    found = machine_failure(error, tmp_path)
    assert found is None if said is None else said in str(found) and "MB are free" in str(found)


def test_a_full_disk_is_told_by_the_libraries_that_write_our_files_as_we_know_them_to_tell_it(tmp_path):
    """In a process that may write no more than 64 kB a file. Another version may say it in another way."""
    code = """
import resource, signal, sqlite3, sys
from pathlib import Path
import torch
from safetensors.torch import save_file
from lightdepth.files.machine import machine_failure
from lightdepth.files.writing import write_whole
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16))
place, many = Path(sys.argv[1]), {"a": torch.zeros(100_000)}
writers = [
    lambda: write_whole(place / "a.ckpt", lambda path: torch.save(many, path)),
    lambda: save_file(many, place / "b.safetensors"),
]
for write in writers:
    try:
        write()
    except Exception as error:
        assert "beyond the size" in str(machine_failure(error, place)), repr(error)
    else:
        raise AssertionError("written")
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, timeout=120)


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
