"""The words of a command line, brought into the form that jsonargparse has: dashes, switches, lists of one value."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_origin

import yaml
from jsonargparse import ArgumentParser

from lightdepth import plain_yaml
from lightdepth.command_line.kinds import choices_of_type


def options(parser: ArgumentParser) -> list[argparse.Action]:
    """What can be typed: options and positional arguments, without the heads of groups and the library's own helps."""
    found = []
    for action in parser._actions:
        # The library's --print_shtab does nothing but fail.
        aside = type(action).__name__ == "ActionLink" or "--print_shtab" in action.option_strings
        if not aside and not is_head(action) and not action.dest.endswith(".help"):
            found.append(action)
    return found


def is_head(action: argparse.Action) -> bool:
    """Whether it takes a file for all options of a group."""
    return type(action).__name__ == "_ActionConfigLoad"


def spelled(parser: ArgumentParser, argv: Sequence[str]) -> list[str]:
    """Words as jsonargparse wants them: --mm-per-unit is --mm_per_unit; of a switch, --frames is --frames=true and
    --no-frames is --frames=false; `--formats ply` is `--formats [ply]`."""
    known = parser._option_string_actions
    words = [underscored(word) for word in argv]
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


def underscored(word: str) -> str:
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
        read = plain_yaml.load(value)
    except yaml.YAMLError:
        read = value
    if isinstance(read, Mapping) or read is None:
        return value
    if isinstance(read, list):
        return json.dumps([read]) if nested and read and not isinstance(read[0], list) else value
    return json.dumps([read if of in (int, float) else value])


def as_list(value: Any, of: Any, nested: bool) -> Any:
    if isinstance(value, (list, tuple)):
        return [value] if nested and value and not isinstance(value[0], (list, tuple)) else value
    return [value] if isinstance(value, (str, int, float, Path)) else value
