"""Run folders appear whole or not at all, and say how they were made."""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from raising import refused

from lightdepth.counting import full_stop
from lightdepth.errors import AlreadyFinished, InputError, PartialFailure
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.record import git_revision, versions, write_run_json
from lightdepth.reporting.run import input_hash, plain, run_folder


def make(output: Path, text: str = "new", **given) -> None:
    with run_folder(output, "densify", {"data": Path("seq"), "seed": 3}, **given) as run:
        (run.folder / "result.txt").write_text(text)


def beside(output: Path) -> list[str]:
    return sorted(p.name for p in output.parent.iterdir())


def test_run_json_says_what_was_run_on_what_with_which_versions(tmp_path):
    (tmp_path / "in.txt").write_text("input")
    with run_folder(tmp_path / "out", "densify", {"data": tmp_path / "in.txt", "share": np.float32(0.5)}) as run:
        run.hash_inputs(data=tmp_path / "in.txt")
        run.hash_inputs(mask=None)
        run.record["maps"] = [{"map": np.int64(1), "median": math.inf}]
        run.log("a line")
    digest = input_hash(tmp_path / "in.txt")
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["verb"] == "densify"
    assert record["arguments"] == {"data": f"data-{digest[:8]}", "share": 0.5}
    assert {"python", "numpy", "torch", "lightdepth"} <= set(record["versions"])
    assert record["inputs"] == {"data": {"path": f"data-{digest[:8]}", "sha256": digest}}
    assert record["maps"] == [{"map": 1, "median": None}] and record["failures"] == []
    assert 0 <= record["seconds"] < 60 and record["peak_memory_mb"] > 10
    assert record["started"].endswith("Z") and isinstance(record["command"], list) and "revision" in record
    assert yaml.safe_load((tmp_path / "out" / "config.yaml").read_text()) == record["arguments"]
    assert (tmp_path / "out" / "log.txt").read_text().endswith(" a line\n")


def test_a_run_appears_when_it_is_complete_and_not_before(tmp_path):
    output = tmp_path / "deep" / "out"
    with run_folder(output, "synth", {}) as run:
        assert not output.exists() and run.folder.is_dir()
        (run.folder / "a.txt").write_text("")
        assert not (run.folder / "run.json").exists()
    assert sorted(p.name for p in output.iterdir()) == ["a.txt", "config.yaml", "run.json"]
    assert beside(output) == ["out"]


@pytest.mark.parametrize("error", [ValueError("stop"), InputError("a", "0", "stop"), KeyboardInterrupt("stop")])
def test_a_run_that_fails_leaves_nothing(tmp_path, error):
    with pytest.raises(type(error)), run_folder(tmp_path / "out", "synth", {}) as run:
        (run.folder / "half.txt").write_text("")
        raise error
    assert beside(tmp_path / "out") == []


def test_a_run_that_fails_leaves_the_earlier_one_as_it_was(tmp_path):
    make(tmp_path / "out", "old")
    with pytest.raises(ValueError), run_folder(tmp_path / "out", "densify", {}, overwrite=True) as run:
        (run.folder / "result.txt").write_text("half")
        raise ValueError
    assert (tmp_path / "out" / "result.txt").read_text() == "old" and beside(tmp_path / "out") == ["out"]


def test_what_is_there_is_replaced_only_when_asked_and_only_when_we_made_it(tmp_path):
    make(tmp_path / "out", "old")
    with refused(where="out", found="already there and not empty", cure="choose another -o, or give --overwrite"):
        make(tmp_path / "out")
    assert (tmp_path / "out" / "result.txt").read_text() == "old"
    make(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "result.txt").read_text() == "new"

    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "mine.txt").write_text("precious")
    with refused(where="photos", found="not overwritten, it has no run.json"):
        make(tmp_path / "photos", overwrite=True)
    assert [p.name for p in (tmp_path / "photos").iterdir()] == ["mine.txt"]


