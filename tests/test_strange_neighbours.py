"""What strangers put where a run keeps its own files: links, pipes, files of other programs, records that are none."""

from __future__ import annotations

import json
import os
import stat
from contextlib import suppress
from pathlib import Path

import pytest
from raising import refused
from videos import CAMERA

from lightdepth.calibration import write_camera
from lightdepth.cli import main
from lightdepth.errors import AlreadyFinished
from lightdepth.files.lock import is_live, lock_path
from lightdepth.files.replacing import BEGUN, PARTS, RECORD, old_path, read_record, remains, unfinished_path
from lightdepth.reporting.run import run_folder


def make(output: Path, arguments=None, **given) -> None:
    with run_folder(output, "densify", arguments or {"seed": 3}, **given) as run:
        (run.folder / "result.txt").write_text("new")


def stop(output: Path) -> Path:
    """A run that was stopped after its first part; its hidden folder."""
    with pytest.raises(KeyboardInterrupt), run_folder(output, "densify", {"seed": 3}, resume=False) as run:
        (run.folder / "maps").mkdir()
        (run.folder / "maps" / "one.txt").write_text("one")
        run.finish_part("one")
        raise KeyboardInterrupt
    return unfinished_path(output)


def test_a_link_in_the_place_of_the_lock_is_not_written_through(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    lock_path(tmp_path / "out").symlink_to("thesis.txt")
    with refused("in the way", "not made by this program", cure="another -o"):
        make(tmp_path / "out")
    assert (tmp_path / "thesis.txt").read_text() == "mine" and lock_path(tmp_path / "out").is_symlink()


def test_a_folder_with_the_name_of_a_lock_is_named(tmp_path):
    lock_path(tmp_path / "out").mkdir()
    with refused(".out.lock", "in the way", cure="another -o"):
        make(tmp_path / "out")
    assert os.listdir(tmp_path) == [".out.lock"]


@pytest.mark.parametrize("text", ["mine", "[1]", '{"host": "here"}'])
def test_a_file_of_another_program_with_the_name_of_a_lock_is_left_alone(tmp_path, text):
    lock_path(tmp_path / "out").write_text(text)
    with refused("in the way", "not made by this program", cure="another -o"):
        make(tmp_path / "out")
    assert lock_path(tmp_path / "out").read_text() == text and not list(remains(tmp_path))


@pytest.mark.parametrize("text", ["", "\0" * 90])
def test_a_lock_that_a_power_cut_left_without_words_is_taken_over(tmp_path, text):
    lock_path(tmp_path / "out").write_text(text)
    make(tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]


@pytest.mark.parametrize("hidden", [old_path, unfinished_path])
@pytest.mark.parametrize("ours", [True, False])
def test_a_link_in_the_place_of_a_hidden_folder_costs_nothing_where_it_leads(tmp_path, hidden, ours):
    make(tmp_path / "elsewhere" / "precious")
    if not ours:
        (tmp_path / "elsewhere" / "precious" / RECORD).rename(tmp_path / "elsewhere" / "precious" / BEGUN)
    before = sorted((tmp_path / "elsewhere").rglob("*"))
    hidden(tmp_path / "out").symlink_to("elsewhere/precious")
    for given in ({}, {"overwrite": True}, {"resume": True}):
        with refused("in the way", "not made by this program"):
            make(tmp_path / "out", **given)
    assert sorted((tmp_path / "elsewhere").rglob("*")) == before and not list(remains(tmp_path))


@pytest.mark.parametrize("place", ["", "maps"])
def test_a_result_that_is_write_protected_is_not_overwritten(tmp_path, monkeypatch, place):
    with run_folder(tmp_path / "out", "densify", {"seed": 3}) as run:
        (run.folder / "maps").mkdir()
        (run.folder / "maps" / "one.txt").write_text("one")
    asked = os.access  # root may change whatever is protected
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path / "out" / place and asked(path, mode))
    with refused("protected", cure="another -o"):
        make(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "maps" / "one.txt").read_text() == "one" and os.listdir(tmp_path) == ["out"]


