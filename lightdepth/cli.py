"""The `lightdepth` command: finds its verbs through the entry points `lightdepth.commands`.

A verb is a function. Its parameters become options (jsonargparse; dataclasses become dotted options), those without a
default become positional; the first line of its docstring is its line in the help, read without importing the module.
A verb with the single parameter `argv` parses its own arguments.
"""

from __future__ import annotations

import ast
import inspect
import io
import os
import sys
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from importlib import metadata, util
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightdepth.command_line.pages import PAGES, Page

if TYPE_CHECKING:
    from lightdepth.command_line.parsing import Parser

from lightdepth import __version__
from lightdepth.command_line.own_packages import own_packages_first
from lightdepth.command_line.pipes import fill_closed_streams, outliving_readers
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

GROUP = "lightdepth.commands"
KEEP_NAMES = """Write the paths of inputs as they are into run.json, log and reports. Without it they are called by the
option and a hash of their contents, as paths are often names of patients, and inputs.json alone has the paths."""
ONE_THREAD = "OPENBLAS_NUM_THREADS", "1"
"""The systems that are solved are many and small. Threads of each would wait for each other, for long where a container
or other work leaves fewer cores than the machine has."""
ORDER = (
    "demo",
    "doctor",
    "synth",
    "import",
    "calibrate-light",
    "convert-camera",
    "select",
    "train",
    "adapt",
    "ablate",
    "predict",
    "sparse",
    "densify",
    "live",
    "evaluate",
    "bench",
    "measure",
)


def main(argv: list[str] | None = None) -> int:
    """Runs one verb. Exit codes: 0 done, 2 wrong usage, 3 bad input, 4 part of the work failed, 5 the machine failed
    (disk, memory, a folder that is gone), 128 + n ended by signal n."""
    fill_closed_streams()
    if argv is None:  # a process of its own, in which nothing is loaded yet
        os.environ.setdefault(*ONE_THREAD)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a name that the terminal cannot show ends no run
    given, code = sys.argv[1:] if argv is None else argv, 0
    try:
        with ending_on_signals(), outliving_readers(), warnings_as_sentences():
            # A run's own context: what one says of names does not hold for the next.
            code = copy_context().run(_main, given)
        return code
    except Interrupted as error:
        with suppress(OSError):  # the terminal may be what is gone
            _say(f"lightdepth {given[0] if given else ''}: {error}", flush=True)
        return 128 + error.signal
    except MachineFailure as error:  # of the terminal itself: what was to be said could not be
        with suppress(OSError):
            _say(f"lightdepth {given[0] if given else ''}: {error}", flush=True)
        return code or 5


def _main(argv: list[str]) -> int:
    try:
        own_packages_first()
    except InputError as error:
        _say(f"lightdepth: {error}")
        return 3
    commands = {entry.name: entry for entry in metadata.entry_points(group=GROUP)}
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
        hint = f"; did you mean {close[0]}?" if close else f"; expected one of {', '.join(_sorted(commands))}"
        _say(f"lightdepth: no verb {verb!r}{hint}")
        return 2
    if _is_lost(verb):  # libraries of the verbs would crash on it
        return 5
    try:
        function = commands[verb].load()
        if list(inspect.signature(function).parameters) == ["argv"]:
            return function(rest) or 0
        return function(**parse(function, verb, rest)) or 0
    except MissingOption as error:
        _say(f"lightdepth {verb}: {error}")
        return 2
    except InputError as error:
        if _is_lost(verb):
            return 5
        _say(f"lightdepth {verb}: {error}")
        return 3
    except PartialFailure as error:
        _say(f"lightdepth {verb}: {error}")
        return 4
    except AlreadyFinished as error:
        print(for_line(f"lightdepth {verb}: {error}"))
        return 0
    except (MachineFailure, OSError, MemoryError, RuntimeError) as error:
        return _failed(verb, error)
    except UnicodeEncodeError as error:  # libraries that know UTF-8 alone
        if not any("\udc80" <= letter <= "\udcff" for letter in str(error.object)):
            raise
        name = str(error.object).encode("utf-8", "backslashreplace").decode()
        _say(f"lightdepth {verb}: {name[:300]}: a name that is not UTF-8; rename it")
        return 3
    except KeyboardInterrupt:  # where signals are not ours: outside the main thread
        _say(f"lightdepth {verb}: interrupted")
        return 130


