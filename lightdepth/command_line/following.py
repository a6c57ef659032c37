"""Commands as a user types them, for what a verb says comes next.

Names of inputs are often those of patients. So a log, a pipe and the document of --json get words in their place, DATA
or MAP; a terminal, where the names were typed a moment ago, gets the names, and the command can be copied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

PLACES = "[[X, Y, Z], [X, Y, Z]]"
"""Places of a surface that nobody but the user knows."""


@dataclass(frozen=True)
class Input:
    """A file or folder that the verb has read, and the word that stands for it where no names are told."""

    word: str
    path: Path | None

    @property
    def name(self) -> str | None:
        return None if self.path is None else str(self.path)


@dataclass(frozen=True)
class Following:
    """A command."""

    anonymous: str
    named: str

    def said(self, to_terminal: bool) -> str:
        """As it is said there."""
        return self.named if to_terminal else self.anonymous


Value = Path | str | Input | None


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


def _value(value: Value, named: bool) -> list[str]:
    if isinstance(value, Input):
        if value.name is None:
            return []
        return [quote(value.name) if named else value.word]
    return [] if value is None else [quote(str(value))]
