"""What an ablation trains and what it judges on: rows that differ in one thing, and colons that none of them saw."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from lightdepth.errors import InputError

Settings = dict[str, Any]
"""Dotted options of `train` and their values, as a YAML gives them; the parser of `train` checks them."""


@dataclass(frozen=True)
class Row:
    """One training.

    Args:
        name: in the table.
        change: what it does differently, in a few words.
        part: the ingredient is "dropped", something else is "instead" of it, or the row is a "reference".
        settings: dotted options of `train` and their values, such as model.loss.smoothness.
        preset: training preset whose model takes the place of the base's, before the settings.
        told: of the wall's reflectance at judging, for networks that have it as an input: the "true" one, a "wrong" one
            (0.3 more), or one "estimated" per colon without truth (least loss). One line of the table each.
        seeds: its own; left out, those of the ablation.
        curve: show its validation loss.
    """

    name: str
    change: str = ""
    part: Literal["dropped", "instead", "reference"] = "dropped"
    settings: Settings | None = None
    preset: Path | None = None
    told: tuple[Literal["true", "wrong", "estimated"], ...] = ("true",)
    seeds: tuple[int, ...] | None = None
    curve: bool = False

    @property
    def file(self) -> str:
        return re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_")


@dataclass(frozen=True)
class JudgedColons:
    """Colons to judge on, with the lenses and the light's ranges of the training colons.

    Args:
        name: in the table.
        make: plain, realistic, or variant: of another make than any that is trained on (lightdepth.tube.variant).
        strength: of the light from wall to wall: weak or strong.
        first: seed of the first colon.
        count: of colons.
        frames: per colon.
    """

    name: str
    make: Literal["plain", "realistic", "variant"]
    strength: Literal["weak", "strong"]
    first: int
    count: int
    frames: int = 2

    def __post_init__(self) -> None:
        if min(self.count, self.frames) < 1 or self.first < 0:
            raise InputError(f"judged colons {self.name!r}: expected count and frames above 0 and first of at least 0")

    @property
    def seeds(self) -> range:
        return range(self.first, self.first + self.count)
