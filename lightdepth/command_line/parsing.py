"""What the parser of a verb adds to jsonargparse: help on a page, mistakes in a line, one value in place of a list.

A parser knows its page (`pages.py`): `--help` shows the everyday options and the examples, `--help-all` every
option. Words of the command line are brought into jsonargparse's form first, because it derives options from signatures
without these: dashes for underscores (it has aliases only for options that are declared one by one), flags without a
value (ActionYesNo, likewise), and a single value where a list is wanted.
"""

from __future__ import annotations

import argparse
import difflib
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

import yaml
from jsonargparse import (
    ArgumentParser,
    DefaultHelpFormatter,
    Namespace,
    set_parsing_settings,
)

from lightdepth.command_line.gone_settings import GONE_SETTINGS
from lightdepth.command_line.kinds import METAVARS, choices_of_type, expected, leaves, literals, placeholder
from lightdepth.command_line.pages import Page
from lightdepth.command_line.settings_yaml import read_settings, use_words

HELP, HELP_ALL = ("-h", "--help"), ("--help-all", "--help_all")
_WIDTH = 100
_OPTION = re.compile(r"(?<![\w/.-])--[A-Za-z][\w.-]*")
_GENERAL = {
    "help": "Show the everyday options, with examples, and exit.",
    "config": "YAML file with any of these options; those on the command line win.",
    "print_shtab": "Print a script for the shell that completes the names of options, and exit.",
    "print_config": "Print all settings, those given before it among them, as YAML that --config reads, and exit. "
    "`=skip_null` leaves out those that are not set.",
}
_LAST = ("overwrite", "resume", "config", "print_config", "print_shtab", "help")
_GROUP = "YAML file with any of the options of this group."


class Formatter(DefaultHelpFormatter):
    """Help as wide as a terminal mostly is, whatever this one's width: so that it reads the same everywhere."""

    def __init__(self, prog: str, **settings: Any) -> None:
        super().__init__(prog, **{**settings, "width": _WIDTH, "max_help_position": 28})  # type: ignore[no-untyped-call]  # jsonargparse has no annotation for it

    def _get_help_string(self, action: argparse.Action) -> str:
        """The sentence, and in brackets what kind of value is taken, where its placeholder does not show it."""
        kind, notes = getattr(action, "_typehint", None), ["required"] if action.required else []
        if any(one in (int, float) for one in choices_of_type(kind)) or not METAVARS.keys() >= leaves(kind):
            notes.append(expected(kind))
        if action.default not in (None, argparse.SUPPRESS, ()) and action.nargs != 0:
            shown = (
                action.default if isinstance(action.default, (str, Path)) else json.dumps(action.default, default=str)
            )
            notes.append(f"default {shown}")
        return f"{action.help} ({'; '.join(notes)})" if notes else action.help or ""

    def _get_default_metavar_for_optional(self, action: argparse.Action) -> str:
        kinds = list(choices_of_type(getattr(action, "_typehint", None)))
        if len(kinds) > 1 and get_origin(kinds[0]) is Literal:
            return "VALUE"
        return placeholder(kinds[0]) if kinds else action.dest.upper()


