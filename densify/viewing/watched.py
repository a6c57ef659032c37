"""What a viewer reads of a run folder, finished or in the making, and whether that has changed.

A run in the making stands in a hidden folder beside its place, where `live` and `densify` write each submap's surface
when its last keyframe is done. A folder that is still written to is read when its files stay as they are for a poll.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from densify.dense_map import DenseMapFiles, map_folders, read_dense_map, read_keyframes, run_record, surface_folders
from densify.evaluation.pictures import read_error
from densify.scene import TRIANGLES, surface_of_files
from lightdepth.errors import InputError
from lightdepth.files.lock import is_live
from lightdepth.files.replacing import unfinished_path
from lightdepth.reporting.scene import Surface
from lightdepth.reporting.unfinished import begun_with

VERBS = ("densify", "live", "demo")
"""Whose runs have surfaces."""
_FILES = ("mesh.ply", "sparse.ply", "trajectory.tum", "camera.json")
_MORE = ("keyframes.csv",)
_EXPECTED = "expected a run of `lightdepth densify`, `live` or `demo`"

State = Literal["finished", "at work", "stopped", "gone"]
"""How it stands with a run: in its place, in the making, in the making but nobody works at it, or nowhere."""

Stamp = tuple[tuple[int, int], ...]
"""Time of change [ns] and size of each file; zeros where there is none."""


@dataclass(frozen=True, eq=False)
class ViewedMap:
    """A map folder as it was read: the files' numbers, and what is drawn of them, with fewer triangles."""

    name: str
    read: DenseMapFiles
    surface: Surface
    colour: str = ""
    """of the verdict on it; empty where there is none"""


class WatchedRun:
    """The maps of a run, read again when their files change; `most` triangles at most are drawn of each. Raises
    InputError where the folder is no run that has surfaces, or will have."""

    def __init__(self, run: Path, most: int = TRIANGLES) -> None:
        run = run if run.name not in ("", "..") else Path(os.path.abspath(run))  # `.` does not say which map it is
        self._run, self._made, self._most = run, unfinished_path(Path(os.path.abspath(run))), most
        self._last: dict[str, Stamp] = {}
        self._shown: dict[str, Stamp] = {}
        self._check()

    @property
    def is_finished(self) -> bool:
        """Whether the run is in its place."""
        return self._run.is_dir() or not self._made.is_dir()

    @property
    def state(self) -> State:
        """How it stands with the run now."""
        if self._run.is_dir():
            return "finished"
        if not self._made.is_dir():
            return "gone"
        return "at work" if is_live(Path(os.path.abspath(self._run))) else "stopped"

    @property
    def folder(self) -> Path:
        """Where its files are now."""
        return self._run if self.is_finished else self._made

    @property
    def record(self) -> Mapping[str, object]:
        """run.json, or what a run that is still at work was begun with; empty where neither says anything."""
        return run_record(self._run) if self.is_finished else begun_with(self._made) or {}

    def first(self) -> list[ViewedMap]:
        """The maps that there are. Raises InputError where one of a finished run cannot be read, or where it has none
        with a surface; one of a run in the making may be half written, and is left to the next poll."""
        stamps, found = self._stamps(), []
        self._last, self._shown = stamps, dict(stamps)
        for name in [f.name for f in surface_folders(self._run)] if self.is_finished else [*stamps]:
            try:
                found.append(self._read(name))
            except (InputError, OSError):
                if self.is_finished:
                    raise
                del self._shown[name]
        with_surface = [each for each in found if len(each.surface.triangles)]
        if self.is_finished and not with_surface:
            raise InputError(self._run, "all its surfaces are empty", "keyframes.csv of each map has the reasons")
        return with_surface

    def changed(self) -> tuple[list[ViewedMap], list[str]]:
        """The maps whose files are others than when this was asked before, and the names of those that are gone or have
        no surface any more. One that cannot be read now is read at the next poll."""
        stamps = self._stamps()
        steady = {name for name, stamp in stamps.items() if self._last.get(name) == stamp}
        found, empty = [], []
        for name in steady:
            if self._shown.get(name) == stamps[name]:
                continue
            try:
                read = self._read(name)
            except (InputError, OSError):  # a run takes its place at this moment, or writes on
                continue
            self._shown[name] = stamps[name]
            if len(read.surface.triangles):
                found.append(read)
            else:
                empty.append(name)
        gone = [name for name in self._shown if name not in stamps and name not in self._last]
        for name in gone:
            del self._shown[name]
        self._last = stamps
        return found, gone + empty

    def _read(self, name: str) -> ViewedMap:
        folder = self.folder if self.folder.name == name else self.folder / name
        read = read_dense_map(folder)
        error = next((found for found in map(read_error, _error_files(folder)) if found is not None), None)
        rows = read_keyframes(folder, read.numbers.tolist())
        kind, _, number = name.partition("_")
        surface = surface_of_files(f"{kind} {int(number)}", read, rows, error)
        return ViewedMap(name, read, surface.thinned(self._most), self._colour(name))

    def _colour(self, name: str) -> str:
        """What run.json says of a map; a joined one has no verdict of its own."""
        maps = self.record.get("maps")
        for said in maps if isinstance(maps, list) else ():
            verdict = said.get("verdict") if isinstance(said, dict) else None
            if isinstance(verdict, dict) and name == f"map_{said.get('map'):0>3}":
                return str(verdict.get("colour", ""))
        return ""

    def _stamps(self) -> dict[str, Stamp]:
        """Of every map folder that has the files of one, by its name."""
        found = {}
        for folder in surface_folders(self.folder):
            stamps = [_stamp(folder / name) for name in (*_FILES, *_MORE)]
            if all(stamp != (0, 0) for stamp in stamps[: len(_FILES)]):
                found[folder.name] = (*stamps, *map(_stamp, _error_files(folder)))
        return found

    def _check(self) -> None:
        run = self._run
        if not run.is_dir() and not self._made.is_dir():
            raise InputError(run, "not a folder" if run.exists() else "no such folder", _EXPECTED)
        verb = self.record.get("verb")
        if verb is not None and verb not in VERBS:
            raise InputError(run, f"made by `{verb}`", _EXPECTED)
        if not map_folders(self.folder) and not (not self.is_finished and is_live(Path(os.path.abspath(run)))):
            if self.is_finished:
                raise InputError(run, "no map_* folders in it", _EXPECTED)
            raise InputError(run, "a run that was stopped before its first surface", "run it again, or with --resume")


def _error_files(folder: Path) -> list[Path]:
    """Where the distance of a surface's vertices from the truth may be: of `demo`, and of `evaluate`."""
    return [folder.parent / inside / f"{folder.name}_error.ply" for inside in ("", "evaluation")]


def _stamp(path: Path) -> tuple[int, int]:
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size
