"""What is wrong with the words of a command line, or with a file of settings, in one line."""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, get_origin

import yaml
from jsonargparse import ArgumentParser

from lightdepth.command_line.config_words import configs
from lightdepth.command_line.gone_settings import GONE_SETTINGS
from lightdepth.command_line.kinds import choices_of_type, expected, list_apart, literals
from lightdepth.command_line.pages import Page
from lightdepth.command_line.settings_yaml import read_settings
from lightdepth.command_line.words import dashed, options, underscored
from lightdepth.counting import full_stop
from lightdepth.errors import WrongUsage
from lightdepth.foreign_text import for_terminal
from lightdepth.regular import regular


def where_given(argv: Sequence[str], action: argparse.Action) -> str:
    """An option as it was given: on the command line, or in a file of settings."""
    name = f"--{dashed(action.dest)}" if action.option_strings else action.dest
    return name if _on_line(argv, action.dest) else f"{_file_with(argv, action.dest)}{name}"


def fail(parser: ArgumentParser, message: str) -> NoReturn:
    """Ends the program for wrong usage, with one line."""
    said = " ".join(message.split())
    print(for_terminal(f"{parser.prog}: error: {said}"), file=sys.stderr)
    found, sign, page = said.partition("Read on: ")
    raise WrongUsage(found.rstrip(" ."), sign + page)


def one_line(parser: ArgumentParser, page: Page, argv: Sequence[str], message: str) -> str:
    """What is wrong with the words of a command line: what was typed, the nearest that there is, where to read on."""
    name = ""
    if found := re.search(r"Importing '(.+?)' is not allowed", message):
        said = f"{found[1]}: settings take plain values, and name no code"
    elif found := re.search(r"unrecognized arguments: (\S+)", message):
        said, name = _unknown(parser, found[1])
    elif found := re.search(r"Option '(.+?)' is not accepted|Group '(.+?)' does not accept option '(.+?)'", message):
        key = found[1] or f"{found[2]}.{found[3]}"
        said, name = f"{_file_with(argv, key)}no setting {key}{_nearest(key, _names(parser))}", key
    elif found := re.search(r'Parser key "(.+?)":\s*(.*)', message, re.DOTALL):
        said, name = _wrong_value(parser, argv, found[1], found[2]), found[1]
    elif found := re.search(r"the following arguments are required: (.+)", message):
        said = f"missing: {', '.join(_typed(parser, dest) for dest in found[1].split(', '))}"
    elif found := re.search(r"argument (\S+?): expected one argument", message):
        said = f"{dashed(found[1].split('/')[0])} needs a value"
    elif found := re.search(r"Problems parsing config: (.*)", message, re.DOTALL):
        files = [path for path in config_files(argv) if _not_yaml(path)]
        said = f"{files[0] if files else '--config'}: not YAML: {' '.join(found[1].split())}"
    else:
        said = " ".join(message.split())
    everyday = not name or page.shows(name.lstrip("-").replace("-", "_"))
    shown = "--help" if everyday and "." not in name else "--help-all"
    return f"{full_stop(said)} Read on: {parser.prog} {shown}"


def _unknown(parser: ArgumentParser, word: str) -> tuple[str, str]:
    if not word.startswith("-"):
        return f"{word}: nothing takes this word; options begin with --", ""
    name = word.partition("=")[0]
    gone = GONE_SETTINGS.get(parser.prog.rpartition(" ")[2], {}).get(name.lstrip("-").replace("-", "_"))
    if gone is not None:
        return f"{dashed(name)} is no more ({gone}): leave it out", ""
    nearest = closest(name.lstrip("-").replace("-", "_"), _names(parser))
    return f"no option {dashed(name)}" + (f"; did you mean --{dashed(nearest)}?" if nearest else ""), nearest


def _names(parser: ArgumentParser) -> list[str]:
    long = [o[2:] for a in options(parser) for o in a.option_strings if o.startswith("--")]
    return long + [a.dest for a in options(parser) if not a.option_strings]


