"""The scale of a densify run that is there: its surfaces, frames and light found again, and a length that is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from densify.dense_map import Surface, map_folders, read_dense_map, read_keyframes, run_record
from densify.run_frames import run_frames
from densify.scale_file import Scales
from densify.scaling import SeenMap, scales_of
from lightdepth.calibration import read_light
from lightdepth.errors import InputError
from lightdepth.light.known_length import KnownLength
from lightdepth.photometry import PhotometricCalibration
from lightdepth.ranges import ANY, above, at_least, checked
from lightdepth.sparse_map import Keyframe

_ERROR = 0.1
"""Standard error of a length of which none is said, as a share of it."""


@dataclass(frozen=True)
@checked
class LengthGiven:
    """A length that somebody knows, such as the width of a tool or of a mark on the wall."""

    ends: Annotated[list[tuple[float, float, float]] | None, ANY] = None
    """Two places in the coordinates of a map's surface, map units, [[x, y, z], [x, y, z]], whose straight distance is
    known; on the surface or near it (`measure` says where it is). Another pair is of another length."""
    mm: Annotated[float | None, above(0)] = None
    """Distance between the two places, mm. A longer one makes the map larger in proportion."""
    error_mm: Annotated[float | None, above(0)] = None
    """Standard error of that distance, mm, in which the error of the places counts too; it must be below the distance.
    Left out, a tenth of it. A larger one gives the light more weight beside it."""
    map: Annotated[int | None, at_least(0)] = None
    """Number of the map that the places are on, as in the name of its folder; needed where the run has several. Another
    one gives that map's unit."""

    def known(self, maps: Sequence[int], run: Path) -> KnownLength | None:
        """The length in one of the maps; None where none is given. Raises InputError where it is given in part, or it
        is not said of which map it is."""
        if self.ends is None and self.mm is None:
            if self.error_mm is not None or self.map is not None:
                raise InputError("--length", "without places and their distance", "give --length.ends and --length.mm")
            return None
        if self.ends is None or self.mm is None or len(self.ends) != 2:
            found = "no two places" if self.mm is not None else "no distance"
            raise InputError("--length", found, "give two places by --length.ends, and their distance by --length.mm")
        if self.map is None and len(maps) > 1:
            raise InputError(
                "--length", f"the run has maps {list(maps)}", "say with --length.map which map the places are on"
            )
        wanted = maps[0] if self.map is None else self.map
        if wanted not in maps:
            raise InputError("--length.map", f"no map {wanted} with a surface", f"{run} has {list(maps)}")
        start, end = np.array(self.ends, float)
        error = _ERROR * self.mm if self.error_mm is None else self.error_mm
        return KnownLength(list(maps).index(wanted), float(np.linalg.norm(end - start)), self.mm, error)


@dataclass(frozen=True, eq=False)
class ScaleAsked:
    """What a scale is found from, checked before any work."""

    run: Path
    maps: tuple[SeenMap, ...]
    light: str | None
    data: Path | None
    wall_mm: float
    length: KnownLength | None

    @classmethod
    def of(cls, run: Path, light: str | None, data: Path | None, wall_mm: float, length: LengthGiven) -> ScaleAsked:
        """Raises InputError where `run` is no finished run with surfaces in map units."""
        folders = map_folders(run)
        if not run.exists():
            raise InputError(run, "does not exist", "expected a run of `lightdepth densify`")
        if not folders or folders == [run]:
            found = "the folder of one map" if folders else "no map_* folders in it"
            raise InputError(run, found, "expected a run of `lightdepth densify`, whose maps are solved together")
        if run_record(run).get("unit") == "mm":
            raise InputError(run, "its surfaces are in mm already", "densify it without --mm-per-unit")
        maps = tuple(one for one in map(_seen, folders) if one is not None)
        if not maps:
            raise InputError(run, "no surface in it that is not empty", "expected one at least")
        known = length.known([one.id for one in maps], run)
        if known is not None:
            maps[known.map].check_near(np.array(length.ends, float))
        return cls(run, maps, light, data, wall_mm, known)

    def length_record(self, given: LengthGiven) -> dict[str, object] | None:
        """The length for scale.json, with what was left out of it; None where none was given."""
        known = self.length
        if known is None:
            return None
        own = {"units": known.units, "mm": known.mm, "error_mm": known.error_mm}
        return {"map": self.maps[known.map].id, "ends": given.ends, **own}

    def told(self) -> tuple[Scales, PhotometricCalibration]:
        """The scales, and the light that told them. Raises InputError where the frames are not found."""
        record = run_record(self.run)
        frames, missing = run_frames(self.run, self.data, record)
        if frames is None:
            raise InputError(self.run, missing, "give them: --data FRAMES")
        named = self.light or _light_of(self.run, record)
        light = frames.first().light if named is None else read_light(named)
        return scales_of(self.maps, frames, light, self.wall_mm, self.length), light


def _seen(folder: Path) -> SeenMap | None:
    """A map of a run with the keyframes that are in its surface; None where it has no surface."""
    dense = read_dense_map(folder)
    if not len(dense.triangles):
        return None
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    keyframes = tuple(
        Keyframe(row.name, dense.camera, np.linalg.inv(pose), *none)
        for row, pose in zip(read_keyframes(folder, dense.numbers.tolist()), dense.map_from_cam, strict=True)
        if row.used
    )
    return SeenMap(dense.id, Surface(dense.vertices, dense.triangles), keyframes)


def _light_of(run: Path, record: Mapping[str, object]) -> str | None:
    """The light that a run was given; None where it was given none. Raises InputError where it is no longer there:
    under another light the figure would be another one."""
    arguments = record.get("arguments")
    named = arguments.get("light") if isinstance(arguments, Mapping) else None
    if named is None:
        return None
    if not isinstance(named, str) or ("=" not in named and not Path(named).is_file()):
        raise InputError(run, f"the light that it was made with is not found ({named})", "give it: --light")
    return named
