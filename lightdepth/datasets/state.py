"""What tells, without reading them, whether the frames of a source are those of another day."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from lightdepth.datasets.endomapper import cluster_of
from lightdepth.datasets.source import SequenceSource


def identity_of(source: SequenceSource) -> str:
    """Which source it is: where it lies, and how it is read."""
    options = {field.name: getattr(source, field.name) for field in fields(source) if field.name != "data"}
    return repr((str(Path(source.data).resolve()), options))


def state_of(source: SequenceSource) -> str:
    """A hash of the names, sizes and times of all files of a source, whatever they are: any that comes, goes or is
    written makes another one. Hidden files, and what is above the source's folder, are not looked at."""
    roots = [path for path in source.files.values() if path is not None]
    cluster = cluster_of(source.data)
    if cluster is not None:  # its images lie beside it
        roots.append(cluster[0])
    found = hashlib.sha256()
    for root in roots:
        for name, file in sorted(_files(root)):
            told = file.stat()
            # Whoever sets the time of writing back cannot set that of the change.
            found.update(
                repr((name, told.st_size, told.st_mtime_ns, told.st_ctime_ns)).encode("utf-8", "surrogateescape")
            )
    return found.hexdigest()


def _files(root: Path) -> Iterator[tuple[str, Path]]:
    """The files of a path with their names below it; links are followed, but not in circles."""
    if not root.is_dir():
        if root.is_file():
            yield root.name, root
        return
    seen = set()
    for place, folders, names in os.walk(root, followlinks=True):
        real = os.path.realpath(place)
        folders[:] = [name for name in folders if not name.startswith(".") and real not in seen]
        if real in seen:
            continue
        seen.add(real)
        for name in names:
            path = Path(place) / name
            if not name.startswith(".") and path.is_file():
                yield os.path.relpath(path, root), path
