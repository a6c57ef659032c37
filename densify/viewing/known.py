"""What is known of a run beside its maps: the unit of lengths, the pictures of its keyframes, how it stands with it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from densify.dense_map import map_folders
from densify.measure import run_unit
from densify.run_frames import run_frames
from densify.scale_file import unit_told
from densify.scene import KEYFRAMES
from densify.viewing.pictures import Pictures
from densify.viewing.watched import State, WatchedRun
from lightdepth.errors import InputError


@dataclass(frozen=True)
class Known:
    """What is known of a run beside its maps: the unit of lengths, the pictures of its keyframes, what is to be said of
    both, and how it stands with the run."""

    unit: str
    pictures: Pictures
    notes: tuple[str, ...] = ()
    state: State = "finished"


def known_of(watched: WatchedRun, data: Path | None, mm_per_unit: float | None) -> Known:
    """The unit of lengths, and the frames where they are found; none before there is a map."""
    state, folder = watched.state, watched.folder
    unit = run_unit(folder, mm_per_unit) if state == "finished" else _unit_meant(watched, mm_per_unit)
    if not map_folders(folder):
        return Known(unit, Pictures(), state=state)
    rows = (folder.parent if map_folders(folder) == [folder] else folder) / KEYFRAMES
    try:
        frames, missing = run_frames(folder, data, watched.record)
    except InputError as error:
        if data is not None:
            raise
        frames, missing = None, f"the run's frames cannot be read: {error}"
    if missing:
        warnings.warn(f"{missing}: cameras have no pictures; give --data", stacklevel=2)
    notes = ("The run's frames are not there: cameras have no pictures.",) if missing else ()
    return Known(unit, Pictures(frames, rows), notes, state)


def _unit_meant(watched: WatchedRun, mm_per_unit: float | None) -> str:
    """As `run_unit`, of a run that is still at work."""
    arguments = watched.record.get("arguments")
    given = arguments.get("mm_per_unit") if isinstance(arguments, Mapping) else None
    asked = given is not None and (given != "light" or unit_told(watched.folder) == "mm")
    if asked and mm_per_unit is not None:
        raise InputError(watched.folder, "its surfaces are in mm already", "leave --mm-per-unit out")
    return "mm" if asked or mm_per_unit is not None else "map units"