class Parser(ArgumentParser):
    """The options of one verb."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        set_parsing_settings(docstring_parse_attribute_docstrings=True)
        use_words()
        super().__init__(*arguments, **{"formatter_class": Formatter, **settings})
        self.page = Page()

    def help_page(self, everything: bool) -> str:
        """The help with the everyday options, or with all."""
        shown = [a for a in options(self) if everything or self.page.shows(a.dest)]
        rest = len(options(self)) - len(shown)
        self.usage = self._short_usage()
        self.epilog = f"{self.prog} --help-all shows {rest} more option{'s' * (rest > 1)}." if rest else None
        kept = {id(action) for action in shown}
        hidden = [a for a in self._actions if id(a) not in kept and not (everything and _is_head(a))]
        helps = [action.help for action in hidden]
        titles = [(group, group.title, group.description) for group in self._action_groups]
        try:
            for action in hidden:
                action.help = argparse.SUPPRESS
            for group, _, _ in titles:
                if all(action.help == argparse.SUPPRESS for action in group._group_actions):
                    group.title = group.description = None
            page = self.format_help()
        finally:
            for action, text in zip(hidden, helps, strict=True):
                action.help = text
            for group, title, description in titles:
                group.title, group.description = title, description
        head, gap, tail = page.partition("\n\n")
        summary, _, tail = tail.partition("\n\n")
        examples = "".join(f"\n  {example}" for example in self.page.examples)
        page = f"{head}{gap}{summary}\n\nexamples:{examples}\n\n{tail}" if examples else page
        page = _OPTION.sub(lambda found: dashed(found[0]), page)
        return re.sub(self._names_in_prose(), lambda found: dashed(found[0]), page)

    def _names_in_prose(self) -> str:
        """A pattern of options as sentences name them, by all of the name or by its last part; no choice is meant."""
        names = {name for a in options(self) for name in (a.dest, a.dest.rpartition(".")[2]) if "_" in name}
        kinds = (k for a in options(self) for k in choices_of_type(getattr(a, "_typehint", None)))
        chosen = {str(choice) for kind in kinds for choice in literals(kind)}
        longest_first = sorted(names - chosen, key=lambda name: (-len(name), name))
        return rf"(?<![\w/.{{-])(?:{'|'.join(map(re.escape, longest_first)) or '(?!)'})(?![\w/]|\.\w)"

    def _short_usage(self) -> str:
        words = [a.dest.upper() for a in self._actions if not a.option_strings and a.help != argparse.SUPPRESS]
        needed = [a for a in options(self) if a.option_strings and a.required]
        words += [f"{a.option_strings[0]} {a.dest.upper()}" for a in needed]
        return " ".join([self.prog, *words, "[options]"])

    def _check_value_key(self, action: argparse.Action, value: Any, key: str, *rest: Any, **more: Any) -> Any:
        """In a file, too, one value will do where a list is wanted."""
        wanted = listed(action)
        if wanted and value is not None and (not isinstance(value, str) or not value.lstrip().startswith("[")):
            value = _as_list(value, *wanted)
        return super()._check_value_key(action, value, key, *rest, **more)


def options(parser: ArgumentParser) -> list[argparse.Action]:
    """What can be typed: options and positional arguments, without the heads of groups and the library's own helps."""
    found = []
    for action in parser._actions:
        linked = type(action).__name__ == "ActionLink"
        if not linked and not _is_head(action) and not action.dest.endswith(".help"):
            found.append(action)
    return found


def _is_head(action: argparse.Action) -> bool:
    """Whether it takes a file for all options of a group."""
    return type(action).__name__ == "_ActionConfigLoad"


def finish(parser: Parser, page: Page) -> None:
    """Gives a parser that has all its options its page, and what the library says of its own options in our words."""
    parser.page = page
    plain = [a for a in options(parser) if "." not in a.dest]
    order = sorted(plain, key=lambda a: (bool(a.option_strings), a.dest != "output", a.dest in _LAST))
    for group in parser._action_groups:
        group._group_actions = [a for a in group._group_actions if a not in plain]
    parser._optionals._group_actions = order
    for action in parser._actions:
        if _is_head(action):
            action.help = _GROUP
        kind = next(choices_of_type(getattr(action, "_typehint", None)), None)
        if action.option_strings and get_origin(kind) in (list, tuple):
            action.metavar = placeholder(kind)
        for name, text in _GENERAL.items():
            if f"--{name}" in action.option_strings:
                action.help = text


def parsed(parser: Parser, argv: Sequence[str]) -> Namespace:
    """The settings that the words of a command line give. Help and mistakes end the program, as argparse's do."""
    for word in argv:
        if word in HELP or word in HELP_ALL:
            print(parser.help_page(word in HELP_ALL), end="")
            raise SystemExit(0)
    parser.exit_on_error = False
    for file in config_files(argv):
        _check_config(parser, file)
    try:
        return parser.parse_args(spelled(parser, argv))
    except argparse.ArgumentError as error:
        fail(parser, one_line(parser, argv, str(error)))