def test_a_run_does_not_replace_what_it_reads(tmp_path):
    make(tmp_path / "out", "old")
    for what in (str(tmp_path / "out"), tmp_path / "out" / "result.txt"):
        given = {"what": what, "output": tmp_path / "out"}
        with refused(where="out", cure="choose another -o"), run_folder(tmp_path / "out", "export", given, True):
            pass
    assert (tmp_path / "out" / "result.txt").read_text() == "old"


def test_a_whole_run_that_was_killed_before_it_took_the_place_of_an_older_one_takes_it_by_resume(tmp_path, monkeypatch):
    output = tmp_path / "out"

    def make_of(size: int, **given) -> None:
        with run_folder(output, "densify", {"size": size}, **given) as run:
            (run.folder / "result.txt").write_text(f"{size}")

    make_of(1, resume=False)
    with monkeypatch.context() as killed:
        killed.setattr("lightdepth.reporting.run.replace", lambda *_: sys.exit("killed"))
        with pytest.raises(SystemExit):
            make_of(2, resume=False, overwrite=True)
    with refused(found="--size was 1 and is 3"):
        make_of(3, resume=True)
    assert (output / "result.txt").read_text() == "1" and beside(output) == [".out.unfinished", "out"]
    with pytest.raises(AlreadyFinished, match="killed at its last step"):
        make_of(2, resume=True)
    assert (output / "result.txt").read_text() == "2" and beside(output) == ["out"]


def test_an_empty_folder_is_filled_and_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").mkdir()
    make(tmp_path / "out")
    assert (tmp_path / "out" / "result.txt").is_file()
    (tmp_path / "file").write_text("mine")
    for overwrite in (False, True):
        with refused(where="file", found="is a file"):
            make(tmp_path / "file", overwrite=overwrite)
    with refused(found="cannot be made"):
        make(tmp_path / "file" / "below")
    assert (tmp_path / "file").read_text() == "mine"


def test_part_of_the_work_may_fail_and_the_rest_is_written(tmp_path):
    with (
        pytest.raises(PartialFailure, match=r"2 parts failed, the first: 7: truncated\. The rest is in .*out"),
        run_folder(tmp_path / "out", "predict", {}) as run,
    ):
        run.fail("7", "truncated")
        run.fail("9", "missing")
        (run.folder / "8.npz").write_text("")
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["failures"] == [{"what": "7", "reason": "truncated"}, {"what": "9", "reason": "missing"}]
    assert (tmp_path / "out" / "8.npz").is_file()


def test_a_reason_that_is_a_question_gets_no_full_stop(tmp_path):
    assert [full_stop(said) for said in ("dark", "whose?", "so.", "no!")] == ["dark.", "whose?", "so.", "no!"]
    with (
        pytest.raises(PartialFailure, match=r"in camera axes\? The rest is in .*out"),
        run_folder(tmp_path / "out", "predict", {}) as run,
    ):
        run.fail("7", "is it this endoscope's, in camera axes?")


def test_the_hash_changes_with_contents_names_and_sizes_and_with_nothing_else(tmp_path):
    def tree(name: str, files: dict[str, bytes]) -> str:
        for file, data in files.items():
            path = tmp_path / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        return input_hash(tmp_path / name)

    one = tree("one", {"a": b"1", "sub/b": b"2"})
    assert tree("same", {"sub/b": b"2", "a": b"1"}) == one
    assert len({one, tree("c", {"a": b"1", "sub/b": b"3"}), tree("d", {"a": b"1", "sub/x": b"2"})}) == 3
    big, other = (tree(n, {"x": bytes([v]) * (1 << 20) + b"tail"}) for n, v in (("big", 1), ("other", 2)))
    assert big == other  # of files over 1 MB only name and size count: reading videos would take minutes
    assert tree("longer", {"x": b"1" * ((1 << 20) + 5)}) != big


def test_the_hash_of_one_file_is_of_its_name_size_and_contents(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"hello")
    assert input_hash(tmp_path / "a.txt") == hashlib.sha256(b"a.txt\x005\x00hello").hexdigest()


@dataclass
class Part:
    path: Path
    numbers: tuple[float, ...]