def test_an_old_result_that_cannot_be_removed_stands_in_nobody_s_way(tmp_path, monkeypatch):
    make(tmp_path / "out")
    protected, unlink = (tmp_path / "out" / "result.txt").stat().st_ino, Path.unlink

    def unlinked(path, missing_ok=False):
        if path.exists() and path.stat().st_ino == protected:
            raise PermissionError(13, "Permission denied", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", unlinked)
    for _ in range(2):
        make(tmp_path / "out", overwrite=True)
    assert sorted(os.listdir(tmp_path)) == ["out", "out.1"] and (tmp_path / "out.1" / "result.txt").is_file()


def test_an_input_is_found_in_an_output_under_another_name_of_the_same_folder(tmp_path, monkeypatch):
    make(tmp_path / "out")
    (tmp_path / "mounted").mkdir()
    (tmp_path / "mounted" / "camera.json").write_text("{}")
    real = Path.stat

    def stat_as_mounted(path, **given):
        return real(tmp_path / "out" if path == tmp_path / "mounted" else path, **given)

    monkeypatch.setattr(Path, "stat", stat_as_mounted)
    for inside in ("mounted", "mounted/camera.json"):
        with refused("is read from it"):
            make(tmp_path / "out", {"data": str(tmp_path / inside)}, overwrite=True)


@pytest.mark.parametrize("change", [os.unlink, lambda path: path.write_text(""), lambda path: path.write_text("newer")])
def test_a_finished_run_that_lost_a_file_or_has_another_one_is_not_called_finished(tmp_path, change):
    make(tmp_path / "out")
    with pytest.raises(AlreadyFinished):
        make(tmp_path / "out", resume=True)
    change(tmp_path / "out" / "result.txt")
    with refused("result.txt of it", where="out", found="not resumed"):
        make(tmp_path / "out", resume=True)


def test_an_unfinished_run_with_a_link_in_it_is_begun_anew_and_nothing_is_written_where_it_leads(tmp_path):
    made = stop(tmp_path / "out")
    (made / "maps" / "one.txt").unlink()
    (made / "maps").rmdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "one.txt").write_text("one")
    (made / "maps").symlink_to(tmp_path / "elsewhere")
    with run_folder(tmp_path / "out", "densify", {"seed": 3}, resume=True) as run:
        assert not run.resumed and not (run.folder / "maps").exists()
    assert (tmp_path / "elsewhere" / "one.txt").read_text() == "one"


@pytest.mark.parametrize("line", ['{"name": "x", "files": [1]}', '{"name": "x", "files": {"a\\u0000": 1}}', "[]", "7"])
def test_a_line_that_tells_of_no_part_counts_as_not_written(tmp_path, line):
    made = stop(tmp_path / "out")
    with (made / PARTS).open("a") as file:
        file.write(line + "\n")
    with run_folder(tmp_path / "out", "densify", {"seed": 3}, resume=True) as run:
        assert list(run.parts or ()) == ["one"]


@pytest.mark.parametrize("damage", ["gone", "another letter", "torn in the middle"])
def test_what_was_finished_behind_a_damaged_line_is_made_again(tmp_path, damage):
    """It may go on from what that line said: a list of frames whose first part is gone would be of other frames."""
    with pytest.raises(KeyboardInterrupt), run_folder(tmp_path / "out", "densify", {}, resume=False) as run:
        for part in ("one", "two", "three"):
            run.finish_part(part, [], [part, 1.5, {"a b": 1e-17}])
        raise KeyboardInterrupt
    notes = unfinished_path(tmp_path / "out") / PARTS
    first, second, third = notes.read_text().splitlines(keepends=True)
    second = {"gone": "", "another letter": second.replace('"kept": ["two"', '"kept": ["twa"')}.get(damage, second[30:])
    notes.write_text(first + second + third)
    with suppress(KeyboardInterrupt), run_folder(tmp_path / "out", "densify", {}, resume=True) as run:
        assert list(run.parts or ()) == ["one"]
        run.finish_part("two", [])
        raise KeyboardInterrupt
    with run_folder(tmp_path / "out", "densify", {}, resume=True) as run:
        assert list(run.parts or ()) == ["one", "two"] and run.kept_of("one")[:2] == ["one", 1.5]


