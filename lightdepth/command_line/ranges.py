"""Ranges of the options of a verb: found where its parameters are declared, held against what is typed."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping
from dataclasses import is_dataclass
from typing import Any, get_origin, get_type_hints

from lightdepth.command_line.kinds import choices_of_type, expected
from lightdepth.command_line.options import groups_of
from lightdepth.errors import InputError
from lightdepth.ranges import Range, range_of


def ranges_in(function: Callable[..., Any]) -> dict[str, Range]:
    """The ranges of the options that a function's parameters become, or a class's, by dotted name."""
    plain = isinstance(function, type) and not is_dataclass(function)
    groups = groups_of(function)
    found: dict[str, Range] = {}
    for name, hint in get_type_hints(function.__init__ if plain else function, include_extras=True).items():
        own = range_of(hint)
        if own is not None:
            found[name] = own
        elif name in groups:
            found |= ranges_in(groups[name])
        elif is_dataclass(hint):
            found |= below(name, ranges_in(hint))  # type: ignore[arg-type]  # a class
    return found


def below(group: str, ranges: Mapping[str, Range]) -> dict[str, Range]:
    """Ranges of the options of a group."""
    return {f"{group}.{name}": one for name, one in ranges.items()}


def set_ranges(actions: Iterable[argparse.Action], ranges: Mapping[str, Range]) -> None:
    """Gives each option its range."""
    for action in actions:
        if action.dest in ranges:
            action.numbers = ranges[action.dest]  # type: ignore[attr-defined]


def range_in(action: argparse.Action) -> Range | None:
    """The range of an option, where it is one of numbers."""
    found: Range | None = getattr(action, "numbers", None)
    return found


def taken(kind: Any, within: Range | None) -> str:
    """What kind of value is taken, in words, and of numbers, which."""
    if within is None or not within.words:
        return expected(kind)
    many = any(get_origin(one) in (list, tuple) for one in choices_of_type(kind))
    return f"{expected(kind)}{', each' * many} {within.words}"


def check_ranges(
    actions: Iterable[argparse.Action], given: Callable[[str], Any], named: Callable[[argparse.Action], str]
) -> None:
    """Raises InputError where a value is out of its option's range; `given` has an option's value, `named` says
    what it is called."""
    for action in actions:
        found, value = range_in(action), given(action.dest)
        if found is not None and (wrong := found.wrong(value)):
            shown = list(value) if isinstance(value, tuple) else value
            raise InputError(named(action), f"{shown}", wrong)
