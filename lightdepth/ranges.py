"""Which numbers a setting takes: said where it is declared, shown in its help, checked before any work.

    voxel: Annotated[float | None, above(0)] = None

The parser of a verb checks its options (`lightdepth.command_line.ranges`); `checked`, under `@dataclass`, checks
settings that are made in a program. A range holds for each number of a list; NaN and infinity are in none.
"""

from __future__ import annotations

import reprlib
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from lightdepth.errors import InputError

LARGEST = 1e9
"""What no number goes beyond where nothing else is said: far from what is meant, and near enough to compute with."""
_Settings = TypeVar("_Settings")


@dataclass(frozen=True)
class Range:
    """The numbers from low to high."""

    low: float = -LARGEST
    high: float = LARGEST
    above: bool = False
    """Whether low itself is out."""
    below: bool = False
    """Whether high itself is out."""
    ends: bool = False
    """Whether two numbers are the ends of a range that is drawn from, the lower first."""

    def __contains__(self, number: float) -> bool:
        over = self.low < number if self.above else self.low <= number
        return over and (number < self.high if self.below else number <= self.high)

    @property
    def words(self) -> str:
        """What follows "a number" in help; "" where no more than its size is bounded."""
        low, high = _short(self.low), _short(self.high)
        least = "" if self.low == -LARGEST else f"above {low}" if self.above else f"of at least {low}"
        most = "" if self.high == LARGEST else f"below {high}" if self.below else f"up to {high}"
        if least and most:
            return f"{least} and {most}" if self.above or self.below else f"from {low} to {high}"
        return least or most

    def wrong(self, value: object) -> str:
        """What in a value is outside, and what was expected in its place; "" where all is within."""
        found = list(numbers(value))
        for number in found:
            if number not in self:
                unsaid = number > self.high == LARGEST or number < self.low == -LARGEST or not self.words
                words = [self.words] * bool(self.words) + [f"of a size up to {_short(LARGEST)}"] * unsaid
                return f"expected {'each number' if len(found) > 1 else 'a number'} {' and '.join(words)}"
        if self.ends and len(found) == 2 and found[0] > found[1]:
            return "expected the lower end first"
        return ""


def above(low: float, up_to: float = LARGEST, below: float | None = None) -> Range:
    """More than low."""
    return Range(low, up_to if below is None else below, above=True, below=below is not None)


def at_least(low: float, up_to: float = LARGEST, below: float | None = None) -> Range:
    """Low and more."""
    return Range(low, up_to if below is None else below, below=below is not None)


def ends_of(within: Range) -> Range:
    """Two numbers within a range, the lower first."""
    return replace(within, ends=True)


ANY = Range()
SHARE = Range(0, 1)
BELOW_ONE = at_least(0, below=1)
BETWEEN = above(0, below=1)
COUNT = at_least(1, up_to=1_000_000)
SEED = at_least(0)
PIXELS = at_least(1, up_to=100_000)
"""Of a width or a height."""


def numbers(value: object, depth: int = 3) -> Iterator[float]:
    """All numbers of a value, in lists up to `depth` deep; of anything else, none. A stranger's lists, which hold one
    another again and again, are not gone through: they are no settings, and are refused for what they are."""
    if isinstance(value, bool):
        return
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, list | tuple):
        for one in value if depth else ():
            yield from numbers(one, depth - 1)


def range_of(kind: Any) -> Range | None:
    """The range that a type is annotated with, anywhere in it."""
    if get_origin(kind) is Annotated:
        said = [one for one in kind.__metadata__ if isinstance(one, Range)]
        return said[0] if said else range_of(get_args(kind)[0])
    return next((found for part in get_args(kind) if (found := range_of(part)) is not None), None)


def ranges_of(settings: type) -> Mapping[str, Range]:
    """The ranges of the fields of settings (a dataclass), by name."""
    hints = get_type_hints(settings, include_extras=True)
    found = {field.name: range_of(hints[field.name]) for field in fields(settings)}
    return {name: one for name, one in found.items() if one is not None}


def checked(settings: type[_Settings]) -> type[_Settings]:
    """A decorator under `@dataclass`: making one raises InputError where a field is out of its range."""
    known: dict[type, Mapping[str, Range]] = {}  # found late: types may be named before they are made
    own: Callable[..., None] | None = getattr(settings, "__post_init__", None)

    def check(self: Any, *initial: Any) -> None:
        made = type(self)
        if made not in known:
            known[made] = ranges_of(made)
        for name, one in known[made].items():
            value = getattr(self, name)
            if wrong := one.wrong(value):
                raise InputError(f"{made.__name__}.{name}", reprlib.repr(value), wrong)
        if own is not None:
            own(self, *initial)

    typing.cast(Any, settings).__post_init__ = check
    return settings


def _short(number: float) -> str:
    return f"{number:g}" if abs(number) >= 1e7 or number != int(number) else f"{int(number)}"