def test_a_file_that_is_a_link_to_nothing_is_refused_and_one_to_a_file_is_replaced(tmp_path, capsys):
    write_camera(CAMERA, tmp_path / "camera.json")
    (tmp_path / "loose.json").symlink_to("gone/camera.json")
    (tmp_path / "link.json").symlink_to("precious.json")
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "precious.json").write_text("mine")

    def converted(name: str, given: str = "camera.json") -> int:
        return main(["convert-camera", str(tmp_path / given), "-o", str(tmp_path / name), "--overwrite"])

    assert converted("loose.json") == 3 and "link to nothing" in capsys.readouterr().err
    assert converted("link.json") == 0 and not (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "precious.json").read_text() == "mine" and not (tmp_path / "gone").exists()
    assert converted("circle") == 3 and converted("circle/a.json") == 3 and converted("new.json", "circle") == 3


def test_a_run_that_another_version_began_is_not_gone_on_with(tmp_path):
    begun = stop(tmp_path / "out") / BEGUN
    begun.write_text(json.dumps(json.loads(begun.read_text()) | {"version": "0.0.1"}))
    with refused("begun by version 0.0.1", cure="--overwrite"):
        make(tmp_path / "out", resume=True)
    make(tmp_path / "out", overwrite=True)


@pytest.mark.parametrize("name", ["a\0b", "\ud800", "x" * 5000, "/etc/passwd", "."])
def test_a_list_of_files_with_what_is_no_name_of_a_file_is_read_without_harm(tmp_path, name):
    make(tmp_path / "out")
    record = json.loads((tmp_path / "out" / RECORD).read_text())
    record["files"][name] = 4096
    (tmp_path / "out" / RECORD).write_text(json.dumps(record))
    make(tmp_path / "out", overwrite=True)


@pytest.mark.parametrize("change", [{"arguments": [1]}, {"inputs": [2]}, {"inputs": {"data": 3}}, {"versions": 1}])
def test_a_run_json_of_other_kinds_than_ours_is_none(tmp_path, change):
    make(tmp_path / "out")
    record = json.loads((tmp_path / "out" / RECORD).read_text())
    (tmp_path / "out" / RECORD).write_text(json.dumps(record | change))
    assert read_record(tmp_path / "out") is None
    for given in ({"resume": True}, {"overwrite": True}):
        with refused(cure="choose another -o"):
            make(tmp_path / "out", **given)


def test_pipes_with_our_names_are_not_waited_for(tmp_path):
    made = stop(tmp_path / "out")
    (made / BEGUN).unlink()
    os.mkfifo(made / BEGUN)
    os.mkfifo(made / RECORD)
    os.mkfifo(lock_path(tmp_path / "other"))
    assert not is_live(tmp_path / "other") and not list(remains(tmp_path))
    with refused("in the way"):
        make(tmp_path / "out", resume=True)


def test_an_input_that_gives_without_end_or_never_is_not_read_to_its_end(tmp_path):
    os.mkfifo(tmp_path / "camera.json")
    for path, kind in ((Path("/dev/zero"), "a device"), (tmp_path / "camera.json", "a named pipe")):
        with refused(kind, "not a file"), run_folder(tmp_path / "out", "densify", {}) as run:
            run.hash_inputs(mask=path)


@pytest.mark.parametrize("umask", [0o077, 0o027, 0o002])
def test_who_may_read_a_result_is_as_the_umask_and_the_folder_s_group_say(tmp_path, umask):
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o2775)
    before = os.umask(umask)
    try:
        make(tmp_path / "shared" / "out")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "shared" / "out").stat().st_mode) == 0o2777 & ~umask
