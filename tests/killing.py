"""Verbs that are killed at an event of the file system, and what has to hold afterwards.

A verb runs in a forked child whose audit hook counts what it does to files below its own folder: opening to write,
renaming, removing, making and removing folders. At a drawn event the child sends itself a signal, just before the event
happens; so a kill at a rename leaves what was there before it, and one at the event after it what the rename made. That
a file was opened is an event of its own, behind it: the file is there then and nothing is in it yet.
Times would not do: a run spends most of its own in the import of libraries.
"""

from __future__ import annotations

import builtins
import contextlib
import hashlib
import io
import json
import os
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from same_results import difference, files

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGING = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.symlink", "os.chmod")
LONGEST_S = 600
"""A child that takes longer than this many seconds hangs."""


@dataclass(frozen=True)
class Event:
    """What a run did to a file, or was about to do: the kind, and the paths below the run's folder."""

    kind: str
    paths: tuple[str, ...]

    def places(self, output: str) -> bool:
        """Whether it is a rename of something that lies beside the output, or of the output itself."""
        return self.kind == "os.rename" and any("/" not in path or path == output for path in self.paths)


@dataclass(frozen=True)
class Verb:
    """A command line, run in a folder of its own that holds a copy of the inputs."""

    name: str
    argv: tuple[str, ...]
    """With -o and the output, relative to the folder; without --overwrite and --resume."""
    output: str
    """A folder that the verb makes as a whole, or the folder that its files are written to."""
    older: tuple[str, ...] = ()
    """Options that make another result, which a run with --overwrite finds."""
    overwrites: bool = True
    again: tuple[str, ...] = ("--overwrite",)
    """Options with which a run replaces an older result."""
    resumes: bool = False
    in_place: bool = False
    """Whether the work is done in the output itself, which is complete when run.json is there."""


@dataclass(frozen=True)
class Ended:
    """How a child ended: its exit code, or minus the signal that killed it, and the last it said."""

    code: int
    said: str


def run(
    argv: list[str], folder: Path, at: int | None = None, number: int = signal.SIGKILL
) -> tuple[Ended, list[Event]]:
    """Runs a verb in `folder` in a forked child, which gets signal `number` at event `at`; the events up to its end."""
    notes, log = folder.with_name(folder.name + ".events"), folder.with_name(folder.name + ".log")
    notes.write_text("", encoding="utf-8")
    child = os.fork()
    if child == 0:
        _be_the_verb(argv, folder, notes, log, at, number)
    status = _waited(child)
    code = os.waitstatus_to_exitcode(status)
    events = []
    for line in notes.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
        with contextlib.suppress(ValueError):  # the last line of a child that was killed may be cut off
            kind, *paths = json.loads(line)
            events.append(Event(kind, tuple(paths)))
    said = log.read_text(encoding="utf-8", errors="replace")[-2000:]
    notes.unlink()
    log.unlink()
    return Ended(code, said), events


def _waited(child: int) -> int:
    def too_long(*_: object) -> None:
        os.kill(child, signal.SIGKILL)
        raise TimeoutError(f"the child was still running after {LONGEST_S} s")

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(LONGEST_S)
    try:
        return os.waitpid(child, 0)[1]
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _be_the_verb(argv: list[str], folder: Path, notes: Path, log: Path, at: int | None, number: int) -> None:
    """The whole life of a child; it does not return."""
    code = 70
    try:
        for each in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            signal.signal(each, signal.default_int_handler if each == signal.SIGINT else signal.SIG_DFL)
        written = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(written, 1)
        os.dup2(written, 2)
        sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", closefd=False) for n in (1, 2))  # noqa: SIM115
        os.chdir(folder)
        sys.argv = ["lightdepth", *argv]
        _count(folder, os.open(notes, os.O_WRONLY | os.O_APPEND), at, number)
        from lightdepth.cli import main

        code = main(argv)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _count(folder: Path, notes: int, at: int | None, number: int) -> None:
    """Notes each event below the folder from now on, and sends the signal at the one that is meant."""
    home, own, seen = f"{folder}/", os.getpid(), 0

    def below(path: object) -> str | None:
        if not isinstance(path, str | bytes | os.PathLike):
            return None
        name = os.path.abspath(os.fsdecode(path))
        return name.removeprefix(home) if name.startswith(home) else None

    def heard(kind: str, given: tuple[object, ...]) -> None:
        nonlocal seen
        if kind == "open":
            path, _, flags = given
            paths = [below(path)] if isinstance(flags, int) and flags & WRITING else []
        elif kind in (*CHANGING, "opened"):
            paths = [below(path) for path in given[:2]]
        else:
            return
        named = [path for path in paths if path is not None]
        if not named or os.getpid() != own:
            return
        os.write(notes, (json.dumps([kind, *named]) + "\n").encode())
        seen += 1
        if seen - 1 == at:  # counted before: the signal may end this function by an exception
            os.kill(own, number)

    def opened(file: Any, mode: str = "r", *given: Any, **named: Any) -> Any:
        made = real(file, mode, *given, **named)
        if set(mode) & set("wax+"):
            heard("opened", (file,))
        return made

    real = io.open
    builtins.open = io.open = opened
    sys.addaudithook(heard)


