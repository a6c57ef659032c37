"""Rows of a manifest as units of work: what is asked of each, what its results are called, and who makes it.

A unit is called `seq-3f9a1c2b`: eight digits of what its frames and options are, not of where they lie, because paths
are often names of patients; and other frames or options make another unit. A machine that makes a share knows the
others' shares by reckoning alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from densify.batch.manifest import Row
from densify.dense_run import Asked
from densify.inputs import MapSource
from lightdepth.calibration import read_camera, read_light
from lightdepth.datasets import SequenceSource
from lightdepth.datasets.extent import Extent, digits_of, extent_of
from lightdepth.datasets.sequence import read_mask
from lightdepth.errors import InputError
from lightdepth.files.reading import reading
from lightdepth.reporting.progress import counted_through
from lightdepth.reporting.same import plain

_MOST_NAMED = 10
"""Groups of copies that a warning names."""


@dataclass(frozen=True)
class Unit:
    """One sequence to be densified."""

    name: str
    """What its results are called."""
    row: Row
    asked: Asked
    extent: Extent | None
    """None where it cannot be read."""
    trouble: str = ""
    """Why not."""

    @property
    def cost(self) -> int:
        """Frames times pixels, which the time that it takes goes with."""
        return 1 if self.extent is None else max(1, self.extent.pixels)

    @property
    def paths(self) -> dict[str, str]:
        """The path behind each name by which files call its inputs."""
        found, source = {self.name: str(self.row.data)}, self.asked.source
        given = {"map": self.asked.mapped.map, "mask": source.mask, "light": source.light, "camera": source.camera}
        for option, value in (given | {"checkpoint": self.asked.predicting.checkpoint}).items():
            if value is not None and "=" not in str(value) and Path(value).exists():
                found[f"{self.name}-{option}"] = str(value)
        return found


def units_of(rows: Iterable[Row], asked: Asked) -> list[Unit]:
    """The units of a manifest's rows, of which `asked` is what the command line asks of all; its map lies inside each
    sequence. Rows that are the same are one unit. Raises InputError where a row asks for what cannot be."""
    units: list[Unit] = []
    known: set[str] = set()
    taken: Counter[str] = Counter()
    for row in counted_through(list(rows), "Manifest"):
        own = _asked_of(row, asked)
        said = json.dumps([str(row.data), plain(row.given), row.name], sort_keys=True)
        if said in known:
            continue
        known.add(said)
        extent, digits, trouble = _told_apart(own.source, row)
        called = f"row-{row.number:04d}" if extent is None else f"{row.name or 'seq'}-{digits}"
        taken[called] += 1  # copies, and rows that digits of parts of them do not tell apart
        name = called if taken[called] == 1 else f"{called}-{taken[called]}"
        units.append(Unit(name, row, own, extent, trouble))
    return units


def said_of_copies(units: Iterable[Unit], called: Callable[[Unit], str]) -> str:
    """Which units have the same frames although these lie at several places, in a sentence that names them as `called`
    does; empty where there are none. Digits of names and of some contents tell: no frame is read for it."""
    same: dict[str, dict[str, Unit]] = {}
    for unit in units:
        if unit.extent is not None:
            same.setdefault(unit.extent.digits, {}).setdefault(os.path.abspath(unit.row.data), unit)
    groups = [list(each.values()) for each in same.values() if len(each) > 1]
    if not groups:
        return ""
    count = sum(len(group) - 1 for group in groups)
    named = "; ".join(" and ".join(map(called, group)) for group in groups[:_MOST_NAMED])
    more = "; ..." if len(groups) > _MOST_NAMED else ""
    has = "sequence has" if count == 1 else "sequences have"
    told = "as the names of all frames and the contents of some tell"
    return f"{count} {has} the same frames as another one, {told}, and each counts as its own: {named}{more}"


def share_of(units: Sequence[Unit], share: tuple[int, int]) -> list[Unit]:
    """The units of share (I, N), I from 1, the dearest first. Shares cost about the same: each unit goes to the share
    that has least so far."""
    index, count = share
    costs = [0] * count
    mine = []
    for unit in sorted(units, key=lambda unit: (-unit.cost, unit.name)):
        least = costs.index(min(costs))
        costs[least] += unit.cost
        if least == index - 1:
            mine.append(unit)
    return mine


def parsed_share(text: str | None) -> tuple[int, int]:
    """I and N of `I/N`; (1, 1) of None. Raises InputError where it is none."""
    if text is None:
        return 1, 1
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError("--shard", repr(text), "expected I/N with I from 1 to N, such as 1/4, 2/4, 3/4 and 4/4")
    return int(found[1]), int(found[2])


def check_files_of_all(source: SequenceSource, mapped: MapSource) -> None:
    """Raises InputError, before any work, where files that serve for all sequences are not there."""
    for option, path in (("camera", source.camera), ("mask", source.mask), ("light", source.light)):
        if path is None or "=" in str(path) or (option == "camera" and source.asks_for_camera):
            continue
        if not Path(path).is_file():
            raise InputError(f"--{option}", f"{path}: no such file", "expected one file for all sequences")
    if mapped.map is not None and mapped.map.is_absolute():
        cure = "expected a path that begins in the folder of each sequence, such as slam"
        raise InputError("--map", f"{mapped.map}, which would be one map for all sequences", cure)


def check_contents_of_all(source: SequenceSource, units: Iterable[Unit]) -> None:
    """Raises InputError, before any work, where a file that serves for all sequences cannot be read."""
    if source.light is not None:
        read_light(source.light)
    if source.mask is not None:
        read_mask(source.mask)
    extent = next((unit.extent for unit in units if unit.extent is not None), None)
    if source.camera is not None and extent is not None and not source.asks_for_camera:
        read_camera(source.camera, (extent.width, extent.height))


def _asked_of(row: Row, asked: Asked) -> Asked:
    """What is asked of one row."""
    try:
        source = SequenceSource(**{**_over(asked.source, row.given), "data": row.data})
        mapped = asked.mapped.map
        if mapped is not None:
            mapped = (row.data.parent if row.data.is_file() else row.data) / mapped
        own = MapSource(**_over(asked.mapped, {"map": mapped, **row.given}))
        scale = row.given.get("mm_per_unit", asked.files.mm_per_unit)
        made = replace(asked, source=source, mapped=own, files=replace(asked.files, mm_per_unit=scale))
        _ = source.asks_for_camera  # which refuses two of them
    except InputError as error:
        raise error.within(f"row {row.number} of the manifest") from error
    return made


def _over(settings: Any, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """The fields of settings, those of a row in their place."""
    return {each.name: given.get(each.name, getattr(settings, each.name)) for each in fields(settings)}


def _told_apart(source: SequenceSource, row: Row) -> tuple[Extent | None, str, str]:
    """How much there is of a sequence and its digits, or why it cannot be read."""
    try:
        with reading(source.data, "a sequence", "expected a folder of frames, or a video such as .mp4 or .mov"):
            extent = extent_of(source.data, source.format)
            return extent, _digits(extent, row.given), ""
    except (InputError, OSError) as error:
        return None, "", str(error)


def _digits(extent: Extent, given: Mapping[str, Any]) -> str:
    """Eight digits of a sequence and of the options of its own, whose files count by their contents."""
    digest = hashlib.sha256(extent.digits.encode())
    for option, value in sorted(given.items()):
        file = Path(str(value)) if option in ("map", "camera", "mask", "light") else None
        told = digits_of(file) if file is not None and file.exists() else value
        digest.update(f"{option}\0{told}\0".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()[:8]
