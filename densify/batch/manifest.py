"""Which sequences there are: a folder of them, a pattern, or a table with options of each.

    data,map,light,mm_per_unit,name
    2024/017/frames,2024/017/slam,gamma=2.2,3.1,case-017

A table is a CSV file whose columns are options of densify, as `--help` of batch lists them; paths in it are beside it,
and an empty cell leaves the option to the command line.
"""

from __future__ import annotations

import csv
import difflib
import glob
import io
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from densify.inputs import MapSource, SurfaceFiles
from lightdepth.calibration import read_light
from lightdepth.datasets import SequenceSource
from lightdepth.datasets.extent import sequences_below
from lightdepth.datasets.reading import is_sequence
from lightdepth.datasets.video_sequence import video_at
from lightdepth.errors import InputError
from lightdepth.files.below import is_result
from lightdepth.files.reading import MOST_TEXT, check_bytes, reading
from lightdepth.ranges import Range, ranges_of
from lightdepth.regular import regular

TABLES = (".csv", ".tsv")
_MAGIC = re.compile(r"[*?\[]")
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")
_LONGEST_NAME, _LONGEST_PART, _LONGEST_PATH = 100, 255, 4096
"""Bytes: file systems take parts of 255, and a name gets digits and endings; Linux takes paths of 4096."""
_PATHS = ("data", "map", "camera", "mask")
_TYPES = (SequenceSource, MapSource)


@dataclass(frozen=True)
class Row:
    """One sequence of a manifest."""

    number: int
    """Its place, from 1."""
    data: Path
    given: Mapping[str, Any] = field(default_factory=dict)
    """Options that it has of its own."""
    name: str = ""
    """What its results are called, where the manifest says."""


def read_manifest(manifest: Path, output: Path) -> list[Row]:
    """The rows of a manifest, in order; nothing of `output`, where results are to come to. Raises InputError where
    there is none, or a table cannot be read."""
    found = str(manifest)
    if manifest.is_dir():
        if is_sequence(manifest):
            raise InputError(manifest, "is one sequence", f"lightdepth densify {manifest} makes its surface")
        with reading(manifest, "a folder of sequences", "expected folders that may be read"):
            paths = sequences_below(manifest, output)
    elif manifest.suffix.lower() in TABLES and manifest.exists():
        return _rows_of_table(manifest)
    elif manifest.exists():
        raise InputError(manifest, "is a file", "expected a folder of sequences, a pattern, or a table (.csv)")
    elif _MAGIC.search(found):
        paths = [path for path in map(Path, sorted(glob.glob(found, recursive=True))) if _may_be_one(path, output)]
    else:
        raise InputError(manifest, "does not exist", "expected a folder of sequences, a pattern, or a table (.csv)")
    if not paths:
        raise InputError(manifest, "no sequence in it", "expected folders of frames, or videos")
    return [Row(number, path) for number, path in enumerate(paths, 1)]


def _may_be_one(path: Path, output: Path) -> bool:
    """Whether what a pattern matches may be a sequence: no result of a run, and no file but a video."""
    if path.is_file():
        return video_at(path) is not None
    return not is_result(path) and os.path.realpath(path) != str(output)


def _rows_of_table(table: Path) -> list[Row]:
    with reading(regular(table), "a table of sequences", "expected UTF-8 text, as a spreadsheet saves CSV"):
        check_bytes(table.stat().st_size, MOST_TEXT, table, "table")
        text = table.read_bytes().decode("utf-8-sig")
        lines = _cells(table, text)
    columns = [word.strip().replace("-", "_") for word in lines[0]] if lines else []
    while columns and not columns[-1]:  # spreadsheets save empty columns to the right
        columns.pop()
    _check_columns(table, columns)
    rows: list[Row] = []
    names: dict[str, int] = {}
    for number, cells in enumerate(lines[1:], 1):
        if not any(cell.strip() for cell in cells):
            continue
        where = f"{table}: row {number}"
        if any(cell.strip() for cell in cells[len(columns) :]):
            raise InputError(where, f"{len(cells)} cells", f"expected {len(columns)}, one for each column")
        row = _row(table, where, number, {c: cell.strip() for c, cell in zip(columns, cells, strict=False)})
        if row.name and (other := names.setdefault(row.name.lower(), number)) != number:
            raise InputError(where, f"name {row.name}, as in row {other}", "results are named after it: change one")
        rows.append(row)
    if not rows:
        raise InputError(table, "no row in it", "expected a line of column names, then a line for each sequence")
    return rows


