"""The dry run of a batch: what is left to be made of it, and about how long that takes.

To open the maps of thousands of sequences would take long: some are opened, and of the others as many frames are taken
to be keyframes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from densify.batch.folder import check_ours, is_begun
from densify.batch.make import SEQUENCES
from densify.batch.units import Unit, parsed_share, share_of
from densify.costs import known_cost
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.dry import Planned, Step
from lightdepth.counting import counted
from lightdepth.errors import InputError
from lightdepth.files.replacing import read_record
from lightdepth.maps import read_map
from lightdepth.models import DepthModel
from lightdepth.reporting.plan import seconds_each, times, untouched

_OPENED = 8
"""Sequences whose maps are opened."""


@dataclass(frozen=True)
class _Frames:
    """Of sequences together: frames, pixels of all of them, and how many of the frames are keyframes, about."""

    frames: int
    pixels: int
    keyframes: int

    @property
    def megapixels(self) -> float:
        """Of one frame, in the mean."""
        return self.pixels / max(self.frames, 1) / 1e6


def plan_batch(
    units: Sequence[Unit],
    output: Path,
    arguments: Mapping[str, object],
    predicting: ModelSource,
    shard: str | None,
    jobs: int,
) -> NoReturn:
    """Ends a dry run. Raises InputError where the output cannot be used."""
    with untouched(output):
        begun = is_begun(output, arguments)
        if begun:
            check_ours(output)
    share = share_of(units, parsed_share(shard))
    left = [unit for unit in share if not _is_made(unit, output)]
    made = len(share) - len(left) or "none"
    of = f" of {len(units)}" if shard else ""
    how = ", going on from what is there" if begun else ""
    what = f"dry run: {counted(len(share), 'sequence')}{of}, {made} of them already made"
    raise Planned([what, f"would make {output}{how}"], _steps(left, predicting, max(jobs, 1)), str(output))


def _is_made(unit: Unit, output: Path) -> bool:
    record = read_record(output / SEQUENCES / unit.name)
    return record is not None and record.get("verb") == "densify"


def _steps(units: Sequence[Unit], predicting: ModelSource, jobs: int) -> list[Step]:
    """Prediction and the rest, on so many processes at once."""
    mapped = [unit for unit in units if unit.extent is not None and unit.asked.mapped.map is not None]
    others, steps = len(units) - len(mapped), []
    known, found = known_cost(), _frames(mapped)
    if mapped and found.keyframes:
        each = _predicted(mapped[0], predicting.load(details=False))
        about = f"about {counted(found.keyframes, 'keyframe')}"
        seconds = times(found.keyframes, each)
        steps.append(Step(f"predicting {about}", None if seconds is None else seconds / jobs))
        fused = known.cost.of(found.keyframes, found.megapixels, len(mapped)) / jobs
        steps.append(
            Step(f"aligning, judging and fusing, {known.by}, those of {counted(len(mapped), 'sequence')}", fused)
        )
    if others or not found.keyframes:
        steps.append(Step(f"{counted(others or len(mapped), 'sequence')} without a map that can be read"))
    return steps


def _predicted(unit: Unit, model: DepthModel) -> float | None:
    """Seconds of a frame of a sequence, read and predicted."""
    with suppress(InputError):
        return seconds_each(unit.asked.source.open(), model)
    return None


def _frames(units: Sequence[Unit]) -> _Frames:
    extents = [unit.extent for unit in units if unit.extent is not None]
    frames, pixels = sum(e.frames for e in extents), sum(e.pixels for e in extents)
    keyframes, seen = 0, 0
    for unit in units[:: max(1, len(units) // _OPENED)]:
        with suppress(InputError):
            assert unit.asked.mapped.map is not None and unit.extent is not None
            keyframes += sum(len(submap.keyframes) for submap in read_map(unit.asked.mapped.map).submaps)
            seen += unit.extent.frames
    return _Frames(frames, pixels, round(keyframes / seen * frames) if seen else 0)
