"""What an ablation trains and what it judges on: rows that differ in one thing, and colons that none of them saw."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from lightdepth.ranges import COUNT, SEED, checked

_Plain = bool | int | float | str | None
Settings = dict[str, _Plain | list[_Plain | list[_Plain]] | dict[str, _Plain | list[_Plain]]]
"""Dotted options of `train` and their values, as a YAML gives them; the parser of `train` checks them."""


@dataclass(frozen=True)
@checked
class Row:
    """One training."""

    name: str
    """Name of the row in the table."""
    change: str = ""
    """What the row does differently, in a few words."""
    part: Literal["dropped", "instead", "reference"] = "dropped"
    """What the row does with its ingredient: it is "dropped", something else is "instead" of it, or the row is a
    "reference"."""
    settings: Settings | None = None
    """Dotted options of `train` and their values, such as model.loss.smoothness."""
    preset: Path | None = None
    """Training preset whose model takes the place of the base's, before the settings."""
    told: tuple[Literal["true", "wrong", "estimated"], ...] = ("true",)
    """What a network that has the wall's reflectance as an input is told of it when it is judged: the "true" value, a
    "wrong" one (0.3 more), or one "estimated" per colon without truth (least loss). Each makes one line of the
    table."""
    seeds: Annotated[tuple[int, ...] | None, SEED] = None
    """Seeds of the row's own trainings, numbers; left out, those of the ablation. More make the row more certain and
    take longer."""
    curve: bool = False
    """Whether the row's validation loss is drawn."""

    @property
    def file(self) -> str:
        return re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_")


@dataclass(frozen=True)
@checked
class JudgedColons:
    """Colons to judge on, with the lenses and the light's ranges of the training colons."""

    name: str
    """Name of these colons in the table."""
    make: Literal["plain", "realistic", "variant"]
    """Kind of colons: plain, realistic, or variant, of another make than any that is trained on
    (lightdepth.tube.variant)."""
    strength: Literal["weak", "strong"]
    """Strength of the light from wall to wall: weak or strong."""
    first: Annotated[int, SEED]
    """Number that seeds the first colon; the others count on from it. Another one draws other colons."""
    count: Annotated[int, COUNT]
    """Number of colons to judge on. More judge more surely and take longer."""
    frames: Annotated[int, COUNT] = 2
    """Number of frames of each colon. More judge more surely and take longer."""

    @property
    def seeds(self) -> range:
        return range(self.first, self.first + self.count)