def tree_hash(folder: Path) -> str:
    """SHA-256 over the names and contents of all that is below a folder, links as what they point to."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        digest.update(f"{path.relative_to(folder)}\0".encode())
        if path.is_symlink():
            digest.update(os.readlink(path).encode())
        elif path.is_file():
            digest.update(path.read_bytes())
    return digest.hexdigest()


def unlike(made: Path, reference: Path) -> str:
    """The first difference between two results but for times; empty where they are the same."""
    if made.is_dir() != reference.is_dir():
        return f"{made.name} is {'a folder' if made.is_dir() else 'no folder'}"
    if not made.is_dir():
        return ""
    one, other = files(made), files(reference)
    if not (reference / "run.json").is_file():  # what single files are made with lies beside them
        one, other = ({path for path in every if not path.parts[0].startswith(".")} for every in (one, other))
    for path in sorted(one ^ other):
        return f"{path} is {'one too many' if path in one else 'missing'}"
    for path in sorted(one):
        if found := difference(made / path, reference / path, 0.0):
            return f"{path}: {found}"
    return ""


@dataclass(frozen=True)
class Case:
    """A verb that gets a signal at an event, with an older result in its place or none."""

    verb: Verb
    at: int
    number: int
    over: bool

    @property
    def key(self) -> str:
        return f"{self.verb.name} {'over' if self.over else 'fresh'} {self.at} {signal.Signals(self.number).name}"


class Stage:
    """Where cases are played: inputs, and for each verb what it makes when nothing happens."""

    def __init__(self, home: Path, inputs: Path) -> None:
        self.home, self.inputs = home.resolve(), inputs.resolve()
        self.home.mkdir(parents=True, exist_ok=True)
        self._references: dict[tuple[str, bool], tuple[Path, list[Event]]] = {}

    def reference(self, verb: Verb, older: bool) -> tuple[Path, list[Event]]:
        """The folder in which an undisturbed run worked, and its events. `older`: of the result to be replaced."""
        key = verb.name, older
        if key not in self._references:
            folder = self._folder(f"{verb.name.replace(' ', '_')}-{'older' if older else 'made'}")
            ended, events = run([*verb.argv, *(verb.older if older else ())], folder)
            assert ended.code == 0, f"{verb.name} ends with {ended.code} when nothing happens:\n{ended.said}"
            assert events, f"{verb.name} did nothing to a file"
            self._references[key] = folder, events
        return self._references[key]

    def events(self, verb: Verb, over: bool) -> list[Event]:
        """The events of a run that finds no result, or with `over` of one that replaces an older one."""
        if not over:
            return self.reference(verb, False)[1]
        key = f"{verb.name} over", False
        if key not in self._references:
            folder = self._folder(f"{verb.name.replace(' ', '_')}-over")
            shutil.copytree(self.reference(verb, True)[0] / verb.output, folder / verb.output)
            ended, events = run([*verb.argv, *verb.again], folder)
            assert ended.code == 0, f"{verb.name} --overwrite ends with {ended.code}:\n{ended.said}"
            found = unlike(folder / verb.output, self.reference(verb, False)[0] / verb.output)
            assert not found, f"{verb.name} --overwrite makes another result: {found}"
            self._references[key] = folder, events
        return self._references[key][1]

    def _folder(self, name: str) -> Path:
        folder = self.home / name
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.inputs, folder)
        return folder

    def play(self, case: Case) -> list[str]:
        """What did not hold in a case; nothing where all did."""
        verb, folder = case.verb, self._folder("case")
        reference = self.reference(verb, False)[0]
        older = self.reference(verb, True)[0] / verb.output if case.over else None
        if older is not None:
            shutil.copytree(older, folder / verb.output)
        again = verb.again if case.over else ()
        ended, _ = run([*verb.argv, *again], folder, case.at, case.number)
        wrong = [*_after_the_signal(case, folder, reference / verb.output, older, ended)]
        wrong += self._inputs_changed(folder, verb)
        resumes = ("--resume",) if verb.resumes else ()
        there = (folder / verb.output).exists() or _successor(folder, verb)  # it takes its place before all else
        if not verb.resumes and verb.overwrites and there:
            resumes = verb.again
        if case.over and older is not None and not _goes_on(folder, verb) and _old_one(folder, verb, older):
            resumes = verb.again
        restarted, _ = run([*verb.argv, *resumes], folder)
        if restarted.code:
            wrong.append(
                f"the next run ({' '.join(resumes) or 'as before'}) ends with {restarted.code}: {restarted.said}"
            )
        elif found := unlike(folder / verb.output, reference / verb.output):
            wrong.append(f"the next run ({' '.join(resumes) or 'as before'}) makes another result: {found}")
        wrong += self._inputs_changed(folder, verb)
        wrong += [f"{name} is left after the next run" for name in _strays(folder, reference, verb)]
        if verb.resumes:
            finished, _ = run([*verb.argv, "--resume"], folder)
            if finished.code:
                wrong.append(f"--resume of the finished run ends with {finished.code}: {finished.said}")
            elif found := unlike(folder / verb.output, reference / verb.output):
                wrong.append(f"--resume of the finished run changes the result: {found}")
        return wrong

    def _inputs_changed(self, folder: Path, verb: Verb) -> Iterator[str]:
        for path in sorted(self.inputs.iterdir()):
            now = folder / path.name
            same = now.exists() and (now.read_bytes() == path.read_bytes() if path.is_file() else None)
            if same is None:
                same = tree_hash(now) == tree_hash(path)
            if not same:
                yield f"the input {path.name} has changed"


def _after_the_signal(case: Case, folder: Path, made: Path, older: Path | None, ended: Ended) -> Iterator[str]:
    verb, output = case.verb, folder / case.verb.output
    number = signal.Signals(case.number)
    meant = -number if number == signal.SIGKILL else 128 + number
    if ended.code not in (meant, 0):
        yield f"{number.name} ends it with {ended.code}: {ended.said}"
    if "Traceback" in ended.said:
        yield f"{number.name} ends it with a traceback: {ended.said}"
    if number != signal.SIGKILL and ended.code and len(ended.said.strip().splitlines()) < 1:
        yield f"{number.name} ends it without a word"
    complete = (output / "run.json").is_file()
    if complete and not _holds(output, made) and not (older is not None and _holds(output, older)):
        yield f"half of a result looks complete: {unlike(output, made)}"
    tried = output.is_dir() and not any(output.iterdir())  # whether a folder can stand there is tried before the work
    if not complete and not verb.in_place and output.is_dir() and not tried and (made / "run.json").is_file():
        yield f"{verb.output} is there without run.json"
    if not (made / "run.json").is_file() and output.is_dir():  # single files
        for path in sorted(files(output)):
            if path.parts[0].startswith(".") or path.name.startswith("."):
                continue
            wanted = [made / path] + ([older / path] if older is not None else [])
            if all(not each.is_file() or difference(output / path, each, 0.0) for each in wanted):
                yield f"{path} is neither the old nor the new one"
    if older is not None and not _holds(output, made):
        beside = [output, *(path for path in folder.iterdir() if path.name.startswith("."))]
        if not any(_holds(path, older) for path in beside) and (older / "run.json").is_file():
            yield "the old result is nowhere whole"
    if number != signal.SIGKILL and ended.code:
        if older is not None and not _holds(output, older) and not _holds(output, made):
            yield f"{verb.output} is not as it was after {number.name}"
        if older is None and tried:
            yield f"{verb.output} is left empty after {number.name}"
        kept = {f".{verb.output}.unfinished"} if _goes_on(folder, verb) else set()
        for name in sorted({path.name for path in folder.iterdir() if path.name.startswith(".")} - kept):
            yield f"{name} is left after {number.name}"


def _goes_on(folder: Path, verb: Verb) -> bool:
    """Whether a hidden run with a finished part or a checkpoint is there, which --resume has to go on with."""
    found = [folder / f".{verb.output}.unfinished", *(folder / verb.output).glob(".*.unfinished")]
    parts = [made / "parts.jsonl" for made in found if (made / "parts.jsonl").is_file()]
    return any(b"\n" in path.read_bytes() for path in parts) or any(found[0].glob("checkpoints/[!.]*.ckpt"))


def _old_one(folder: Path, verb: Verb, older: Path) -> bool:
    """Whether the older result is still the one, in its place or moved aside with no whole successor."""
    if _holds(folder / verb.output, older):
        return True
    aside = not (folder / verb.output).exists() and _holds(folder / f".{verb.output}.old", older)
    return aside and not _successor(folder, verb)


def _successor(folder: Path, verb: Verb) -> bool:
    """Whether a result is whole and had only to take its place."""
    return (folder / f".{verb.output}.unfinished" / "run.json").is_file()


def _holds(folder: Path, result: Path) -> bool:
    return folder.is_dir() and not unlike(folder, result)


def _strays(folder: Path, reference: Path, verb: Verb) -> list[str]:
    beside = {path.name for path in folder.iterdir()} - {path.name for path in reference.iterdir()}
    return sorted(beside | {f"{verb.output}/{path.name}" for path in (folder / verb.output).glob(".*")})


def drawn(verb: Verb, events: list[Event], count: int, draw: Callable[[int], list[int]]) -> list[int]:
    """Which events a verb is killed at: all around a rename into place, and others that `draw` orders by chance, at
    least a third of `count`. Where less than twelve are asked for, those around renames are drawn as well."""
    around = [i for i, event in enumerate(events) if event.places(verb.output)]
    around = sorted({i for at in around for i in (at, at + 1) if i < len(events)})
    order = draw(len(events))
    others = [i for i in order if i not in around]
    if count < 12:
        around = [i for i in order if i in around][: count // 2]
    return sorted([*around, *others[: max(count - len(around), count // 3)]])
