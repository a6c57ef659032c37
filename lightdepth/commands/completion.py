"""The verb completion: a script with which a shell completes verbs, options, their choices, and files.

The script is static: it is made from the parsers of all verbs, once, so that a TAB starts no Python.
"""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal

from lightdepth.checkpoint import TRAINING_FREE, bundled
from lightdepth.command_line.kinds import choices_of_type, leaves, literals
from lightdepth.command_line.outcome import outcome
from lightdepth.command_line.presets import presets
from lightdepth.command_line.verbs import all_verbs, parsers_of, summary_of
from lightdepth.command_line.words import dashed, options

if TYPE_CHECKING:
    from lightdepth.command_line.parsing import Parser

_NAME_FILES = ("config", "output", "light", "poses", "data.sequences")
"""Options of type text that name a file, or may."""
_FUNCTIONS = {
    "bash": """{name}() {{
  compgen -f -- "$1"
  compgen -W "{models}" -- "$1"
}}""",
    "zsh": """{name}() {{
  _alternative 'names:checkpoint:({models})' 'files:file:_files'
}}""",
}
"""A function that completes the name of a checkpoint or a file. With `file` in its name, bash escapes what it gives."""
_FISH_FILES = "(__fish_complete_path (commandline -ct))"
_NAME_MODELS = ("checkpoint", "checkpoints")
"""Options of type text that name a checkpoint, or a model that needs none."""
_NAME_NETWORKS = (("export", "what"), ("adapt", "checkpoint"), ("train", "model.start"))
"""Verb and option where it must have weights."""
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

    function = _FUNCTIONS.get(shell, "")
    preamble = "\n".join(function.format(name=_name(w), models=" ".join(_models(w))) for w in (False, True))
    script = shtab.complete(_all_verbs(), shell, preamble=preamble)
    script = _with_any_file(script, shell)
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


def _models(with_weights: bool) -> list[str]:
    """The names that an option takes beside the path of a checkpoint."""
    return [*bundled(), *(() if with_weights else TRAINING_FREE)]


def _name(with_weights: bool) -> str:
    return f"_lightdepth_{'network' if with_weights else 'model'}_or_file"


def _model_or_file(with_weights: bool) -> dict[str, str]:
    """Completes the name of a checkpoint, or a file, in the words of each shell."""
    name = _name(with_weights)
    return {"bash": name, "zsh": name, "fish": f"{' '.join(_models(with_weights))} {_FISH_FILES}"}


def _with_any_file(script: str, shell: str) -> str:
    """The script, which also completes files with a blank in their names and, in fish, those below `~`.

    shtab's own completes neither: its bash splits the word at the blank, and its fish takes the word as it was typed.
    """
    if shell == "bash":
        return script.replace("compgen -f -- $1 ", 'compgen -f -- "$1" ')
    if shell == "fish":
        script = re.sub(rf'-xka "(.+ ){re.escape(_FISH_FILES)}"', r'-rFka "\1"', script)
        return script.replace(f'-xka "{_FISH_FILES}"', "-rF").replace(f'-ka "{_FISH_FILES}"', "-F")
    return script


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
            made.add_argument("--help-all", action="store_true", help="Show all options, with examples, and exit")
        added = made.add_argument(*(words or [action.dest]), **given)
        kind = getattr(action, "_typehint", None)
        with_weights = (verb, action.dest) in _NAME_NETWORKS
        if with_weights or action.dest in _NAME_MODELS:
            added.complete = _model_or_file(with_weights)  # type: ignore[attr-defined]  # shtab's way
        elif added.choices is None and (Path in leaves(kind) or action.dest in _NAME_FILES):
            added.complete = shtab.FILE  # type: ignore[attr-defined]  # shtab's way


def _choices(action: argparse.Action, verb: str) -> Iterator[str]:
    """The words that an option takes, where there are only so many."""
    if action.dest == "preset":
        yield from presets(verb)
    for kind in choices_of_type(getattr(action, "_typehint", None)):
        yield from ("true", "false") if kind is bool else map(str, literals(kind))


def _plain(text: str) -> str:
    """The first sentence, without what a shell may take for a command; a long one ends with a whole word."""
    first = re.split(r"(?<=[.;:])\s", " ".join(text.split()), maxsplit=1)[0].rstrip(".;:")
    return textwrap.shorten(re.sub(r"[^\w .,;/()+-]", "", first), 90, placeholder=" ...")