def _say(line: str, flush: bool = False) -> None:
    """A line on standard error, whatever names are in it."""
    print(for_line(line), file=sys.stderr, flush=flush)


def _is_lost(verb: str) -> bool:
    """Whether the folder that the user is in is gone, which is told then."""
    from lightdepth.files.machine import is_lost

    if lost := is_lost():
        _say(f"lightdepth {verb}: the folder that you are in is gone; go to another one")
    return lost


def _failed(verb: str, error: Exception) -> int:
    """One sentence for what the machine did (5), or for a file that cannot be used (3); other errors are ours."""
    from lightdepth.files.machine import machine_failure

    failure = error if isinstance(error, MachineFailure) else machine_failure(error)
    if failure is not None:
        _say(f"lightdepth {verb}: {failure}")
        return 5
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop from "):  # Path.resolve, until 3.12
        _say(
            f"lightdepth {verb}: {str(error).removeprefix('Symlink loop from ')}: links in a circle; give another path"
        )
        return 3
    if not isinstance(error, OSError) or error.filename is None or isinstance(error.filename, int):
        raise error
    _say(f"lightdepth {verb}: {os.fsdecode(error.filename)}: {error.strerror or error}")
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
    if "keep_names" not in inspect.signature(function).parameters:
        KEPT.set(bool(found.pop("keep_names", False)))
    return with_groups(function, parser.instantiate(found))


def verb_parser(function: Any, verb: str) -> Parser:
    """The options of a verb: the parameters of its function."""
    from docstring_parser import parse as parse_docstring

    from lightdepth.command_line.options import add_groups, groups_of
    from lightdepth.command_line.parsing import Parser, finish
    from lightdepth.command_line.presets import preset_help, presets
    from lightdepth.command_line.ranges import ranges_in

    said = {p.arg_name: p.description for p in parse_docstring(inspect.getdoc(function) or "").params}
    # The first line only: jsonargparse shows the rest of the docstring beside the options.
    summary = (inspect.getdoc(function) or "").split("\n")[0]
    parser = Parser(prog=f"lightdepth {verb}", description=summary, default_env=False)
    parser.add_argument("--config", action="config")
    if presets(verb):
        parser.add_argument("--preset", metavar="NAME", help=preset_help(verb))
    parameters = inspect.signature(function).parameters
    # Declared here, because options derived from parameters have no short form and no bare flags.
    if "output" in parameters:
        default = parameters["output"].default
        needed = default is inspect.Parameter.empty
        parser.add_argument(
            "-o",
            "--output",
            type=Path if needed else Path | None,  # a folder may be called null
            required=needed,
            default=None if needed else default,
            help=said.get("output"),
        )
    if "overwrite" in parameters:
        parser.add_argument("--overwrite", action="store_true", help=said.get("overwrite"))
    if "no_frames" in parameters:
        parser.add_argument("--no_frames", action="store_true", help=said.get("no_frames"))
    if "output" in parameters and "keep_names" not in parameters:
        parser.add_argument("--keep_names", action="store_true", help=KEEP_NAMES)
    declared: set[str | int] = {name for name in ("output", "overwrite", "no_frames") if name in parameters}
    add_groups(parser, function)
    parser.add_function_arguments(
        function, as_positional=True, sub_configs=True, skip={*declared, *groups_of(function)}
    )
    finish(parser, PAGES.get(verb, Page()), ranges_in(function))
    return parser


def _sorted(commands: dict[str, metadata.EntryPoint]) -> list[str]:
    return sorted(commands, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))


def _help(commands: dict[str, metadata.EntryPoint]) -> str:
    lines = ["usage: lightdepth VERB [options]     (lightdepth VERB --help shows a verb's options)", ""]
    for name in _sorted(commands):
        lines.append(f"  {name:<15} {_summary(commands[name])}")
    return "\n".join([*lines, "", "lightdepth --version prints the version."])


def _summary(entry: metadata.EntryPoint) -> str:
    """First line of the verb's docstring, read from the source: importing it would cost seconds."""
    spec = util.find_spec(entry.module)
    if spec is None or spec.origin is None:
        return ""
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8-sig")).body:
        if isinstance(node, ast.FunctionDef) and node.name == entry.attr:
            return (ast.get_docstring(node) or "").split("\n")[0]
    return ""