def test_what_goes_to_json_is_plain():
    value = plain({1: Part(Path("x"), (1.0, math.nan, -math.inf)), "n": np.float64(2), "i": np.int32(3), "b": True})
    assert value == {"1": {"path": "x", "numbers": [1.0, None, None]}, "n": 2.0, "i": 3, "b": True}
    assert json.loads(json.dumps(value)) == value and value["b"] is True and isinstance(value["i"], int)
    assert plain([None, "text", np.bool_(False)]) == [None, "text", False]


def test_run_json_is_complete_or_absent(tmp_path):
    with pytest.raises(TypeError):
        write_run_json(tmp_path, "x", {}, 0.0, {"bad": object()})
    assert not (tmp_path / "run.json").exists()
    write_run_json(tmp_path, "x", {}, 0.0, {})
    assert [p.name for p in tmp_path.iterdir()] == ["run.json"]


def test_versions_and_revision_are_those_of_what_runs():
    assert versions()["numpy"] == np.__version__
    revision = git_revision()
    assert revision is None or len(revision.rstrip("+")) == 40


def test_progress_in_a_log_is_a_line_now_and_then_and_one_at_the_end(capsys):
    with Progress("Rendering", 5, interval=0.0) as bar:
        for _ in range(5):
            bar.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Rendering: 1/5"
    assert lines[-1].startswith("Rendering: 5 in ") and len(lines) == 6
    with Progress("Rendering", 5) as bar:
        bar.advance(5)
    assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(ValueError), Progress("Rendering", 5):
        raise ValueError
    assert capsys.readouterr().err == ""


def lines_of(seconds: list[float], monkeypatch, capsys) -> list[str]:
    """What is said of steps that take so many seconds."""
    clock = [0.0]
    monkeypatch.setattr("lightdepth.reporting.progress.time.monotonic", lambda: clock[0])
    with Progress("Densifying", len(seconds), interval=0.0) as bar:
        for taken in seconds:
            clock[0] += taken
            bar.advance()
    lines: list[str] = capsys.readouterr().err.splitlines()
    return lines


def test_a_slow_first_step_does_not_tell_how_long_the_others_take(monkeypatch, capsys):
    lines = lines_of([50.0, *[2.0] * 34], monkeypatch, capsys)
    assert lines[0] == "Densifying: 1/35" and lines[1] == "Densifying: 2/35"
    assert lines[2] == "Densifying: 3/35, 2 s each, about 64 s left"
    assert lines[20] == "Densifying: 21/35, 2 s each, about 28 s left"


def test_the_time_left_is_that_of_recent_steps_and_of_no_fraction_of_a_second(monkeypatch, capsys):
    lines = lines_of([*[0.01] * 20, *[5.0] * 20], monkeypatch, capsys)
    assert not any("left" in line for line in lines[:20])
    assert lines[35] == "Densifying: 36/40, 5 s each, about 20 s left"


def test_what_is_warned_of_during_a_run_is_shown_and_in_its_log_and_run_json(tmp_path):
    with (
        pytest.warns(UserWarning, match="principal point"),
        pytest.warns(FutureWarning, match="a library"),
        run_folder(tmp_path / "out", "predict", {}) as run,
    ):
        warnings.warn("seq: the principal point is far off", stacklevel=1)
        warnings.warn("a library's own business", FutureWarning, stacklevel=1)
        run.warn("most of it is black")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.warn("after the run", stacklevel=1)
    said = ["seq: the principal point is far off", "most of it is black"]
    assert json.loads((tmp_path / "out" / "run.json").read_text())["warnings"] == said
    log = (tmp_path / "out" / "log.txt").read_text()
    assert all(f" warning: {each}\n" in log for each in said) and "library" not in log


def test_a_clock_that_is_set_back_during_a_run_makes_it_no_shorter(tmp_path, monkeypatch):
    with run_folder(tmp_path / "out", "densify", {}):
        monkeypatch.setattr(time, "time", lambda: 1e9)
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert 0 <= record["seconds"] < 60 and record["started"].startswith("2001-09-09")
