"""The verb completion: a script with which a shell completes verbs, options, their choices, and files.

The script is static: it is made from the parsers of all verbs, once, so that a TAB starts no Python.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal

from lightdepth.command_line.kinds import choices_of_type, leaves, literals
from lightdepth.command_line.outcome import outcome
from lightdepth.command_line.presets import presets
from lightdepth.command_line.verbs import all_verbs, parsers_of, summary_of
from lightdepth.command_line.words import dashed, options

if TYPE_CHECKING:
    from lightdepth.command_line.parsing import Parser

_NAME_FILES = ("config", "output", "light", "poses", "data.sequences")
"""Options of type text that name a file, or may."""
_NAME_MODELS = ("checkpoint", "checkpoints", "what", "model.start")
"""Options that name a depth model: a file, or one that comes with the program."""
_PLACES = {
    "bash": "~/.local/share/bash-completion/completions/lightdepth",
    "zsh": "FOLDER/_lightdepth",
    "fish": "~/.config/fish/completions/lightdepth.fish",
}


def completion(shell: Literal["bash", "zsh", "fish"]) -> None:
    """A script for the shell, which completes verbs, options, their choices and files after a TAB.

    Args:
        shell: Shell that the script is for: bash, zsh or fish.
    """
    import shtab

    script = shtab.complete(_all_verbs(), shell)
    place = _PLACES[shell]
    where = f"# Completion of lightdepth for {shell}; it belongs to {place}"
    where += ", where FOLDER is one of $fpath\n" if shell == "zsh" else "\n"
    first, end, rest = script.partition("\n")
    made = f"{first}{end}{where}{rest}" if first.startswith("#") else f"{where}{script}"  # zsh reads the first line
    call = outcome()
    call.then = f"mkdir -p {PurePosixPath(place).parent} && lightdepth completion {shell} > {place}"
    call.result = {"shell": shell, "script": made}
    call.answer(made.rstrip("\n"))


def _all_verbs() -> argparse.ArgumentParser:
    """The whole command line in argparse's own words."""
    root = argparse.ArgumentParser(prog="lightdepth", add_help=False)
    for name, text in (("help", "Show the verbs."), ("version", "Show the version.")):
        root.add_argument(f"--{name}", action="store_true", help=text)
    verbs = root.add_subparsers(dest="verb")
    for verb, entry in all_verbs().items():
        of = parsers_of(verb, entry.load())
        made = verbs.add_parser(verb, help=_plain(summary_of(entry)), add_help=False)
        ways = made.add_subparsers(dest="way") if len(of) > 1 else None
        for way, parser in of.items():
            if way and ways is not None:
                _add_options(ways.add_parser(way, help=_plain(parser.description or ""), add_help=False), parser, verb)
            else:
                _add_options(made, parser, verb)
    return root


def _add_options(made: argparse.ArgumentParser, parser: Parser, verb: str) -> None:
    import shtab

    for action in options(parser):
        given: dict[str, Any] = {"help": _plain(action.help or "")}
        words = [dashed(word) for word in action.option_strings]
        if words and action.nargs == 0:
            given["action"] = "store_true"
        elif choices := list(_choices(action, verb)):
            given["choices"] = choices
        if action.dest == "help":
            words.append("--help-all")
        added = made.add_argument(*(words or [action.dest]), **given)
        kind = getattr(action, "_typehint", None)
        if added.choices is None and action.dest in _NAME_MODELS:
            with_weights = verb == "adapt" or action.dest in ("what", "model.start")
            added.complete = _files_and_models(with_weights)  # type: ignore[attr-defined]  # shtab's way
        elif added.choices is None and (Path in leaves(kind) or action.dest in _NAME_FILES):
            added.complete = shtab.FILE  # type: ignore[attr-defined]


def _files_and_models(with_weights: bool) -> dict[str, Any]:
    """What completes the name of a depth model, by shell: those that come with the program, of which some have no
    weights, and files."""
    import shtab

    from lightdepth.checkpoint import TRAINING_FREE, bundled

    names = " ".join([*bundled(), *(() if with_weights else TRAINING_FREE)])
    function = f"_lightdepth_files_and_{'networks' if with_weights else 'models'}"
    bash = f'{function}() {{\n  compgen -f -- "$1"\n  compgen -W \'{names}\' -- "$1"\n}}'
    zsh = f"{function}() {{\n  _alternative 'models:depth model:({names})' 'files:file:_files'\n}}"
    return {
        "bash": function,
        "zsh": function,
        "fish": f"{shtab.FILE['fish']} {names}",
        "preamble": {"bash": bash, "zsh": zsh},
    }


def _choices(action: argparse.Action, verb: str) -> Iterator[str]:
    """The words that an option takes, where there are only so many."""
    if action.dest == "preset":
        yield from presets(verb)
    for kind in choices_of_type(getattr(action, "_typehint", None)):
        yield from ("true", "false") if kind is bool else map(str, literals(kind))


def _plain(text: str) -> str:
    """The first sentence, without what a shell may take for a command."""
    first = re.split(r"(?<=[.;:])\s", " ".join(text.split()), maxsplit=1)[0].rstrip(".;:")
    return re.sub(r"[^\w .,;/()+-]", "", first)[:90]
