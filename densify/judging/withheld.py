"""How well a surface explains points that took no part in the alignment: a judge where there is no truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from densify.dense_map import DenseMap
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.observations import ObservedDistances
from lightdepth.sparse_map import Keyframe


@dataclass(frozen=True)
class Withheld:
    """How far withheld points are from the surface along their rays, as shares |surface - point| / point.

    A point whose ray misses the surface counts as infinitely far in `median` and `p90`, so that cropping cannot win.
    Keyframes that were left out are judged too: the surface that the others made should explain what they saw.
    """

    points: int
    """number of withheld points"""
    median: float
    """median share, misses included"""
    p90: float
    """90th percentile of the shares, misses included"""
    miss: float
    """share of the points whose rays miss the surface"""
    median_met: float | None = None
    """median share of the points whose rays meet the surface; None where a run folder does not say it"""

    def record(self) -> dict[str, float]:
        """For files: what is known of it."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def of_errors(cls, shares: np.ndarray) -> Withheld | None:
        """Of shares (n,) at single keyframes, where no ray can miss; those that are NaN were not judged."""
        known = shares[np.isfinite(shares)]
        if not len(known):
            return None
        median, p90 = (float(np.quantile(known, q, method="higher")) for q in (0.5, 0.9))
        return cls(len(known), median, p90, 0.0, median)

    @classmethod
    def of(cls, dense: DenseMap, withheld: Sequence[tuple[Keyframe, ObservedDistances]]) -> Withheld | None:
        """Of a surface and distances of each keyframe that it was not made from; None when there are none."""
        errors = []
        for keyframe, observed in withheld:
            if len(observed):
                hit = dense.surface.cast(keyframe.center, observed.rays @ keyframe.cam_from_map[:3, :3])
                errors.append(np.abs(hit - observed.mapped) / observed.mapped)
        if not errors:
            return None
        error = np.concatenate(errors)
        met = error[np.isfinite(error)]
        median, p90 = (float(np.quantile(error, q, method="higher")) for q in (0.5, 0.9))
        median_met = float(np.median(met)) if len(met) else np.inf
        return cls(len(error), median, p90, 1 - len(met) / len(error), median_met)


@dataclass(frozen=True)
class WithheldOfMap:
    """The withheld points of one map, with a constant distance's beside."""

    map_id: int
    """id of the map; `map` in the file"""
    withheld: Withheld
    """by the depth that the map was made with"""
    constant: Withheld | None = None
    """by a constant distance; `withheld_constant` in the file"""
    sequence: str = ""
    """which sequence the map is of, where several are judged"""

    def record(self) -> dict[str, object]:
        """As metrics.json has it."""
        constant = self.constant and self.constant.record()
        both = {"withheld": self.withheld.record(), "withheld_constant": constant}
        return {"map": self.map_id, **both, **({"sequence": self.sequence} if self.sequence else {})}


class _Withheld(BaseModel):
    points: int
    median: float | None
    p90: float | None
    miss: float
    median_met: float | None = None

    def read(self) -> Withheld:
        """JSON has no infinity: null stands for it."""
        median, p90, met = (np.inf if v is None else v for v in (self.median, self.p90, self.median_met))
        return Withheld(self.points, median, p90, self.miss, met if "median_met" in self.model_fields_set else None)


class _Map(BaseModel):
    map: int
    withheld: _Withheld
    withheld_constant: _Withheld | None = None


class _Judge(BaseModel):
    hidden: _Withheld | None
    hidden_constant: _Withheld | None = None

    def read(self) -> tuple[Withheld, Withheld | None]:
        """What hidden blocks say of the keyframes as they were delivered, and of a constant distance, bent."""
        hidden = self.hidden.read() if self.hidden else Withheld(0, np.inf, np.inf, 0.0)
        return hidden, None if self.hidden_constant is None else self.hidden_constant.read()


class _Judged(BaseModel):
    map: int
    judge: _Judge


def withheld_errors(folder: Path) -> list[WithheldOfMap]:
    """What a densify run says of the points that it withheld: the judge where there is no truth. Empty where nothing
    was withheld. Raises InputError where run.json does not say it as `densify` does."""
    file = folder / "run.json"
    if not file.is_file():
        return []
    found = []
    maps = read_json(file)
    maps = maps.get("maps", []) if isinstance(maps, dict) else None
    if not isinstance(maps, list):
        raise InputError(file, "not as a run writes it", "expected the run.json of a densify run")
    for told in maps:
        if isinstance(told, dict) and told.get("judge"):
            judged = checked_fields(_Judged, told, f"{file}: maps")
            found.append(WithheldOfMap(judged.map, *judged.judge.read()))
        elif isinstance(told, dict) and told.get("withheld"):
            entry = checked_fields(_Map, told, f"{file}: maps")
            constant = None if entry.withheld_constant is None else entry.withheld_constant.read()
            found.append(WithheldOfMap(entry.map, entry.withheld.read(), constant))
    return found
