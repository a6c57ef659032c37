"""What is below a folder of inputs, without what this program wrote there: an output may lie inside its input."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from lightdepth.files.replacing import RECORD, hidden, read_record

_MAKES_INPUTS = ("synth", "import", "sparse", "demo", "export")
"""Verbs whose run folders are data and maps for others; those of all other verbs are results."""


def is_result(folder: Path) -> bool:
    """Whether a folder holds what a verb made of other data, or is hidden and in the making."""
    if hidden(folder):
        return True
    record = read_record(folder) if (folder / RECORD).is_file() else None
    return record is not None and record["verb"] not in _MAKES_INPUTS


def files_below(root: Path, without: Path | None = None) -> list[Path]:
    """The files below a folder in order; those in results, and in `without` (resolved), are passed over."""
    found = []
    for place, folders, names in os.walk(root):
        here = Path(place)
        folders[:] = [name for name in folders if not _passed_over(here / name, without)]
        found += [here / name for name in names if not hidden(here / name) and (here / name).is_file()]
    return sorted(found)


def folders_in(root: Path) -> list[Path]:
    """The folders in a folder in order, results passed over."""
    return sorted(p for p in root.iterdir() if p.is_dir() and not is_result(p))


def given(paths: Iterable[Path], root: Path) -> list[Path]:
    """Those of several paths below `root` that no run of this program wrote there; all, where it wrote all."""
    paths = [path for path in paths if not any(map(hidden, (path, *_between(path, root))))]
    foreign = [path for path in paths if not any(read_record(folder) for folder in _between(path, root))]
    return foreign or paths


def _between(path: Path, root: Path) -> list[Path]:
    """The folders above a path that are below `root`."""
    return [folder for folder in path.parents if folder != root and folder.is_relative_to(root)]


def _passed_over(folder: Path, without: Path | None) -> bool:
    return is_result(folder) or (without is not None and folder.resolve() == without)
