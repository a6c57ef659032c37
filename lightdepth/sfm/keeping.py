"""The database of a mapping that may be stopped: a copy goes to the disk every minute, and the next run begins with it.

A copy holds whole pieces: features of so many images, matches of so many pairs. COLMAP's own file is no such thing: it
is not brought to the disk while it is written.
"""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing
from pathlib import Path

from lightdepth.reporting.run import Run

SECONDS = 60.0
"""Work that a killed run may lose: a copy may have a gigabyte."""


class KeptDatabase:
    """`features` images and `matches` pairs are done. `name` tells mappings of one run apart."""

    def __init__(self, run: Run | None = None, name: str = "matching") -> None:
        self._run, self._name = run, name
        self._last: Path | None = None
        self._since = time.monotonic()
        self.features = self.matches = 0

    def restore(self, database: Path) -> None:
        """Puts the last copy in place, where there is one."""
        if self._run is not None and self._run.done(self._name):
            self.features, self.matches = self._run.kept_of(self._name)
            self._last = self._copy()
            _copied(self._last, database)

    def keep(self, database: Path, features: int = 0, matches: int = 0, now: bool = False) -> None:
        """So many are done now; a copy is made where a minute has passed since the last one, or `now`."""
        self.features, self.matches = max(self.features, features), max(self.matches, matches)
        if self._run is None or not self._run.resumable or not (now or time.monotonic() - self._since >= SECONDS):
            return
        before, copy = self._last, self._copy()
        if copy == before:
            return
        copy.parent.mkdir(exist_ok=True)
        _copied(database, copy)
        self._run.finish_part(self._name, [copy], [self.features, self.matches])
        self._last = copy
        if before is not None:
            before.unlink()  # its line says that it is gone: the new one counts
        self._since = time.monotonic()

    def _copy(self) -> Path:
        assert self._run is not None
        return self._run.state / f"{self._name} {self.features} {self.matches}.db"


def _copied(database: Path, copy: Path) -> None:
    copy.unlink(missing_ok=True)
    with closing(sqlite3.connect(database)) as one, closing(sqlite3.connect(copy)) as other:
        one.backup(other)
