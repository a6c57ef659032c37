"""What a run that can be resumed notes while it goes: what it was begun with, and which parts of it are finished.

`begun.json` is written once, `parts.jsonl` has a line for each finished part, brought to the disk after the part's
files. A line that is torn counts as not written. Both are gone from the finished run.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lightdepth.files.replacing import BEGUN, PARTS, below
from lightdepth.files.writing import sync, write_whole

LOG = "log.txt"


@dataclass(frozen=True)
class Part:
    """A finished part: its files with their sizes in bytes, what it reported, and what the verb kept of it."""

    name: str
    files: dict[str, int] = field(default_factory=dict)
    failures: list[dict[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    kept: Any = None


def begin(folder: Path, begun: Mapping[str, Any]) -> None:
    """Notes what a run is begun with; for the user's eyes only, as it names the inputs."""
    path = folder / BEGUN
    write_whole(path, json.dumps(begun) + "\n")
    path.chmod(0o600)


def begun_with(folder: Path) -> dict[str, Any] | None:
    """What an unfinished run was begun with, or None where there is none that can be resumed."""
    if not (folder / BEGUN).is_file():
        return None
    try:
        found = json.loads((folder / BEGUN).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not (isinstance(found, dict) and isinstance(found.get("verb"), str)):
        return None
    groups = [found.get("arguments") or {}, found.get("inputs") or {}]
    whole = all(isinstance(group, dict) for group in groups) and all(isinstance(v, dict) for v in groups[1].values())
    return found if whole else None


def add_part(folder: Path, part: Part, files: Iterable[Path]) -> None:
    """Brings a part's files to the disk, then the line that says that it is finished."""
    places = set()
    for file in files:
        sync(file)
        places.add(file.parent)
    for place in places:
        sync(place)
    with (folder / PARTS).open("a", encoding="utf-8", errors="surrogateescape") as out:
        out.write(json.dumps(asdict(part)) + "\n")
        out.flush()
        os.fsync(out.fileno())


def finished_parts(folder: Path) -> dict[str, Part]:
    """The finished parts whose files are all there, by name, in the order in which they were finished. None where a
    link is among the files, which no run makes: what goes on would write to where it leads."""
    if any(path.is_symlink() for path in below(folder)):
        return {}
    try:
        lines = (folder / PARTS).read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    except OSError:
        return {}
    parts: dict[str, Part] = {}
    for line in lines[:-1]:  # what follows the last end of a line is torn
        try:
            part = Part(**json.loads(line))
            if all(_size(folder / name) == size for name, size in part.files.items()):
                parts[part.name] = part
        except (ValueError, TypeError, AttributeError, RecursionError):
            continue
    return parts


def clean(folder: Path, parts: Mapping[str, Part]) -> None:
    """Removes what belongs to no finished part, so that the rest is made as if for the first time."""
    ours = {name for part in parts.values() for name in part.files} | {BEGUN, PARTS, LOG}
    for place, _, names in os.walk(folder, topdown=False):
        for name in names:
            path = Path(place) / name
            if str(path.relative_to(folder)) not in ours:
                path.unlink()
        if place != str(folder) and not any(Path(place).iterdir()):
            os.rmdir(place)
    lines = "".join(json.dumps(asdict(part)) + "\n" for part in parts.values())
    write_whole(folder / PARTS, lines)


def new_files(folder: Path, known: Iterable[str]) -> dict[str, int]:
    """The files below a run folder in the making that no part has yet, with their sizes in bytes."""
    past = {*known, BEGUN, PARTS, LOG}
    found = {}
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place) / name
            inside = str(path.relative_to(folder))
            if inside not in past:
                found[inside] = path.stat().st_size
    return found


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None
