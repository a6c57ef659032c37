"""What became of the sequences, in one table: for spreadsheets, for programs, and as a page."""

from __future__ import annotations

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from densify.batch.folder import PAGE, TABLE, TABLE_JSON
from densify.batch.make import SEQUENCES, Ended
from densify.batch.units import Unit
from densify.judging.verdict import COLOURS
from lightdepth.counting import counted
from lightdepth.files.replacing import read_record
from lightdepth.files.writing import write_together, write_whole
from lightdepth.foreign_text import for_line, for_table
from lightdepth.reporting.names import Names
from lightdepth.reporting.report import Report

STATES = ("done", "in part", "failed", "elsewhere", "waiting")
_COUNTED = ("keyframes", "aligned", "vertices")
_FILES = {
    TABLE: "the table for spreadsheets",
    TABLE_JSON: "the same for programs",
    f"{SEQUENCES}/*/report.html": "the report of a sequence",
}


@dataclass(frozen=True)
class Line:
    """A sequence in the table; None where nothing is known."""

    sequence: str
    state: str
    """done, in part (some of it failed), failed, elsewhere (another run is at it), waiting"""
    verdict: str | None = None
    """green, amber or red"""
    judged_off: float | None = None
    """share of the distance by which the judge puts the wall from the surface"""
    seen_well: float | None = None
    """share of the wall that was seen well, the least of all maps"""
    submaps: int | None = None
    frames: int | None = None
    keyframes: int | None = None
    aligned: int | None = None
    vertices: int | None = None
    seconds: float | None = None
    error: str = ""


def line_of(unit: Unit, ended: Ended | None, output: Path, names: Names) -> Line:
    """The line of a unit; what its run.json does not say is not known."""
    frames = None if unit.extent is None else unit.extent.frames
    if ended is None or ended.state in ("failed", "elsewhere"):
        error = "" if ended is None else for_line(names.text(ended.error))
        return Line(unit.name, "waiting" if ended is None else ended.state, frames=frames, error=error)
    record = read_record(output / SEQUENCES / unit.name) or {}
    found, listed = _mapping(record.get("verdict")), record.get("maps")
    maps = [each for each in listed if isinstance(each, Mapping)] if isinstance(listed, list) else []
    keyframes, aligned, vertices = (sum(map(int, _numbers(each.get(name) for each in maps))) for name in _COUNTED)
    colour = found.get("colour")
    return Line(
        unit.name,
        ended.state,
        colour if colour in COLOURS else None,
        next(_numbers([found.get("number")]), None),
        min(_numbers(_mapping(each.get("coverage")).get("well_share") for each in maps), default=None),
        len(maps),
        frames,
        keyframes,
        aligned,
        vertices,
        next(_numbers([record.get("seconds")]), None),
        for_line(ended.error),
    )


def _mapping(value: object) -> Mapping[str, object]:
    """What should be one, of a run.json that anybody may have written to."""
    return value if isinstance(value, Mapping) else {}


def _numbers(values: Iterable[object]) -> Iterator[float]:
    """Those that are numbers, and finite."""
    return (v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v))


def summary(lines: Sequence[Line]) -> str:
    """How many sequences there are, and what became of them, in a sentence."""
    states = Counter(line.state for line in lines)
    told = [f"{states[state]} {state}" for state in STATES if states[state]]
    colours = Counter(line.verdict for line in lines)
    judged = [f"{colours[colour]} {colour}" for colour in COLOURS if colours[colour]]
    verdicts = f"; verdicts: {', '.join(judged)}" if judged else ""
    return f"{counted(len(lines), 'sequence')}: {', '.join(told)}{verdicts}"


def write_table(lines: Sequence[Line], output: Path, notes: Sequence[str]) -> None:
    """The table in its three forms; the page, which has links to the others, comes last."""
    as_json = json.dumps([asdict(line) for line in lines], indent=1) + "\n"
    write_together({output / TABLE: _as_csv(lines), output / TABLE_JSON: as_json})
    write_whole(output / PAGE, _page(lines, output, notes).write)


def _as_csv(lines: Sequence[Line]) -> str:
    out = io.StringIO(newline="")
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(_columns())
    for line in lines:
        rows.writerow([for_table(v) if isinstance(v, str) else v for v in asdict(line).values()])
    return out.getvalue()


def _columns() -> list[str]:
    return [each.name for each in fields(Line)]


def _page(lines: Sequence[Line], output: Path, notes: Sequence[str]) -> Report:
    page = Report("Many sequences")
    page.text(f"{summary(lines)}.")
    for note in notes:
        page.text(note)
    troubled = [line for line in lines if line.error]
    if troubled:
        page.heading("What failed")
        page.table(["Sequence", "State", "Why"], [[line.sequence, line.state, line.error] for line in troubled])
    page.heading("All sequences")
    headers = ["Sequence", "State", "Verdict", "Judged off, %", "Seen well, %"]
    rows = [
        [
            line.sequence,
            line.state,
            line.verdict or "",
            _percent(line.judged_off),
            _percent(line.seen_well),
            *(line.submaps, line.frames, line.keyframes, line.aligned, line.vertices, line.seconds),
        ]
        for line in lines
    ]
    page.table([*headers, "Maps", "Frames", "Keyframes", "Aligned", "Vertices", "Seconds"], rows)
    page.text(
        "Judged off: by how much of its distance the judge of each run puts the wall from the surface, without truth. "
        "Seen well: how much of the wall was. Seconds: of the process that finished the sequence."
    )
    page.files(output, _FILES, of_a_run=False)
    return page


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
