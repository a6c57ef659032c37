"""The `lightdepth` command: finds its verbs through the entry points `lightdepth.commands`.

A verb is a function. Its parameters become options (jsonargparse; dataclasses become dotted options), those without a
default become positional; the first line of its docstring is its line in the help, read without importing the module.
A verb with the single parameter `argv` parses its own arguments.
"""

from __future__ import annotations

import inspect
import io
import os
import sys
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from lightdepth import __version__
from lightdepth.command_line.dry import DRY, Planned
from lightdepth.command_line.outcome import Outcome, in_turn, manners, outcome, planned, speaking
from lightdepth.command_line.own_packages import own_packages_first
from lightdepth.command_line.own_process import set_own_process
from lightdepth.command_line.pipes import fill_closed_streams, outliving_readers
from lightdepth.command_line.verbs import all_verbs, summary_of, verb_parser
from lightdepth.command_line.warned import warnings_as_sentences
from lightdepth.errors import (
    AlreadyFinished,
    InputError,
    Interrupted,
    MachineFailure,
    MissingOption,
    PartialFailure,
)
from lightdepth.foreign_text import for_line
from lightdepth.signals import ending_on_signals


def main(argv: list[str] | None = None) -> int:
    """Runs one verb. Exit codes: 0 done, 2 wrong usage, 3 bad input, 4 part of the work failed, 5 the machine failed
    (disk, memory, a folder that is gone), 128 + n ended by signal n. In threads, calls with --json or --quiet wait for
    each other."""
    fill_closed_streams()
    if argv is None:  # a process of its own, in which nothing is loaded yet
        set_own_process()
    call, given = manners(sys.argv[1:] if argv is None else argv)
    call.version = __version__
    with in_turn(call):
        return _called(call, given)


