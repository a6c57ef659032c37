"""What the parser of a verb adds to jsonargparse: help on a page, mistakes in a line, one value in place of a list.

A parser knows its page (`pages.py`): `--help` shows the everyday options and the examples, `--help-all` every
option. Words of the command line are brought into jsonargparse's form first, because it derives options from signatures
without these: dashes for underscores (it has aliases only for options that are declared one by one), flags without a
value (ActionYesNo, likewise), and a single value where a list is wanted.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_origin

from jsonargparse import ArgumentParser, DefaultHelpFormatter, Namespace, set_parsing_settings

from lightdepth.command_line.kinds import METAVARS, choices_of_type, leaves, literals, placeholder
from lightdepth.command_line.mistakes import check_config, config_files, fail, one_line, where_given
from lightdepth.command_line.outcome import SAID_OF
from lightdepth.command_line.pages import Page
from lightdepth.command_line.ranges import check_ranges, range_in, set_ranges, taken
from lightdepth.command_line.settings_yaml import take_plain_values, use_words
from lightdepth.command_line.words import as_list, dashed, is_head, listed, options, spelled
from lightdepth.counting import counted
from lightdepth.ranges import Range

HELP, HELP_ALL = ("-h", "--help"), ("--help-all", "--help_all")
_WIDTH = 100
_OPTION = re.compile(r"(?<![\w/.-])--[A-Za-z][\w.-]*")
_GENERAL = {
    "help": "Show the everyday options, with examples, and exit.",
    "config": "YAML file with any of these options; those on the command line win.",
    "print_config": "Print all settings, with those given before this option, as YAML that --config reads, and exit. "
    "`=skip_null` leaves out those that are not set.",
}
_LAST = ("overwrite", "resume", "dry_run", "quiet", "json", "config", "print_config", "help")
_GROUP = "YAML file with any of the options of this group."


class Formatter(DefaultHelpFormatter):
    """Help as wide as a terminal mostly is, whatever this one's width: so that it reads the same everywhere."""

    def __init__(self, prog: str, **settings: Any) -> None:
        super().__init__(prog, **{**settings, "width": _WIDTH, "max_help_position": 28})  # type: ignore[no-untyped-call]  # jsonargparse has no annotation for it

    def _get_help_string(self, action: argparse.Action) -> str:
        """The sentence, and in brackets what kind of value is taken, where its placeholder does not show it."""
        kind, notes = getattr(action, "_typehint", None), ["required"] if action.required else []
        within = range_in(action)
        if any(one in (int, float) for one in choices_of_type(kind)) or not METAVARS.keys() >= leaves(kind) or within:
            notes.append(taken(kind, within))
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
        take_plain_values()
        super().__init__(*arguments, **{"formatter_class": Formatter, **settings})
        self.page = Page()

    def help_page(self, everything: bool) -> str:
        """The help with the everyday options, or with all."""
        shown = [a for a in options(self) if everything or self.page.shows(a.dest)]
        rest = len(options(self)) - len(shown)
        self.usage = self._short_usage()
        self.epilog = f"{self.prog} --help-all shows {counted(rest, 'more option')}." if rest else None
        kept = {id(action) for action in shown}
        hidden = [a for a in self._actions if id(a) not in kept and not (everything and is_head(a))]
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
        return self.with_dashes(page)

    def with_dashes(self, text: str) -> str:
        """A text in which options are named as they are typed."""
        text = _OPTION.sub(lambda found: dashed(found[0]), text)
        return re.sub(self._names_in_prose(), lambda found: dashed(found[0]), text)

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
            value = as_list(value, *wanted)
        return super()._check_value_key(action, value, key, *rest, **more)


class _InFull(argparse.Action):
    """A word that is taken before the options are read: what comes here is the beginning of it, which is not."""

    def __init__(self, option_strings: list[str], dest: str, **given: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, default=False, help=given.get("help"))

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        raise argparse.ArgumentError(self, "has to be written in full")


def finish(parser: Parser, page: Page, ranges: Mapping[str, Range]) -> None:
    """Gives a parser that has all its options its page and their ranges, and the library's own options our words."""
    parser.page = page
    for name, text in SAID_OF.items():  # taken before options are read (outcome.manners); here for help and mistakes
        parser.add_argument(f"--{name}", action=_InFull, help=text)
    set_ranges(parser._actions, ranges)
    plain = [a for a in options(parser) if "." not in a.dest]
    order = sorted(plain, key=lambda a: (bool(a.option_strings), a.dest != "output", a.dest in _LAST))
    for group in parser._action_groups:
        group._group_actions = [a for a in group._group_actions if a not in plain]
    parser._optionals._group_actions = order
    for action in parser._actions:
        if is_head(action):
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
        check_config(parser, file)
    try:
        found = parser.parse_args(spelled(parser, argv))
    except (argparse.ArgumentError, ImportError) as error:
        fail(parser, one_line(parser, parser.page, argv, str(error)))
    check_ranges(options(parser), found.get, lambda action: where_given(argv, action))
    return found
