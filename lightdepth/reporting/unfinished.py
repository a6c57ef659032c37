"""What a run that can be resumed notes while it goes: what it was begun with, and which parts of it are finished.

`begun.json` is written once, `parts.jsonl` has a line for each finished part, brought to the disk after the part's
files. Every line ends in a seal, a hash of what it says and of the seal before it: a line that is torn, damaged or gone
counts as not written, and so do all behind it, which may go on from what it said. Both are gone from the finished run.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lightdepth.errors import AlreadyFinished, InputError
from lightdepth.files.replacing import (
    BEGUN,
    PARTS,
    below,
    check_apart,
    check_replaceable,
    clear_notes,
    replace,
    stamp,
)
from lightdepth.files.writing import sync, write_whole
from lightdepth.reporting.same import check_finished

LOG = "log.txt"

_SEAL = re.compile(rb'"seal": "([0-9a-f]{16})"}\n$')


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
    before = _last_seal(folder / PARTS)
    with (folder / PARTS).open("a", encoding="utf-8", errors="surrogateescape") as out:
        out.write(_sealed(part, before)[0])
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
    seal = ""
    for line in lines[:-1]:  # what follows the last end of a line is torn
        try:
            said = json.loads(line)
            said.pop("seal")
            part = Part(**said)
            again, seal = _sealed(part, seal)
            if again != f"{line}\n":
                break
            if all(_size(folder / name) == size for name, size in part.files.items()):
                parts[part.name] = part
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError):
            break
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
    lines, seal = [], ""
    for part in parts.values():
        line, seal = _sealed(part, seal)
        lines.append(line)
    write_whole(folder / PARTS, "".join(lines))


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


def put_finished(made: Path, output: Path, verb: str, arguments: Mapping[str, Any], inputs: Iterable[Path]) -> None:
    """The run that is asked for takes the place of an older one, where it was killed at its last step, whole. Raises
    AlreadyFinished then."""
    try:
        check_finished(made, verb, arguments)
    except InputError:
        return  # of another run
    except AlreadyFinished:
        check_apart(output, inputs)
        check_replaceable(output, verb)
        clear_notes(made)
        replace(made, output, stamp(output))
    raise AlreadyFinished(f"{output.name} was finished by an earlier run, which was killed at its last step")


def _sealed(part: Part, before: str) -> tuple[str, str]:
    """The line of a part, and its seal; `before` is the seal of the line before it."""
    said = asdict(part)
    seal = hashlib.sha256(f"{before}{json.dumps(said)}".encode()).hexdigest()[:16]
    return f"{json.dumps({**said, 'seal': seal})}\n", seal


def _last_seal(path: Path) -> str:
    """The seal of the last line that was written; empty where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 64))
            found = _SEAL.search(file.read())
    except OSError:
        return ""
    return "" if found is None else found[1].decode()


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None