def closest(word: str, known: Sequence[str]) -> str:
    """The name most like a word, by all of it or by its last part (voxel is like fusion.voxel); "" where none is."""

    def likeness(name: str) -> float:
        last = name.rpartition(".")[2]
        return max(difflib.SequenceMatcher(None, word, n).ratio() - cost for n, cost in ((name, 0), (last, 0.05)))

    best = max(known, key=likeness, default="")
    return best if best and likeness(best) >= 0.6 else ""


def _nearest(word: str, known: Sequence[str]) -> str:
    close = closest(word, known)
    return f"; did you mean {close}?" if close else ""


def _typed(parser: ArgumentParser, dest: str) -> str:
    action = next((a for a in options(parser) if a.dest == dest), None)
    if action is None or not action.option_strings:
        return dest.upper()
    return f"{dashed(action.option_strings[0])} {dest.upper()}"


def _wrong_value(parser: ArgumentParser, argv: Sequence[str], key: str, message: str) -> str:
    action = next((a for a in options(parser) if a.dest == key), None)
    given = re.search(r"(?:Got value|Given value):(.*?)\s*$", message, re.DOTALL | re.MULTILINE)
    kind = getattr(action, "_typehint", None)
    where, value = _file_with(argv, key) if not _on_line(argv, key) else "", (given[1].strip() or "''") if given else ""
    named = f"{key}:" if where or action is None or not action.option_strings else f"--{dashed(key)}"
    if kind is None or not value:
        return f"{where}{named} {' '.join(message.split())}"
    choices = [c for one in choices_of_type(kind) for c in literals(one)]
    hint = _nearest(value, [str(c) for c in choices]) if choices else ""
    if action is not None and (apart := list_apart(argv, value)) and get_origin(next(choices_of_type(kind))) is tuple:
        hint = f"; give them as one word: {apart}"
    return f"{where}{named} {value}: expected {expected(kind)}{hint}"


def _on_line(argv: Sequence[str], key: str) -> bool:
    return any(underscored(word).partition("=")[0].startswith(f"--{key}") for word in argv)


def config_files(argv: Sequence[str]) -> Iterator[Path]:
    """The files that --config names among the words of a command line."""
    for path in configs(argv):
        if path and "\n" not in path and Path(path).is_file():  # settings may stand there themselves (gone_settings)
            yield Path(path)
        elif path and "\n" not in path:
            regular(path, "expected a YAML file of settings")


def check_config(parser: ArgumentParser, file: Path) -> None:
    """Ends the program where a file is no YAML of settings, or has a value in the place of a group of them."""
    more = f"Read on: {parser.prog} --help"
    if why := _not_yaml(file):
        fail(parser, f"{file}: not YAML: {why}; expected a line `option: value` for each setting, in UTF-8. {more}")
    found = read_settings(file)
    if not isinstance(found, Mapping):
        fail(parser, f"{file}: no settings in it; expected a line `option: value` for each. {more}")
    below = {action.dest.partition(".")[0]: action.dest for action in options(parser) if "." in action.dest}
    for key, value in found.items():
        if key in below and value is not None and not isinstance(value, Mapping | str):
            fail(parser, f"{file}: {key} is {value!r}; expected settings below it, such as {below[key]}. {more}")


def _not_yaml(path: Path) -> str:
    """Why a file is no YAML of settings; nothing where it is."""
    try:
        read_settings(path)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        return " ".join(str(error).split())[:200] or "no text"
    return ""


def _file_with(argv: Sequence[str], key: str) -> str:
    """`FILE: ` for the last file of settings on the command line that has the key, else nothing."""
    result = ""
    for path in config_files(argv):
        node: Any = None if _not_yaml(path) else read_settings(path)
        for part in key.split("."):
            node = node.get(part, _ABSENT) if isinstance(node, Mapping) else _ABSENT
        result = f"{path}: " if node is not _ABSENT else result
    return result


_ABSENT = object()
