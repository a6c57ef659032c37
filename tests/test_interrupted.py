"""A signal just before or after whatever changes the names of files leaves an output as it was, or as it is to be."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

import pytest

from lightdepth.errors import AlreadyFinished, InputError, Interrupted
from lightdepth.files.replacing import check_files, discard, old_path, unfinished_path
from lightdepth.files.writing import write_together
from lightdepth.reporting import run as reporting
from lightdepth.reporting.run import run_folder
from lightdepth.reporting.unfinished import Part, add_part, clean, finished_parts
from lightdepth.signals import ending_on_signals

CHANGING = ("rename", "replace", "unlink", "rmdir", "mkdir")


@contextmanager
def signalled(monkeypatch, at: int) -> Iterator[list[int]]:
    """Within it a SIGTERM comes before the call `at // 2` that changes a name where `at` is even, else after it. What
    is yielded has a number for each call."""
    calls: list[int] = []

    def heard(real: Callable) -> Callable:
        def call(*given, **named):
            number = 2 * len(calls)
            calls.append(number)
            if number == at:
                signal.raise_signal(signal.SIGTERM)
            try:
                return real(*given, **named)
            finally:
                if number + 1 == at:
                    signal.raise_signal(signal.SIGTERM)

        return call

    with monkeypatch.context() as patched, ending_on_signals():
        for name in CHANGING:
            patched.setattr(os, name, heard(getattr(os, name)))
        yield calls


def at_each(monkeypatch, work: Callable[[], None], judged: Callable[[bool], None]) -> int:
    """Does the work anew with a signal before and after each of its calls, and has it judged whether it was stopped."""
    at = 0
    while True:
        stopped = False
        try:
            with signalled(monkeypatch, at) as calls:
                work()
        except Interrupted:
            stopped = True
        judged(stopped)
        if at >= 2 * len(calls):
            return at
        at += 1


def make(output: Path, text: str, overwrite: bool = False, resume: bool | None = None) -> None:
    with run_folder(output, "densify", {"seed": 3}, overwrite, resume) as run:
        (run.folder / "in").mkdir(exist_ok=True)
        (run.folder / "in" / "result.txt").write_text(text, encoding="utf-8")
        run.finish_part("first")


def text_of(output: Path) -> str:
    return (output / "in" / "result.txt").read_text(encoding="utf-8") if (output / "run.json").is_file() else ""


@pytest.mark.parametrize("resume", [None, False])
def test_a_signal_anywhere_in_a_run_leaves_nothing_or_a_whole_result_or_finished_parts(tmp_path, monkeypatch, resume):
    root = tmp_path / "made"
    out = root / "deep" / "out"

    def judged(stopped: bool) -> None:
        kept = unfinished_path(out)
        if resume is False and kept.is_dir():
            assert stopped and (kept / "parts.jsonl").is_file() and not out.exists()
            make(out, "new", resume=True)
        assert text_of(out) == "new" if root.exists() else stopped
        assert not root.exists() or [path.name for path in out.parent.iterdir()] == ["out"]
        discard(root)

    assert at_each(monkeypatch, lambda: make(out, "new", resume=resume), judged) > 20


def test_a_signal_anywhere_in_a_run_that_overwrites_leaves_the_old_result_or_the_new_one_in_its_place(
    tmp_path, monkeypatch
):
    out = tmp_path / "out"
    make(out, "old")

    def judged(stopped: bool) -> None:
        assert text_of(out) in (("old", "new") if stopped else ("new",))
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
        discard(out)
        make(out, "old")

    assert at_each(monkeypatch, lambda: make(out, "new", overwrite=True), judged) > 20


def test_a_signal_anywhere_leaves_files_that_belong_together_all_old_or_all_new(tmp_path, monkeypatch):
    paths = [tmp_path / "deep" / "er" / name for name in "ab"]

    def work() -> None:
        check_files(paths, overwrite=True)
        write_together(dict.fromkeys(paths, "new"))

    def judged(stopped: bool, older: bool) -> None:
        assert {path.read_text(encoding="utf-8") for path in paths if path.exists()} in ({"old"}, {"new"}, set())
        assert [*tmp_path.rglob("*")] == [] or sorted(p.name for p in paths[0].parent.iterdir()) == ["a", "b"]
        if older:
            write_together(dict.fromkeys(paths, "old"))
        else:
            discard(tmp_path / "deep")

    assert at_each(monkeypatch, work, lambda stopped: judged(stopped, False)) > 6
    write_together(dict.fromkeys(paths, "old"))
    assert at_each(monkeypatch, work, lambda stopped: judged(stopped, True)) > 6


def test_an_interrupt_while_something_wrong_is_cleaned_up_after_leaves_nothing_either(tmp_path, monkeypatch):
    root = tmp_path / "made"

    def work() -> None:
        with suppress(InputError), run_folder(root / "out", "densify", {}) as run:
            (run.folder / "half").write_text("", encoding="utf-8")
            raise InputError("it", "wrong", "mend it")

    at_each(monkeypatch, work, lambda stopped: None if not root.exists() else pytest.fail(str([*root.rglob("*")])))


# ---- killed


def test_a_run_killed_before_it_could_say_whose_it_is_is_not_in_the_way(tmp_path):
    hidden = unfinished_path(tmp_path / "out")
    hidden.mkdir()
    (hidden / ".partial-01234567-4194305-begun.json").write_text("{", encoding="utf-8")
    make(tmp_path / "out", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["out"] and text_of(tmp_path / "out") == "new"


def test_an_old_result_of_which_folders_alone_are_left_is_not_in_the_way(tmp_path):
    make(tmp_path / "out", "old")
    (old_path(tmp_path / "out") / "in").mkdir(parents=True)
    make(tmp_path / "out", "new", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"] and text_of(tmp_path / "out") == "new"


def test_a_result_whose_removal_is_cut_off_never_looks_whole_and_stays_known_as_ours(tmp_path, monkeypatch):
    out, hidden = tmp_path / "out", unfinished_path(tmp_path / "out")
    for at in range(5):
        make(out, "whole")
        out.rename(hidden)
        count = iter(range(100))

        def cut_off(path, *given, at=at, count=count, real=os.unlink, **named):
            if next(count) == at:
                raise KeyboardInterrupt
            real(path, *given, **named)

        with monkeypatch.context() as patched, suppress(KeyboardInterrupt):
            patched.setattr(os, "unlink", cut_off)
            discard(hidden)
        make(out, "new")
        assert [path.name for path in tmp_path.iterdir()] == ["out"] and text_of(out) == "new"
        discard(out)


def test_what_overwrite_had_begun_is_gone_on_with_while_the_old_result_still_stands(tmp_path):
    out = tmp_path / "out"
    make(out, "old")
    with suppress(KeyboardInterrupt), run_folder(out, "densify", {"seed": 4}, overwrite=True, resume=False) as run:
        (run.folder / "part.txt").write_text("kept", encoding="utf-8")
        run.finish_part("first")
        raise KeyboardInterrupt
    assert text_of(out) == "old"
    with run_folder(out, "densify", {"seed": 4}, resume=True) as run:
        assert run.done("first")
    assert (out / "part.txt").read_text(encoding="utf-8") == "kept" and [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_run_stopped_or_killed_at_its_end_still_has_its_finished_parts(tmp_path, monkeypatch):
    out = tmp_path / "out"

    def work(resume: bool) -> bool:
        with run_folder(out, "densify", {}, resume=resume) as run:
            if again := run.done("first"):
                assert (run.state / "kept").is_file()
            else:
                run.state.mkdir()
                (run.state / "kept").write_text("", encoding="utf-8")
                run.finish_part("first", [run.state / "kept"])
        return again

    for step in ("sync_below", "write_run_json"):
        with monkeypatch.context() as patched, suppress(KeyboardInterrupt):
            patched.setattr(reporting, step, lambda *given: (_ for _ in ()).throw(KeyboardInterrupt))
            work(False)
        assert work(True)
        assert sorted(p.name for p in out.rglob("*")) == ["config.yaml", "log.txt", "run.json"]
        discard(out)
    with monkeypatch.context() as patched, suppress(KeyboardInterrupt):  # killed when it was whole already
        patched.setattr(reporting, "clear_notes", lambda *given: (_ for _ in ()).throw(KeyboardInterrupt))
        patched.setattr(reporting, "discard", lambda folder: None)
        patched.setattr(reporting, "kept_or_gone", lambda *given: nullcontext())
        work(False)
    assert (unfinished_path(out) / ".state").is_dir()
    with pytest.raises(AlreadyFinished):
        work(True)
    assert sorted(p.name for p in out.rglob("*")) == ["config.yaml", "run.json"]


def test_a_run_killed_while_it_is_taken_up_again_keeps_its_finished_parts(tmp_path, monkeypatch):
    for name in ("kept", "torn"):
        (tmp_path / name).write_text("", encoding="utf-8")
    add_part(tmp_path, Part("first", {"kept": 0}), [tmp_path / "kept"])

    def killed(*given, **named):
        raise KeyboardInterrupt

    for name in ("unlink", "replace"):
        with monkeypatch.context() as patched, suppress(KeyboardInterrupt):
            patched.setattr(os, name, killed)
            clean(tmp_path, finished_parts(tmp_path))
        assert list(finished_parts(tmp_path)) == ["first"]