def _called(call: Outcome, given: list[str]) -> int:
    """The exit code of a call, of which all is said by then."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a name that the terminal cannot show ends no run
    code = 0
    try:
        with ending_on_signals(), outliving_readers(), warnings_as_sentences(), speaking(call) as ended:
            # A run's own context: what one says of names does not hold for the next.
            ended[0] = code = copy_context().run(_main, given)
        return code
    except Interrupted as error:
        with suppress(OSError):  # the terminal may be what is gone
            _say(f"lightdepth {call.verb}: {error}", flush=True)
            _say_next(call)
        return 128 + error.signal
    except MachineFailure as error:  # of the terminal itself: what was to be said could not be
        with suppress(OSError):
            _say(f"lightdepth {call.verb}: {error}", flush=True)
        return code or 5


def _main(argv: list[str]) -> int:
    try:
        own_packages_first()
    except InputError as error:
        outcome().fail(error.where, error.found, error.cure)
        _say(f"lightdepth: {error}")
        return 3
    commands = all_verbs()
    if not argv or argv[0] in ("-h", "--help", "--help-all"):
        print(_help(commands))
        return 0 if argv else 2
    if argv[0] in ("-V", "--version"):
        print(f"lightdepth {__version__}")
        return 0
    verb, rest = argv[0], argv[1:]
    if verb not in commands:
        import difflib

        close = difflib.get_close_matches(verb, commands, 1)
        hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(commands)}"
        outcome().fail(verb, "no such verb", hint)
        _say(f"lightdepth: no verb {verb!r}; {hint}")
        return 2
    if _is_lost(verb):  # libraries of the verbs would crash on it
        return 5
    try:
        function = commands[verb].load()
        if list(inspect.signature(function).parameters) == ["argv"]:
            return function(rest) or 0
        return function(**parse(function, verb, rest)) or 0
    except MissingOption as error:
        return _told(verb, error, 2)
    except InputError as error:
        return 5 if _is_lost(verb) else _told(verb, error, 3)
    except PartialFailure as error:
        return _told(verb, error, 4)
    except Planned as plan:
        planned(plan)
        return 0
    except AlreadyFinished as error:
        outcome().finished_before = True
        outcome().last(f"lightdepth {verb}: {error}")
        return 0
    except (MachineFailure, OSError, MemoryError, RuntimeError) as error:
        return _failed(verb, error)
    except UnicodeEncodeError as error:  # libraries that know UTF-8 alone
        if not any("\udc80" <= letter <= "\udcff" for letter in str(error.object)):
            raise
        name = str(error.object).encode("utf-8", "backslashreplace").decode()
        return _told(verb, InputError(name[:300], "a name that is not UTF-8", "rename it"), 3)
    except KeyboardInterrupt:  # where signals are not ours: outside the main thread
        return _told(verb, "interrupted", 130)


def _say(line: str, flush: bool = False) -> None:
    """A line on standard error, whatever names are in it."""
    print(for_line(line), file=sys.stderr, flush=flush)


def _told(verb: str, error: Exception | str, code: int) -> int:
    """Says what ended a verb, and returns its exit code."""
    if isinstance(error, InputError):
        outcome().fail(error.where, error.found, error.cure)
    else:
        outcome().fail(verb, error)
    _say(f"lightdepth {verb}: {error}")
    _say_next(outcome())
    return code


def _say_next(call: Outcome) -> None:
    """The command line that goes on with what is kept of a run which did not end."""
    if call.again is not None:
        _say(f"next: {call.again.said(sys.stderr)}", flush=True)


def _is_lost(verb: str) -> bool:
    """Whether the folder that the user is in is gone, which is told then."""
    from lightdepth.files.machine import is_lost

    if lost := is_lost():
        _told(verb, "the folder that you are in is gone; go to another one", 5)
    return lost


def _failed(verb: str, error: Exception) -> int:
    """One sentence for what the machine did (5), or for a file that cannot be used (3); other errors are ours."""
    from lightdepth.files.machine import machine_failure

    failure = error if isinstance(error, MachineFailure) else machine_failure(error)
    if failure is not None:
        return _told(verb, failure, 5)
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop from "):  # Path.resolve, until 3.12
        where = str(error).removeprefix("Symlink loop from ")
        return _told(verb, InputError(where, "links in a circle", "give another path"), 3)
    if not isinstance(error, OSError) or error.filename is None or isinstance(error.filename, int):
        raise error
    where, found = os.fsdecode(error.filename), str(error.strerror or error)
    outcome().fail(where, found)
    _say(f"lightdepth {verb}: {where}: {found}")
    return 3


def parse(function: Any, verb: str, argv: list[str]) -> dict[str, Any]:
    """The arguments of a verb's function by name, from the command line's words."""
    from lightdepth.command_line.gone_settings import without_gone
    from lightdepth.command_line.mistakes import config_files, fail
    from lightdepth.command_line.options import with_groups
    from lightdepth.command_line.parsing import parsed
    from lightdepth.command_line.presets import with_preset
    from lightdepth.files.replacing import check_apart
    from lightdepth.reporting.names import KEPT
    from lightdepth.reporting.own_settings import with_real_settings

    parser = verb_parser(function, verb)
    given = with_preset(verb, argv, partial(fail, parser))
    found = parsed(parser, without_gone(verb, with_real_settings(given)))
    if found.get("overwrite") and found.get("output"):
        check_apart(Path(found["output"]), config_files(given))
    DRY.set(bool(found.pop("dry_run", False)))
    if "keep_names" not in inspect.signature(function).parameters:
        KEPT.set(bool(found.pop("keep_names", False)))
    return with_groups(function, parser.instantiate(found))


def _help(commands: dict[str, metadata.EntryPoint]) -> str:
    lines = ["usage: lightdepth VERB [options]     (lightdepth VERB --help shows a verb's options)", ""]
    lines += [f"  {name:<15} {summary_of(entry)}" for name, entry in commands.items()]
    more = "lightdepth --version prints the version; --quiet and --json go with every verb."
    return "\n".join([*lines, "", more])
