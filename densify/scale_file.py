"""scale.json: what light and known lengths tell of the units of a run's maps, as `scale` and `densify` write it.

It lies in scale/ in the run, which `lightdepth scale` makes, or in the run itself where `densify` was asked for it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from densify.dense_map import map_folders, run_record
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.light.millimetres import Millimetres
from lightdepth.photometry import PhotometricCalibration
from lightdepth.reporting.run import plain

FOLDER, FILE = "scale", "scale.json"

MmPerUnit = float | Mapping[int, float] | None
"""Millimetres per unit of all maps, or of each by id; None where they are not known."""


def factor(mm_per_unit: MmPerUnit, map_id: int) -> float:
    """What the lengths of a map are multiplied by when they are written."""
    if isinstance(mm_per_unit, Mapping):
        return mm_per_unit.get(map_id, 1.0)
    return mm_per_unit or 1.0


@dataclass(frozen=True)
class MapScale:
    """What is told of a map's unit: millimetres, with the interval that nine of ten such scales lie in, or why none."""

    map: int
    mm_per_unit: float | None = None
    interval: tuple[float, float] | None = None
    by: str = ""
    """what told it"""
    reflectance: float | None = None
    """the wall's, with which the views agree best; None where they were not compared"""
    views: int = 0
    """number of views of places that were compared"""
    refused: str = ""
    """why there is no figure; empty where there is one"""
    cure: str = ""
    """what to do about a refusal, of the light too"""
    light_refused: str = ""
    """why the light told nothing, where a known length tells the figure alone"""

    @classmethod
    def of(cls, map_id: int, found: Millimetres) -> MapScale:
        """Of a refusal no figure is kept."""
        known = found.reflectance if np.isfinite(found.reflectance) else None
        if found.refused:
            return cls(map_id, None, None, "", None, found.views, found.refused, found.cure)
        light = {"cure": found.cure, "light_refused": found.light_refused}
        return cls(map_id, found.mm_per_unit, found.interval, found.by, known, found.views, **light)

    @property
    def reach(self) -> float:
        """The factor by which nine of ten such scales are off at most; infinite where there is no figure."""
        return self.interval[1] / self.mm_per_unit if self.interval and self.mm_per_unit else float("inf")

    def __str__(self) -> str:
        if self.mm_per_unit is None or self.interval is None:
            return f"map {self.map}: no millimetres, {self.refused}; {self.cure}"
        low, high = self.interval
        figure = f"{self.mm_per_unit:.4g} mm per map unit, nine of ten such are within {low:.4g} to {high:.4g}"
        light = f"; the light tells none, {self.light_refused}; {self.cure}" if self.light_refused else ""
        return f"map {self.map}: {figure}, by {self.by}{light}"


@dataclass(frozen=True)
class Scales:
    """What is told of the units of a run's maps, together."""

    maps: tuple[MapScale, ...]

    @property
    def told(self) -> dict[int, float]:
        """Millimetres per unit of the maps that have a figure, by id."""
        return {one.map: one.mm_per_unit for one in self.maps if one.mm_per_unit is not None}

    @property
    def all_told(self) -> bool:
        """Whether every map has a figure."""
        return len(self.told) == len(self.maps) > 0

    def write_file(
        self, folder: Path, unit: str, light: PhotometricCalibration, length: Mapping[str, object] | None = None
    ) -> None:
        """scale.json in a folder that appears whole; `unit` is that of the surfaces, `length` what was given."""
        record = {"unit": unit, "maps": self.maps, "light": light, "length": length}
        (folder / FILE).write_text(json.dumps(plain(record), indent=1) + "\n", encoding="utf-8")


class _MapFields(BaseModel):
    model_config = ConfigDict(extra="forbid")
    map: int
    mm_per_unit: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    interval: tuple[float, float] | None
    by: str
    reflectance: float | None
    views: int
    refused: str
    cure: str
    light_refused: str = ""  # files of earlier versions do not say it


class _ScaleFields(BaseModel):
    model_config = ConfigDict(extra="ignore")
    maps: list[_MapFields]


def scale_of(run: Path, map_id: int) -> MapScale | None:
    """What is told of the unit of a map of a run, or of the map or joined surface whose folder `run` is; None where
    nobody asked. Raises InputError where the file is spoilt."""
    own = map_folders(run) == [run]
    folder = run.parent if own else run
    path = next((p for p in (folder / FOLDER / FILE, folder / FILE) if p.is_file()), None)
    if path is None:
        return None
    fields = checked_fields(_ScaleFields, read_json(path), str(path))
    found = {one.map: MapScale(**one.model_dump()) for one in fields.maps}
    return found.get(_unit_of(run, map_id) if own and run.name.startswith("joined_") else map_id)


def figures_in(folder: Path) -> dict[int, float]:
    """Millimetres per unit that the scale.json in a folder has, by map; one that is spoilt has none."""
    try:
        fields = checked_fields(_ScaleFields, read_json(folder / FILE), str(folder / FILE))
    except (InputError, OSError):
        return {}
    return {one.map: one.mm_per_unit for one in fields.maps if one.mm_per_unit is not None}


def replaced(before: Mapping[int, float], now: Mapping[int, float]) -> str:
    """What becomes of figures (millimetres per unit, by map) that were there, in a sentence; empty where they stay as
    they are shown."""

    def shown(told: Mapping[int, float], map_id: int) -> str:
        return f"{told[map_id]:.4g}" if map_id in told else "none"

    moved = {i: (shown(before, i), shown(now, i)) for i in before}
    changed = [f"map {i} had {old} mm per map unit, now {new}" for i, (old, new) in moved.items() if old != new]
    return f"replaces the scale of before: {'; '.join(changed)}" if changed else ""


def unit_told(folder: Path) -> str:
    """The unit of a run's surfaces as the scale.json beside them has it; map units where there is none."""
    found = read_json(folder / FILE) if (folder / FILE).is_file() else {}
    return "mm" if isinstance(found, Mapping) and found.get("unit") == "mm" else "map units"


def _unit_of(joined: Path, number: int) -> int:
    """The map in whose unit a joined surface is; -1 where the run does not say."""
    merged = run_record(joined).get("merge")
    groups = merged.get("joined") if isinstance(merged, Mapping) else None
    groups = groups if isinstance(groups, Sequence) else ()
    named = [g.get("unit_of") for g in groups if isinstance(g, Mapping) and g.get("folder") == joined.name]
    return int(named[0]) if named and isinstance(named[0], int) else -1
