"""Commands as a user types them, for what a verb says comes next.

Names of inputs are often those of patients. So a log, a pipe and the document of --json get words in their place, DATA
or MAP; a terminal, where the names were typed a moment ago, gets the names, and the command can be copied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from shlex import quote
from typing import Any, TextIO

from lightdepth.foreign_text import for_line

PLACES = "[[X, Y, Z], [X, Y, Z]]"
"""Places of a surface that nobody but the user knows."""


@dataclass(frozen=True)
class Input:
    """A file or folder that the verb has read, and the word that stands for it where no names are told."""

    word: str
    path: Path | str | None

    @property
    def name(self) -> str | None:
        return None if self.path is None else str(self.path)


@dataclass(frozen=True)
class Following:
    """A command."""

    anonymous: str
    named: str

    def said(self, to: TextIO) -> str:
        """As it is said there: with its names on a terminal, unless one of them cannot be shown as it is."""
        return self.named if on_terminal(to) and for_line(self.named) == self.named else self.anonymous


Value = Path | str | Input | None


def on_terminal(stream: TextIO) -> bool:
    """Whether somebody sits before it, and it is no log, pipe or file."""
    return stream.isatty()


def command(verb: str, *places: Value, options: Mapping[str, Value] | None = None) -> Following:
    """`lightdepth VERB PLACE … OPTION VALUE …`, quoted for a shell, without those that are None."""
    ways = []
    for named in (False, True):
        words = ["lightdepth", verb]
        for place in places:
            words += _value(place, named)
        for option, value in (options or {}).items():
            if shown := _value(value, named):
                words += [option, *shown]
        ways.append(" ".join(words))
    return Following(*ways)


def given(settings: Any) -> dict[str, Value]:
    """The options of a frozen dataclass that are not as they are when left out."""
    said: dict[str, Value] = {}
    for each in fields(settings):
        value = getattr(settings, each.name)
        usual = each.default_factory() if each.default_factory is not MISSING else each.default
        if value != usual:
            said[f"--{each.name.replace('_', '-')}"] = str(value).lower() if isinstance(value, bool) else str(value)
    return said


def _value(value: Value, named: bool) -> list[str]:
    if isinstance(value, Input):
        if value.name is None:
            return []
        return [quote(_no_option(value.name)) if named else value.word]
    return [] if value is None else [quote(_no_option(str(value)))]


def _no_option(word: str) -> str:
    """A name that begins with a dash would be taken for an option."""
    return f"./{word}" if word.startswith("-") and not word[1:2].isdigit() else word
