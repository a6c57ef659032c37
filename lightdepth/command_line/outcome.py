"""What came of a verb, and how much of it is said: its last lines, `--quiet`, and `--json`, one document instead.

    verb, at its end:  end(output, then="lightdepth evaluate OUT --truth SEQUENCE", page=output / "report.html")
    usually:           next: lightdepth evaluate OUT --truth SEQUENCE
                       written: OUT; open OUT/report.html

Words of every verb, which are taken off the command line before its own options are read. `--quiet` leaves errors,
warnings, the answer of a verb that writes nothing, and the line of what was written. `--json` leaves standard output to
the document, which comes last; all that is said besides goes to standard error.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from shlex import join
from typing import Any, TextIO

from lightdepth.command_line.dry import Planned
from lightdepth.command_line.following import Following
from lightdepth.command_line.heartbeat import Heartbeat, beating
from lightdepth.command_line.warned import heard
from lightdepth.errors import Interrupted, WrongUsage
from lightdepth.foreign_text import for_line, for_terminal

QUIET, JSON = "--quiet", "--json"
RESUMES = "--resume goes on"
SAID_OF = {
    "quiet": "Say nothing but errors, warnings, and what was written where; log.txt has all of it.",
    "json": "Print the result as one JSON document on standard output, and nothing else there.",
}
"""The words that every verb takes, with their sentences for the help."""
_ANSWERED = ("-h", "--help", "--help_all", "--print_config", "-V", "--version")
"""Words that are answered by a text of their own, in the place of any work."""
_LISTED = ("files", "warnings", "failures")
"""What the document has beside the rest of run.json."""


@dataclass
class Outcome:
    """What came of one call of the command."""

    quiet: bool = False
    json: bool = False
    verb: str = ""
    words: Sequence[str] = ()
    """of the command line"""
    version: str = ""
    """of the program"""
    out: TextIO | None = None
    """where the last lines and the document go"""
    output: str | None = None
    files: list[str] = field(default_factory=list)
    then: str = ""
    result: Mapping[str, Any] | None = None
    warnings: list[str] = field(default_factory=list)
    failures: list[Any] = field(default_factory=list)
    error: dict[str, str] | None = None
    finished_before: bool = False
    stage: Callable[[str], None] = lambda said: None
    """is told the lines of a log"""
    goes_on: str = RESUMES
    """how a run whose finished parts are kept goes on, in words; empty where none does"""
    again: Following | None = None
    """the command line by which it does, where it did not end"""
    record: Mapping[str, Any] | None = None
    """the last run.json that was written, of a folder that may not be in its place yet"""

    @property
    def doubts(self) -> TextIO | None:
        """Where warnings go: to standard output, or, where nothing is said there, to standard error."""
        return sys.stderr if self.quiet else None

    def fail(self, where: object, found: object, cure: str = "") -> None:
        """The call ends with an error."""
        self.error = {"where": str(where), "found": str(found), "cure": cure}

    def keeping(self, kept: str) -> str:
        """What is said at the end of a run that was stopped: what is `kept` of it, and how it goes on. Empty where it
        does not go on. With --resume, the command line is told behind it."""
        if self.words and self.goes_on == RESUMES:
            self.again = resuming(self.words)
        return f"{kept}: {self.goes_on}" if self.goes_on else ""

    def made(self, output: Path, said: Sequence[str] = ()) -> None:
        """The run folder whose run.json was written last is in its place. `said`: its warnings, as they were told."""
        record = self.record or {}
        self.output = str(output)
        self.files = [str(output / name) for name in (*record.get("files", {}), "run.json")]
        self.result = {name: value for name, value in record.items() if name not in _LISTED}
        self.warnings = [*record.get("warnings", []), *(w for w in self.warnings if w not in said)]
        self.failures = list(record.get("failures", []))

    def warned(self, message: str) -> None:
        """Something is doubtful."""
        if message not in self.warnings:
            self.warnings.append(message)

    def last(self, line: str) -> None:
        """A line that is said with `--quiet` too."""
        print(for_terminal(line), file=self.out if self.quiet and not self.json else None, flush=True)

    def answer(self, text: str) -> None:
        """What somebody reads who is no terminal: a text as it is."""
        print(text, file=self.out if self.quiet and not self.json else None, flush=True)

    def document(self, code: int, seconds: float) -> str:
        """All of it, as --json prints it."""
        said: dict[str, Any] = {"verb": self.verb, "exit_code": code, "version": self.version}
        then = self.then or (self.again.anonymous if self.again is not None else "")
        said |= {"output": self.output, "files": self.files, "next": then, "result": self.result}
        said |= {"warnings": self.warnings, "failures": self.failures, "seconds": round(seconds, 3)}
        if self.finished_before:
            said["finished_before"] = True
        if self.error is not None:
            said["error"] = self.error
        return json.dumps(_plain(said), indent=1)


OUTCOME: ContextVar[Outcome] = ContextVar("outcome")
_NOBODY = Outcome()
"""Of functions that are called from Python: what is noted in it is read by nobody."""


def outcome() -> Outcome:
    """That of the call which is at work."""
    return OUTCOME.get(_NOBODY)


def is_quiet() -> bool:
    """Whether nothing is to be said of how the work goes."""
    return outcome().quiet


def end(
    *written: Path,
    then: str | Following,
    page: Path | None = None,
    result: Mapping[str, Any] | None = None,
    doubts: Sequence[str] = (),
) -> None:
    """The last lines of a verb: what to type next, and what was written where, as the user named it. `page` is what to
    open first; `result` and `doubts` are of a verb without a run folder."""
    call = outcome()
    call.then = then if isinstance(then, str) else then.anonymous
    if written and call.output is None:
        call.output, call.files = str(written[0]), [str(path) for path in written]
    if result is not None:
        call.result = result
    for doubt in doubts:
        call.warned(doubt)
    if not call.quiet:
        said = then if isinstance(then, str) else then.said(sys.stdout)
        print(f"next: {for_line(said)}", flush=True)
    opened = f"; open {for_line(str(page))}" if page is not None else ""
    if written:
        call.last(f"written: {', '.join(for_line(str(path)) for path in written)}{opened}")
    elif not call.quiet:
        call.last("written: nothing")


def resuming(words: Sequence[str]) -> Following:
    """The command line that goes on with the run of another one, whose words these are: inputs are among them."""
    there = any(_means(word, "--overwrite") for word in words)
    place = " in the place of --overwrite" if there else ""
    kept = [word for word in words if not _means(word, "--overwrite")]
    if not any(_means(word, "--resume") for word in kept):
        kept.insert(kept.index("--") if "--" in kept else len(kept), "--resume")
    return Following(f"the same command with --resume{place}", join(["lightdepth", *kept]))


def _means(word: str, option: str) -> bool:
    """Whether it is an option, or enough of its beginning."""
    return len(word) > 3 and option.startswith(word)


def planned(plan: Planned) -> None:
    """The last lines of a dry run."""
    call = outcome()
    if not call.json:
        for line in str(plan).splitlines():
            call.last(line)
    end(then="the same command without --dry-run", result=plan.record())


def manners(words: Sequence[str]) -> tuple[Outcome, list[str]]:
    """How a command line wants to be answered, and its words without those that say so."""
    asked = any(word.replace("-", "_").partition("=")[0] in _SPELLED for word in words)
    rest = [word for word in words if word not in (QUIET, JSON)]
    working = bool(rest) and not asked  # help, version and the configuration are what was asked for, whatever the words
    quiet, as_json = QUIET in words and working, JSON in words and not asked
    return Outcome(quiet, as_json, rest[0] if rest else "", tuple(words)), rest


_TURN = threading.RLock()
_SPELLED = {word.replace("-", "_") for word in _ANSWERED}


def in_turn(call: Outcome) -> AbstractContextManager[object]:
    """Standard output is one for all threads of a process: calls that keep it for their answers wait for each other."""
    return _TURN if call.json or call.quiet else nullcontext()


@contextmanager
def speaking(call: Outcome) -> Iterator[list[int]]:
    """Within it `call` is what verbs tell of. The exit code is put into what is yielded; the document, where one is
    wanted, is printed at the end, whatever the block raises."""
    code, start, token = [1], time.monotonic(), OUTCOME.set(call)
    call.out = sys.stdout
    try:
        with heard(call.warned), _streams(call), _beating(call):
            yield code
    except SystemExit as stop:
        code[:] = [stop.code if isinstance(stop.code, int) else int(stop.code is not None)]
        if isinstance(stop, WrongUsage):
            call.fail("the command line", stop.found, stop.cure)
        raise
    except Interrupted as error:
        code[:] = [128 + error.signal]
        stopped, _, kept = str(error).partition("; ")
        call.fail(call.verb, stopped, kept)
        raise
    except BaseException as error:
        call.fail(call.verb, f"{type(error).__name__}: {error}", "this is a fault of the program: please report it")
        if call.again is not None:
            error.add_note(f"next: {call.again.said(sys.stderr)}")
        raise
    finally:
        OUTCOME.reset(token)
        if call.json:
            print(call.document(code[0], time.monotonic() - start), file=call.out, flush=True)


@contextmanager
def _streams(call: Outcome) -> Iterator[None]:
    """Standard output is kept for what it is wanted for: nothing else comes there, from libraries neither."""
    if not (call.quiet or call.json):
        yield
        return
    out = sys.stdout
    with suppress(OSError):
        out.flush()
    with ExitStack() as ending:
        if call.json:
            number = os.dup(1)
            os.dup2(2, 1)
            ending.callback(os.close, number)
            ending.callback(os.dup2, number, 1)
            ending.callback(_flush_libraries)
            sys.stdout = sys.stderr
        if call.quiet:
            sys.stdout = ending.enter_context(open(os.devnull, "w", encoding="utf-8"))
        try:
            yield
        finally:
            sys.stdout = out


def _flush_libraries() -> None:
    """What libraries in C have said and hold back still goes where standard output leads now."""
    with suppress(OSError, AttributeError, TypeError):  # there is no such library everywhere
        ctypes.CDLL(None).fflush(None)


@contextmanager
def _beating(call: Outcome) -> Iterator[None]:
    """No long silence, unless silence was asked for."""
    if call.quiet or not call.verb:
        yield
        return
    start, out, err = time.monotonic(), sys.stdout, sys.stderr
    heart = Heartbeat(
        f"lightdepth {call.verb}",
        lambda: max(getattr(stream, "heard", start) for stream in (out, err)),
        lambda line: print(for_line(line), file=err, flush=True),
    )
    call.stage = heart.stage
    with beating(heart):
        yield


def _plain(value: Any) -> Any:
    """For JSON of any reader: paths as text, and no number that is none."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