def _cells(table: Path, text: str) -> list[list[str]]:
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=_delimiter(text), strict=True)
    try:
        return list(lines)
    except csv.Error as error:
        found = f"cannot be parted into cells ({error})"
        cure = "look for a quotation mark that is not closed, or that stands within a cell"
        raise InputError(f"{table}: line {lines.line_num}", found, cure) from error


def _delimiter(text: str) -> str:
    """What parts the cells of the first line: spreadsheets of some languages write semicolons."""
    first = text.partition("\n")[0]
    return max(",;\t", key=first.count)


def _check_columns(table: Path, columns: list[str]) -> None:
    known = ["name", *_kinds()]
    for column in columns:
        if column not in known:
            near = difflib.get_close_matches(column, known, 1)
            hint = f"is {near[0]} meant?" if near else f"expected some of {', '.join(known)}"
            raise InputError(table, f"a column {column!r}", hint)
    if "data" not in columns:
        raise InputError(table, "no column data", "expected one with the folder or the video of each sequence")
    if len(set(columns)) < len(columns):
        raise InputError(table, "a column is there twice", "remove one of the two")


def _row(table: Path, where: str, number: int, cells: Mapping[str, str]) -> Row:
    given = {column: _value(where, column, cell) for column, cell in cells.items() if cell and column != "name"}
    if "data" not in given:
        raise InputError(where, "no data", "expected the folder or the video of the sequence")
    name = cells.get("name", "")
    if name and not (_NAME.fullmatch(name) and len(name.encode()) <= _LONGEST_NAME):
        cure = f"expected letters, digits, dots, dashes and underscores, up to {_LONGEST_NAME} bytes"
        raise InputError(where, f"name {name[:40]!r} of {len(name.encode())} bytes", cure)
    for option in _PATHS:
        if option in given and not (option == "camera" and given[option] == Path("auto")):
            given[option] = Path(os.path.normpath(table.parent / given[option]))
    light = given.get("light")
    if light is not None and "=" in light:
        try:
            read_light(light)
        except InputError as error:
            raise error.within(where) from error
    elif light is not None:
        given["light"] = os.path.normpath(table.parent / light)
    return Row(number, given.pop("data"), given, name)


def _value(where: str, column: str, cell: str) -> Any:
    """A cell as its option takes it."""
    if "\0" in cell:
        raise InputError(where, f"{column}: a zero byte", "copy the table again")
    longest = max(len(part.encode()) for part in cell.split(os.sep))
    if len(cell.encode()) > _LONGEST_PATH or longest > _LONGEST_PART:
        found = f"{column} {cell[:40]!r} of {len(cell.encode())} bytes, {longest} between two slashes"
        raise InputError(where, found, f"expected up to {_LONGEST_PATH}, and {_LONGEST_PART} between two slashes")
    try:
        value = TypeAdapter(_kinds()[column]).validate_strings(cell)
        if wrong := _ranges()[column].wrong(value) if column in _ranges() else "":
            raise InputError(where, f"{column} {cell[:40]!r}", wrong)
        return value
    except ValidationError as error:
        said = error.errors()[0]["msg"]
        raise InputError(where, f"{column} {cell[:40]!r}", f"{said[0].lower()}{said[1:]}") from error


@cache
def _ranges() -> Mapping[str, Range]:
    """The ranges of those that are numbers."""
    return {name: one for settings in (*_TYPES, SurfaceFiles) for name, one in ranges_of(settings).items()}


@cache
def _kinds() -> Mapping[str, Any]:
    """The options that a row may have, with the types of their values."""
    return dict(_of_fields())


def _of_fields() -> Iterator[tuple[str, Any]]:
    for settings in _TYPES:
        hints = get_type_hints(settings)
        yield from ((each.name, hints[each.name]) for each in fields(settings))
    yield "mm_per_unit", get_type_hints(SurfaceFiles)["mm_per_unit"]
