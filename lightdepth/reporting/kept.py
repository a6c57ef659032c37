"""A step of a run that is a finished part: what it gave is kept, and read back when the run is resumed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from lightdepth.files.packed import read_packed, write_packed
from lightdepth.reporting.run import Run

T = TypeVar("T")


def kept(
    run: Run,
    part: str,
    kind: type[T],
    make: Callable[[], T],
    given: Mapping[type, object] | None = None,
    folder: Path | None = None,
) -> T:
    """What `make` gives, or gave before the run was stopped. `given` as for read_packed; below `folder` are files that
    it wrote for the user."""
    file = run.state / f"{part}.npz"
    if run.done(part):
        return read_packed(file, kind, given)
    made = make()
    if run.resumable:
        file.parent.mkdir(exist_ok=True)
        write_packed(file, made, given)
        run.finish_part(part, [file, *(p for p in (folder.rglob("*") if folder else ()) if p.is_file())])
    return made
