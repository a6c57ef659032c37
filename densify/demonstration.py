"""What the demo shows besides a good surface: a submap that is wrong on purpose, and what is said of both.

The first submap is given an error that a SLAM makes: the points on one side of its wall are too far away, all by one
factor. Nothing tells the program, which judges both submaps as it would judge a stranger's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from densify.evaluation.records import MapFigures, SurfaceFigures
from densify.judging.verdict import COLOURS, Verdict
from lightdepth.sparse_map import SparseMap
from lightdepth.tube.map_errors import MapErrors, moved_ids, with_errors

SIDE = 0.5
"""Share of the submap's points that are too far away."""


@dataclass(frozen=True)
class Planted:
    """A map, one submap of which is wrong on purpose."""

    map: SparseMap
    map_id: int
    """id of that submap"""
    factor: float
    """by which its points on one side are too far away; 1 leaves them right"""
    moved: Mapping[int, np.ndarray]
    """ids of the points that moved, by submap id"""

    @classmethod
    def of(cls, right: SparseMap, factor: float, seed: int) -> Planted:
        """The map with its first submap made wrong; `seed` draws which side is moved."""
        first, *others = right.submaps
        wrong = with_errors(first, MapErrors(side_share=SIDE, side_factor=factor), seed)
        made = replace(right, submaps=(wrong, *others))
        return cls(made, first.id, factor, moved_ids(right, made))

    @property
    def sentence(self) -> str:
        """What is wrong with the submap; empty where nothing is."""
        if self.factor == 1:
            return ""
        return (
            f"made wrong on purpose: {SIDE:.0%} of its points, one side of the wall, are {self.factor:g} times too far"
        )

    def record(self) -> dict[str, object]:
        """For run.json."""
        points = len(self.moved[self.map_id])
        return {"map": self.map_id, "sentence": self.sentence, "side_factor": self.factor, "points_moved": points}


def closing_lines(
    planted: Planted, verdicts: Mapping[int, Verdict | None], figures: Sequence[MapFigures]
) -> tuple[str, ...]:
    """What came of the demo: a line for each submap with its verdict and why, and one that holds both against the
    truth."""
    lines = []
    for map_id, verdict in verdicts.items():
        why = f" ({planted.sentence})" if map_id == planted.map_id and planted.sentence else ""
        lines.append(f"map {map_id}{why}: {verdict or 'not judged'}")
    errors = {m.map_id: m.clouds.get("dense") for m in figures}
    told = "; ".join(f"map {m.map_id} {_off(m)}" for m in figures)
    return (*lines, f"truth, which no verdict saw: {told}{_order(verdicts, errors)}")


def _off(figures: MapFigures) -> str:
    """How far a surface is from the true wall, or why that is not known."""
    found = figures.clouds.get("dense")
    if found is None:
        return f"cannot be compared ({figures.error or figures.surface_error or 'it has no surface'})"
    return f"is {found.median_mm:.2f} mm from the wall in the median, RMS {found.rms_mm:.2f} mm"


def _order(verdicts: Mapping[int, Verdict | None], errors: Mapping[int, SurfaceFigures | None]) -> str:
    """Whether the worse colours are on the worse surfaces."""
    both = [(v, e) for i, v in verdicts.items() if v is not None and (e := errors.get(i)) is not None]
    pairs = [
        ((COLOURS.index(a.colour), x.rms_mm), (COLOURS.index(b.colour), y.rms_mm)) for a, x in both for b, y in both
    ]
    apart = [(x < y) for (a, x), (b, y) in pairs if a < b]
    if not apart:
        return ": the colours do not tell which is worse" if len(both) > 1 else ""
    return (
        ": the worse colour went to the worse surface"
        if all(apart)
        else ": the worse colour went to the better surface"
    )
