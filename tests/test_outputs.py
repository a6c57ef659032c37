"""Outputs that nothing breaks: other runs, links, mounts, full disks, and --overwrite on what is not ours."""

from __future__ import annotations

import errno
import json
import os
import resource
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from raising import refused

from lightdepth.cli import main
from lightdepth.errors import AlreadyFinished, InputError, MachineFailure, PartialFailure
from lightdepth.files import replacing
from lightdepth.files.below import files_below, given, is_result
from lightdepth.files.lock import is_live, lock_path, locked
from lightdepth.files.replacing import check_rewritable, old_path, remains, unfinished_path
from lightdepth.files.writing import write_whole
from lightdepth.reporting.record import write_run_json
from lightdepth.reporting.run import input_hash, paths_in, run_folder

ROOT = Path(__file__).resolve().parents[1]


def make(output: Path, text: str = "new", verb: str = "densify", arguments=None, **given) -> None:
    with run_folder(output, verb, arguments or {"seed": 3}, **given) as run:
        (run.folder / "result.txt").write_text(text)


def text_of(output: Path) -> str:
    return (output / "result.txt").read_text()


def left_in(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def old_and_new(tmp_path: Path) -> tuple[Path, Path]:
    """An output, and another that is just like what a run has made, but with another text."""
    make(tmp_path / "out", "old")
    make(tmp_path / "other", "new")
    return tmp_path / "out", tmp_path / "other"


# ---- --overwrite


@pytest.mark.parametrize("inside", ["", "slam", "deep/camera.json"])
@pytest.mark.parametrize("shape", [lambda p: p, lambda p: [p], lambda p: {"b": (str(p),)}], ids=["one", "list", "deep"])
def test_an_output_that_is_an_input_or_holds_one_is_not_overwritten(tmp_path, inside, shape):
    make(tmp_path / "out", "old")
    read = tmp_path / "out" / inside
    if inside:
        read.parent.mkdir(exist_ok=True)
        read.write_text("precious")
    link = tmp_path / "link"
    link.symlink_to(read)
    for path in (read, link):
        with refused("is read from it", where="out"):
            make(tmp_path / "out", arguments={"map": shape(path)}, overwrite=True)
    with refused("is read from it"):
        make(tmp_path / "out", overwrite=True, inputs=[None, read])
    assert text_of(tmp_path / "out") == "old" and read.exists()


def test_only_what_the_same_verb_has_listed_is_overwritten(tmp_path):
    out = tmp_path / "out"
    make(out, "old")
    with refused("made by densify, not by predict"):
        make(out, verb="predict", overwrite=True)
    (out / "notes.txt").write_text("mine")
    with refused("notes.txt", "not of the run"):
        make(out, overwrite=True)
    (out / "notes.txt").unlink()
    (out / "away").symlink_to(tmp_path)
    with refused("away"):
        make(out, overwrite=True)
    (out / "away").unlink()
    (out / "result.txt").write_text("old, and changed by hand")
    with refused("result.txt"):
        make(out, overwrite=True)
    (out / "result.txt").write_text("odd")
    make(out, overwrite=True)
    assert text_of(out) == "new" and left_in(tmp_path) == ["out"]


def test_the_result_of_a_run_into_a_run_folder_goes_with_it(tmp_path):
    make(tmp_path / "out", "old")
    make(tmp_path / "out" / "evaluation", "errors", verb="evaluate")
    make(tmp_path / "out", overwrite=True)
    assert left_in(tmp_path / "out") == ["config.yaml", "result.txt", "run.json"]


def test_a_folder_of_a_version_that_listed_no_files_is_left_to_its_owner(tmp_path):
    make(tmp_path / "out", "old")
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    del record["files"]
    (tmp_path / "out" / "run.json").write_text(json.dumps(record))
    with refused("earlier version", cure="remove it yourself"):
        make(tmp_path / "out", overwrite=True)
    assert text_of(tmp_path / "out") == "old"


def test_a_list_of_files_that_a_stranger_wrote_deletes_nothing_elsewhere(tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "a.txt").write_text("mine")
    make(tmp_path / "out", "old")
    (tmp_path / "out" / "link").symlink_to(tmp_path / "precious")
    path = tmp_path / "out" / "run.json"
    record = json.loads(path.read_text())
    link = (tmp_path / "out" / "link").lstat().st_size
    more = {"../precious/a.txt": 4, str(tmp_path / "precious" / "a.txt"): 4, "link/a.txt": 4, "link": link}
    path.write_text(json.dumps(record | {"files": record["files"] | more}))
    make(tmp_path / "out", overwrite=True)
    assert text_of(tmp_path / "out") == "new" and (tmp_path / "precious" / "a.txt").read_text() == "mine"


def test_what_came_meanwhile_is_kept_and_so_is_the_work(tmp_path):
    make(tmp_path / "out", "old")
    with refused("changed by another program", cure="out.1"), run_folder(tmp_path / "out", "densify", {}, True) as run:
        (run.folder / "result.txt").write_text("new")
        (tmp_path / "out" / "late.txt").write_text("mine")
    assert (text_of(tmp_path / "out"), text_of(tmp_path / "out.1")) == ("old", "new")
    assert left_in(tmp_path) == ["out", "out.1"] and (tmp_path / "out" / "late.txt").exists()


def test_the_config_file_of_a_run_is_not_overwritten_by_it(tmp_path, capsys):
    make(tmp_path / "out", "old", verb="predict", arguments={"refine": 0})
    config = tmp_path / "out" / "config.yaml"
    assert main(["predict", str(tmp_path), "--config", str(config), "-o", str(tmp_path / "out"), "--overwrite"]) == 3
    assert "config.yaml is read from it" in capsys.readouterr().err and text_of(tmp_path / "out") == "old"


@pytest.mark.parametrize(
    "words",
    [
        ["predict", "D", "--checkpoint", "decline"],
        ["import", "D"],
        ["sparse", "D"],
        ["densify", "D", "--map", "D/slam", "--checkpoint", "decline"],
        ["densify", "data", "--map", "D", "--checkpoint", "decline"],
        ["live", "data", "--map", "data", "--checkpoint", "decline", "--mask", "D/mask.png"],
        ["export", "D", "--to", "png"],
        ["predict", "data", "--checkpoint", "D/result.txt"],
    ],
    ids=" ".join,
)
def test_no_verb_overwrites_what_it_is_given(words, tmp_path, monkeypatch, capsys):
    make(tmp_path / "D", "old", verb=words[0])
    (tmp_path / "data").mkdir()
    for name in ("slam", "mask.png", "1.npz"):
        (tmp_path / "D" / name).write_text("precious")
    monkeypatch.chdir(tmp_path)
    assert main([*words, "-o", "D", "--overwrite"]) == 3
    assert text_of(tmp_path / "D") == "old" and len(left_in(tmp_path / "D")) == 6
    assert left_in(tmp_path) == ["D", "data"], capsys.readouterr().err


# ---- killed between two steps


def test_a_run_that_was_killed_goes_on_in_another_process(tmp_path):
    program = """
import os, signal
from pathlib import Path
from lightdepth.reporting.run import run_folder
with run_folder(Path("out"), "predict", {"seed": 3}, resume=False) as run:
    for i in range(2):
        assert not run.done(str(i))
        (run.folder / f"{i}.txt").write_text(str(i))
        run.finish_part(str(i))
    (run.folder / "torn.txt").write_text("ha")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == -9 and left_in(tmp_path) == [".out.lock", ".out.unfinished"]
    assert [p.name for p in remains(tmp_path)] == [".out.lock", ".out.unfinished"] and not is_live(tmp_path / "out")
    with run_folder(tmp_path / "out", "predict", {"seed": 3}, resume=True) as run:
        assert run.resumed and run.done("0") and run.done("1") and not run.done("2")
    assert left_in(tmp_path) == ["out"] and "torn.txt" not in left_in(tmp_path / "out")


def test_the_old_result_comes_back_when_a_run_was_killed_before_the_new_one_was_in(tmp_path):
    out, _ = old_and_new(tmp_path)
    out.rename(old_path(out))
    unfinished_path(out).mkdir()
    for name in ("half.txt", "begun.json"):
        (unfinished_path(out) / name).write_text("")
    with refused("already there"):
        make(out)
    assert text_of(out) == "old"
    make(out, "newer", overwrite=True)
    assert text_of(out) == "newer" and left_in(tmp_path) == ["other", "out"]


def test_a_new_result_that_was_whole_takes_its_place_after_all(tmp_path, capsys):
    out, new = old_and_new(tmp_path)
    out.rename(old_path(out))
    new.rename(unfinished_path(out))
    with refused("already there"):
        make(out)
    assert text_of(out) == "new" and left_in(tmp_path) == ["out"]
    assert "killed at its last step" in capsys.readouterr().out


def test_an_old_result_whose_removal_was_cut_off_goes_but_not_what_is_not_its_own(tmp_path):
    out, old = old_and_new(tmp_path)
    old.rename(old_path(out))
    with refused("already there"):
        make(out)
    assert left_in(tmp_path) == ["out"] and text_of(out) == "old"
    make(tmp_path / "other")
    (tmp_path / "other" / "mine.txt").write_text("")
    (tmp_path / "other").rename(old_path(out))
    with refused("already there"):
        make(out)
    assert left_in(tmp_path) == ["out", "out.1"] and left_in(tmp_path / "out.1") == ["mine.txt"]


@pytest.mark.parametrize("hidden", [old_path, unfinished_path])
def test_a_folder_of_another_program_with_a_name_like_ours_is_left_alone(tmp_path, hidden):
    (hidden(tmp_path / "out")).mkdir()
    (hidden(tmp_path / "out") / "mine.txt").write_text("")
    with refused("not made by this program", cure="another -o"):
        make(tmp_path / "out")
    assert left_in(hidden(tmp_path / "out")) == ["mine.txt"] and not list(remains(tmp_path))


@pytest.mark.parametrize("step", range(6))
def test_whatever_rename_fails_old_or_new_is_whole_under_its_name_at_the_next_run(tmp_path, monkeypatch, step):
    class Killed(BaseException):
        pass

    out, count, real = tmp_path / "out", iter(range(100)), os.rename
    make(out, "old")

    def rename(a, b):
        if next(count) == step:
            raise Killed
        real(a, b)

    with monkeypatch.context() as patched, suppress(Killed):
        patched.setattr(os, "rename", rename)
        patched.setattr(replacing, "discard", lambda folder: None)  # nobody cleans up after a killed process
        make(out, overwrite=True)
    with suppress(InputError):
        make(out, "never", arguments={"other": 1})
    assert text_of(out) in ("old", "new") and (out / "run.json").exists()
    make(out, "newest", overwrite=True)
    assert text_of(out) == "newest" and left_in(tmp_path) == ["out"]


# ---- places that take no folder


def test_places_that_cannot_take_a_folder_are_refused_before_any_work(tmp_path, monkeypatch):
    work = []

    def begun(output: Path) -> None:
        with run_folder(output, "densify", {}):
            work.append(output)

    with refused("300 bytes"):
        begun(tmp_path / ("x" * 300))
    with refused("link to nothing"):
        (tmp_path / "loose").symlink_to(tmp_path / "gone")
        begun(tmp_path / "loose")
    with refused("cannot be made"):
        (tmp_path / "circle").symlink_to(tmp_path / "circle")
        begun(tmp_path / "circle" / "out")
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path / "mine")
    for here in (Path("."), Path(".."), tmp_path / "mine"):
        with refused("the folder that you are in"):
            begun(here)
    (tmp_path / "mount").mkdir()

    def busy(a, b):
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(a))

    monkeypatch.setattr(os, "rename", busy)
    with refused("a disk is mounted", cure="mount/run"):
        begun(tmp_path / "mount")
    assert not work and left_in(tmp_path) == ["circle", "loose", "mine", "mount"]


def test_folders_that_were_made_for_an_output_go_with_it(tmp_path):
    with pytest.raises(InputError), run_folder(tmp_path / "a" / "b" / "out", "densify", {}):
        raise InputError("a", "0", "give 1")
    assert left_in(tmp_path) == []


def test_a_link_to_a_folder_goes_on_leading_to_it(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk" / "out")
    (tmp_path / "disk" / "out").mkdir()
    make(tmp_path / "out")
    make(tmp_path / "out", "newer", overwrite=True)
    assert (tmp_path / "out").is_symlink() and text_of(tmp_path / "disk" / "out") == "newer"
    assert left_in(tmp_path / "disk") == ["out"]


# ---- one run at a time


def test_a_second_run_into_an_output_is_refused_with_the_name_of_the_first(tmp_path):
    with run_folder(tmp_path / "out", "densify", {}) as run:
        assert is_live(tmp_path / "out") and not list(remains(tmp_path))
        for overwrite in (False, True):
            with refused(socket.gethostname(), f"process {os.getpid()}", where="out"):
                make(tmp_path / "out", overwrite=overwrite)
        (run.folder / "result.txt").write_text("first")
    assert text_of(tmp_path / "out") == "first" and left_in(tmp_path) == ["out"]


def test_the_lock_of_a_dead_process_is_taken_over_and_that_of_another_machine_is_told(tmp_path):
    dead = {"host": socket.gethostname(), "boot": "", "pid": 2**22 + 1, "time": "2026-01-01 00:00:00"}
    lock_path(tmp_path / "out").write_text(json.dumps(dead))
    make(tmp_path / "out")
    lock_path(tmp_path / "out").write_text(json.dumps(dead | {"host": "node7"}))
    assert is_live(tmp_path / "out")
    with refused("host node7", "2026-01-01", cure=".out.lock"):
        make(tmp_path / "out", overwrite=True)
    lock_path(tmp_path / "out").write_text('{"host')  # cut off as it was written
    make(tmp_path / "out", "newer", overwrite=True)
    assert text_of(tmp_path / "out") == "newer" and left_in(tmp_path) == ["out"]


# ---- the machine fails


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE])
def test_a_disk_that_fails_is_told_in_a_sentence_and_the_old_result_stays(tmp_path, code):
    make(tmp_path / "out", "old")
    with pytest.raises(MachineFailure) as failed, run_folder(tmp_path / "out", "densify", {}, True) as run:
        raise OSError(code, os.strerror(code), str(run.folder / "a.txt"))
    assert "disk" in str(failed.value) or "server" in str(failed.value)
    assert "MB are free" in str(failed.value) and "out is as it was" in str(failed.value)
    assert ".unfinished" not in str(failed.value)
    assert text_of(tmp_path / "out") == "old" and left_in(tmp_path) == ["out"]


def test_a_folder_that_is_gone_and_memory_that_is_used_up_are_told_whatever_a_library_says(tmp_path, monkeypatch):
    with pytest.raises(MachineFailure, match="is gone"), run_folder(tmp_path / "out", "densify", {}) as run:
        run.folder.rename(tmp_path / "elsewhere")
        raise RuntimeError("PytorchStreamWriter failed writing file data/0")
    with monkeypatch.context() as full:
        full.setattr("shutil.disk_usage", lambda place: SimpleNamespace(free=4096))
        with pytest.raises(MachineFailure, match="disk is full"), run_folder(tmp_path / "out", "densify", {}):
            raise ValueError("cannot write")  # as a library says it
        with pytest.raises(InputError), run_folder(tmp_path / "out", "densify", {}):
            raise InputError("a", "0", "give 1")
    for error in (MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried ...")):
        with pytest.raises(MachineFailure, match="memory"), run_folder(tmp_path / "out", "densify", {}):
            raise error
    assert left_in(tmp_path) == ["elsewhere"]


def test_a_file_that_outgrows_what_is_allowed_ends_a_verb_with_5_and_leaves_nothing(tmp_path):
    program = """
from pathlib import Path
from lightdepth import cli
from lightdepth.reporting.run import run_folder
try:
    with run_folder(Path("out"), "predict", {}) as run:
        (run.folder / "a.bin").write_bytes(bytes(1 << 20))
except Exception as error:
    raise SystemExit(cli._failed("predict", error))
"""
    done = subprocess.run(
        [sys.executable, "-B", "-c", program],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16)),
        check=False,
    )
    assert done.returncode == 5, done.stderr
    assert "Traceback" not in done.stderr and "MB are free" in done.stderr and len(done.stderr.splitlines()) == 1
    assert "out is as it was" in done.stderr and left_in(tmp_path) == []


def test_an_error_of_the_system_with_a_file_is_a_sentence_in_every_verb(tmp_path, monkeypatch, capsys):
    def failing(code):
        def read(*given):
            raise OSError(code, os.strerror(code), str(tmp_path / "camera.json"))

        return read

    argv = ["convert-camera", str(tmp_path / "camera.json"), "-o", str(tmp_path / "made.json")]
    for code, expected in ((errno.EACCES, 3), (errno.EIO, 5), (errno.ENOSPC, 5)):
        monkeypatch.setattr("lightdepth.commands.convert_camera.read_camera", failing(code))
        assert main(argv) == expected
        said = capsys.readouterr().err
        assert said.startswith("lightdepth convert-camera: ") and "camera.json" in said and said.count("\n") == 1


# ---- a run that can be resumed


def work(output: Path, stop: BaseException | None = None, at: int = 2, **given) -> list[int]:
    """Four parts, each with a file and a warning; the numbers of those that were made now."""
    made = []
    with run_folder(output, "predict", {"seed": 3} | given.pop("arguments", {}), **given) as run:
        run.warn("at the start")
        (run.folder / "frames").mkdir(exist_ok=True)
        total = 0
        for i in range(4):
            if not run.done(f"part {i}"):
                if i == at and stop is not None:
                    (run.folder / "frames" / "torn.txt").write_text("ha")
                    raise stop
                (run.folder / "frames" / f"{i}.txt").write_text(str(i))
                run.warn(f"{i} is dark")
                if i == 1:
                    run.fail("1", "cut off")
                made.append(i)
                run.finish_part(f"part {i}", kept=i * i)
            total += run.kept_of(f"part {i}")
        (run.folder / "total.txt").write_text(str(total))
    return made


def end_files(output: Path) -> dict[str, str]:
    files = {str(p.relative_to(output)): p.read_text() for p in files_below(output) if p.name not in ("log.txt",)}
    record = json.loads(files.pop("run.json"))
    kept = {name: record[name] for name in ("verb", "arguments", "warnings", "failures")}
    names = sorted(name for name in record["files"])
    return files | {"record": json.dumps(kept), "names": str(names)}


@pytest.mark.parametrize(
    "stop", [KeyboardInterrupt(), OSError(errno.ENOSPC, "full"), MemoryError(), RuntimeError("bug")], ids=repr
)
def test_a_run_that_was_stopped_and_resumed_ends_with_the_files_of_one_that_was_not(tmp_path, stop, capsys):
    with suppress(PartialFailure):
        work(tmp_path / "whole", resume=False)
    with pytest.raises(BaseException) as stopped:
        work(tmp_path / "out", stop, resume=False)
    said = " ".join([str(stopped.value), *getattr(stopped.value, "__notes__", [])])
    assert "2 finished parts are kept: --resume goes on" in said
    with refused("unfinished run of predict", cure="--resume"):
        work(tmp_path / "out", resume=False)
    made = []
    with pytest.raises(PartialFailure, match="1 part"):
        made += work(tmp_path / "out", resume=True)
    assert "resumed: 2 finished" in capsys.readouterr().out
    assert end_files(tmp_path / "out") == end_files(tmp_path / "whole")
    log = (tmp_path / "out" / "log.txt").read_text()
    assert log.count("0 is dark") == log.count("3 is dark") == 1 and log.count("at the start") == 2
    assert left_in(tmp_path) == ["out", "whole"]


def test_a_part_whose_line_is_torn_or_whose_file_is_gone_is_made_again(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path / "out", KeyboardInterrupt(), at=3, resume=False)
    hidden = unfinished_path(tmp_path / "out")
    (hidden / "frames" / "0.txt").unlink()
    lines = (hidden / "parts.jsonl").read_text()
    (hidden / "parts.jsonl").write_text(lines[:-9])
    with suppress(PartialFailure):
        assert work(tmp_path / "out", resume=True) == [0, 2, 3]
    assert (tmp_path / "out" / "total.txt").read_text() == "14"


def test_a_run_is_resumed_only_as_it_was_begun(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.txt").write_text("1")

    def begun(seed=3, stop=True, **given):
        with run_folder(tmp_path / "out", "predict", {"data": tmp_path / "data", "seed": seed}, **given) as run:
            run.hash_inputs(data=tmp_path / "data")
            if not run.done("a"):
                (run.folder / "a.txt").write_text("")
                run.finish_part("a")
            if stop:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begun(resume=False)
    with refused("--seed", "3", "4"):
        begun(seed=4, resume=True)
    (tmp_path / "data" / "a.txt").write_text("2")
    with refused("data has changed"):
        begun(resume=True)
    with refused("unfinished run of predict"):
        make(tmp_path / "out")
    (tmp_path / "data" / "a.txt").write_text("1")
    begun(stop=False, resume=True)
    with pytest.raises(AlreadyFinished):
        begun(resume=True)
    with refused("--seed"):
        begun(seed=4, resume=True)
    with refused("they contradict each other"):
        begun(resume=True, overwrite=True)
    assert left_in(tmp_path) == ["data", "out"]


def test_to_resume_where_nothing_is_begins_anew_and_bad_input_keeps_nothing(tmp_path, capsys):
    with pytest.raises(InputError):
        work(tmp_path / "out", InputError("a", "0", "give 1"), resume=True)
    assert "starting anew" in capsys.readouterr().out and left_in(tmp_path) == []
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path / "out", KeyboardInterrupt(), at=0, resume=True)  # no part is finished yet
    assert left_in(tmp_path) == []
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path / "out", KeyboardInterrupt(), resume=False)
    with suppress(PartialFailure):
        assert work(tmp_path / "out", overwrite=True, resume=False) == [0, 1, 2, 3]
    assert left_in(tmp_path) == ["out"]


def test_a_finished_run_is_resumed_by_a_line_and_exit_code_0(tmp_path, monkeypatch, capsys):
    def finished(**options):
        raise AlreadyFinished("out is already finished")

    monkeypatch.setattr("lightdepth.commands.convert_camera.read_camera", lambda *_: finished())
    assert main(["convert-camera", "a.json", "-o", str(tmp_path / "b.json")]) == 0
    assert "already finished" in capsys.readouterr().out


# ---- outputs inside inputs


def test_results_that_lie_in_an_input_are_no_part_of_it(tmp_path):
    (tmp_path / "a.txt").write_text("1")
    before = input_hash(tmp_path)
    make(tmp_path / "out", verb="densify")
    make(tmp_path / "seq", verb="import")
    unfinished_path(tmp_path / "next").mkdir()
    (unfinished_path(tmp_path / "next") / "b.txt").write_text("")
    assert [is_result(p) for p in sorted(tmp_path.iterdir()) if p.is_dir()] == [True, True, False]
    names = [str(p.relative_to(tmp_path)) for p in files_below(tmp_path)]
    assert names == ["a.txt", "seq/config.yaml", "seq/result.txt", "seq/run.json"]
    assert input_hash(tmp_path, without=tmp_path / "seq") == before != input_hash(tmp_path)
    (tmp_path / "map").mkdir()
    maps = [tmp_path / "map" / "t.txt", tmp_path / "seq" / "t.txt"]
    assert given(maps, tmp_path) == maps[:1] and given(maps[1:], tmp_path) == maps[1:]


def test_every_path_among_arguments_is_found(tmp_path):
    class Plain:
        pass

    found = paths_in({"output": Path("o"), "a": Path("a"), "b": ["b", ("c", None, 3)], "d": {"e": {"f"}}, "g": Plain()})
    assert sorted(map(str, found)) == ["a", "b", "c", "f"] and paths_in(["", "a\0b"]) == []


# ---- single files


def test_what_a_killed_process_had_written_of_a_file_goes_with_the_next_one(tmp_path):
    write_whole(tmp_path / "a.txt", lambda path: [(tmp_path / "name").write_text(path.name), path.touch()])
    ours = (tmp_path / "name").read_text()
    dead = ours.replace(f"-{os.getpid()}-", f"-{2**22 + 1}-")
    elsewhere = f".partial-00000000-{2**22 + 1}-a.txt"
    for name in (dead, elsewhere, ours.replace("a.txt", "b.txt")):
        (tmp_path / name).write_text("half")
    assert [p.name for p in remains(tmp_path)] == [dead]
    write_whole(tmp_path / "a.txt", "new")
    assert left_in(tmp_path) == sorted([elsewhere, ours.replace("a.txt", "b.txt"), "a.txt", "name"])
    write_whole(tmp_path / ("ä" * 120 + ".txt"), "long")
    assert (tmp_path / ("ä" * 120 + ".txt")).read_text() == "long"


def test_verbs_of_single_files_do_not_write_over_what_they_read_or_did_not_make(tmp_path, capsys):
    camera = {"model": "PINHOLE", "width": 64, "height": 48, "params": [40, 40, 32, 24]}
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(camera))
    assert main(["convert-camera", str(path), "-o", str(path), "--overwrite"]) == 3
    assert "is read from it" in capsys.readouterr().err and json.loads(path.read_text()) == camera
    with refused("not made by this verb"):
        check_rewritable(path, '{"length"')
    check_rewritable(path, '{"model"')
    with refused("is a folder"):
        check_rewritable(tmp_path, "#")


def test_run_json_lists_the_files_of_the_run_with_their_sizes(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.txt").write_text("12345")
    write_run_json(tmp_path, "x", {}, 0.0, {})
    assert json.loads((tmp_path / "run.json").read_text())["files"] == {"in/a.txt": 5}
    with locked(tmp_path / "other"):
        pass
    assert left_in(tmp_path) == ["in", "run.json"]
