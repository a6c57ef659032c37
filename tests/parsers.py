"""How a kind of file that strangers hand in is read, with small samples of it to spoil. `strangers.py` has them all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

Files = Mapping[str, bytes]


@dataclass(frozen=True)
class Sample:
    """Files by their path in a folder, and the one of them that is to be spoilt."""

    files: Files
    target: str

    @property
    def content(self) -> bytes:
        return self.files[self.target]


@dataclass(frozen=True)
class Parser:
    """How a kind of file is read."""

    name: str
    read: Callable[[Path], object]
    """reads the file that was spoilt"""
    samples: Callable[[], list[Sample]]
    handed_in: bool = True
    """whether strangers hand it in: calibrations, maps, archives, pictures, videos, weights"""
    repaired: Callable[[bytes], bytes] = bytes
    """what brings checksums in order again, behind which nothing else would be reached"""


PARSERS: dict[str, Parser] = {}


def parser(name: str, read: Callable[[Path], object], handed_in: bool = True, **more: Any) -> Callable[[Any], Any]:
    """The function below writes samples into the folder that it is given, and names those to be spoilt."""

    def add(write: Callable[[Path], list[str]]) -> Callable[[Path], list[str]]:
        @cache
        def samples() -> list[Sample]:
            with temporary() as folder:
                targets = write(folder)
                files = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
                return [Sample(files, target) for target in targets]

        PARSERS[name] = Parser(name, read, samples, handed_in, **more)
        return write

    return add


@contextmanager
def temporary() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def around(depth: int, read: Callable[[Path], object]) -> Callable[[Path], object]:
    """Reads the folder `depth` steps above the file that was spoilt."""
    return lambda path: read(path.parents[depth - 1])