def fail(parser: Parser, message: str) -> NoReturn:
    """Ends the program for wrong usage, with one line."""
    print(f"{parser.prog}: error: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)


# ---- words


def spelled(parser: ArgumentParser, argv: Sequence[str]) -> list[str]:
    """Words as jsonargparse wants them: --mm-per-unit is --mm_per_unit; of a switch, --frames is --frames=true and
    --no-frames is --frames=false; `--formats ply` is `--formats [ply]`."""
    known = parser._option_string_actions
    words = [_underscored(word) for word in argv]
    switches = {a.dest for a in parser._actions if getattr(a, "_typehint", None) is bool}
    result: list[str] = []
    wanted: tuple[Any, bool] | None = None
    for word, following in pairwise([*words, ""]):
        if not word.startswith("--"):
            result.append(_list_text(word, *wanted) if wanted else word)
            wanted = None
            continue
        name, sign, value = word[2:].partition("=")
        action = known.get(f"--{name}")
        group, _, last = name.rpartition(".")
        positive = f"{group}.{last.removeprefix('no_')}" if group else last.removeprefix("no_")
        wanted = listed(action) if action is not None else None
        if name in switches and not sign and following not in ("true", "false"):
            word = f"--{name}=true"
        elif action is None and not sign and last.startswith("no_") and positive in switches:
            word = f"--{positive}=false"
        elif sign and wanted:
            word, wanted = f"--{name}={_list_text(value, *wanted)}", None
        elif sign:
            wanted = None
        result.append(word)
    return result


def dashed(name: str) -> str:
    """An option as it is shown; it can be typed either way."""
    return name.replace("_", "-")


def _underscored(word: str) -> str:
    if not word.startswith("--"):
        return word
    name, sign, value = word[2:].partition("=")
    return f"--{name.replace('-', '_')}{sign}{value}"


def listed(action: argparse.Action) -> tuple[Any, bool] | None:
    """Of an option that takes any number of values: their type, and whether each of them is a list in turn."""
    kinds = list(choices_of_type(getattr(action, "_typehint", None)))
    if len(kinds) != 1:  # a single value may be one of the others
        return None
    arguments = get_args(kinds[0])
    many = get_origin(kinds[0]) is list or (get_origin(kinds[0]) is tuple and arguments[1:] == (...,))
    return (arguments[0], get_origin(arguments[0]) in (list, tuple)) if many and arguments else None


def _list_text(value: str, of: Any, nested: bool) -> str:
    try:
        read = yaml.safe_load(value)
    except yaml.YAMLError:
        read = value
    if isinstance(read, Mapping) or read is None:
        return value
    if isinstance(read, list):
        return json.dumps([read]) if nested and read and not isinstance(read[0], list) else value
    return json.dumps([read if of in (int, float) else value])


def _as_list(value: Any, of: Any, nested: bool) -> Any:
    if isinstance(value, (list, tuple)):
        return [value] if nested and value and not isinstance(value[0], (list, tuple)) else value
    return [value] if isinstance(value, (str, int, float, Path)) else value


# ---- mistakes


def one_line(parser: Parser, argv: Sequence[str], message: str) -> str:
    """What is wrong with the words of a command line: what was typed, the nearest that there is, where to read on."""
    name = ""
    if found := re.search(r"unrecognized arguments: (\S+)", message):
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
        files = [path for path in config_files(argv) if not _is_yaml(path)]
        said = f"{files[0] if files else '--config'}: not YAML: {' '.join(found[1].split())}"
    else:
        said = " ".join(message.split())
    everyday = not name or parser.page.shows(name.lstrip("-").replace("-", "_"))
    stop = "" if said.endswith("?") else "."
    return f"{said}{stop} Read on: {parser.prog} {'--help' if everyday and '.' not in name else '--help-all'}"


def _unknown(parser: Parser, word: str) -> tuple[str, str]:
    if not word.startswith("-"):
        return f"{word}: nothing takes this word; options begin with --", ""
    name = word.partition("=")[0]
    gone = GONE_SETTINGS.get(parser.prog.rpartition(" ")[2], {}).get(name.lstrip("-").replace("-", "_"))
    if gone is not None:
        return f"{dashed(name)} is no more ({gone}): leave it out", ""
    nearest = closest(name.lstrip("-").replace("-", "_"), _names(parser))
    return f"no option {dashed(name)}" + (f"; did you mean --{dashed(nearest)}?" if nearest else ""), nearest


def _names(parser: Parser) -> list[str]:
    return [o[2:] for a in options(parser) for o in a.option_strings if o.startswith("--")] + [
        a.dest for a in options(parser) if not a.option_strings
    ]


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


def _typed(parser: Parser, dest: str) -> str:
    action = next((a for a in options(parser) if a.dest == dest), None)
    if action is None or not action.option_strings:
        return dest.upper()
    return f"{dashed(action.option_strings[0])} {dest.upper()}"


def _wrong_value(parser: Parser, argv: Sequence[str], key: str, message: str) -> str:
    action = next((a for a in options(parser) if a.dest == key), None)
    given = re.search(r"(?:Got value|Given value): (.*?)\s*$", message, re.DOTALL | re.MULTILINE)
    kind = getattr(action, "_typehint", None)
    where, value = _file_with(argv, key) if not _on_line(argv, key) else "", given[1].strip() if given else ""
    named = f"{key}:" if where or action is None or not action.option_strings else f"--{dashed(key)}"
    if kind is None or not value:
        return f"{where}{named} {' '.join(message.split())}"
    choices = [c for one in choices_of_type(kind) for c in literals(one)]
    hint = _nearest(value, [str(c) for c in choices]) if choices else ""
    return f"{where}{named} {value}: expected {expected(kind)}{hint}"


def _on_line(argv: Sequence[str], key: str) -> bool:
    return any(_underscored(word).partition("=")[0].startswith(f"--{key}") for word in argv)


def config_files(argv: Sequence[str]) -> Iterator[Path]:
    """The files that --config names among the words of a command line."""
    for word, following in pairwise([*argv, ""]):
        path = following if word == "--config" else word.removeprefix("--config=") if word[:9] == "--config=" else ""
        if path and "\n" not in path and Path(path).is_file():  # settings may stand there themselves (gone_settings)
            yield Path(path)


def _check_config(parser: Parser, file: Path) -> None:
    """Ends the program where a file is no YAML of settings, or has a value in the place of a group of them."""
    more = f"Read on: {parser.prog} --help"
    if not _is_yaml(file):
        fail(parser, f"{file}: not YAML: expected a line `option: value` for each setting, in UTF-8. {more}")
    found = read_settings(file)
    if not isinstance(found, Mapping):
        fail(parser, f"{file}: no settings in it; expected a line `option: value` for each. {more}")
    below = {action.dest.partition(".")[0]: action.dest for action in options(parser) if "." in action.dest}
    for key, value in found.items():
        if key in below and value is not None and not isinstance(value, Mapping | str):
            fail(parser, f"{file}: {key} is {value!r}; expected settings below it, such as {below[key]}. {more}")


def _is_yaml(path: Path) -> bool:
    try:
        read_settings(path)
    except (yaml.YAMLError, UnicodeDecodeError):
        return False
    return True


def _file_with(argv: Sequence[str], key: str) -> str:
    """`FILE: ` for the last file of settings on the command line that has the key, else nothing."""
    result = ""
    for path in config_files(argv):
        node: Any = read_settings(path) if _is_yaml(path) else None
        for part in key.split("."):
            node = node.get(part, _ABSENT) if isinstance(node, Mapping) else _ABSENT
        result = f"{path}: " if node is not _ABSENT else result
    return result


_ABSENT = object()
