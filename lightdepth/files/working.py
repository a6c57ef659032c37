"""A folder for what a run makes on its way and nobody keeps. What killed runs left goes with the next run's."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lightdepth.files.writing import is_of_the_dead, our_mark

_NAME = ".lightdepth-work-"


@contextmanager
def working_folder(beside: Path | None = None) -> Iterator[Path]:
    """A new folder within `beside`, from where its files reach their places by a rename; left out, where the system
    keeps passing files. It is removed at the end, as are folders of dead processes of this machine and user."""
    place = Path(tempfile.gettempdir()) if beside is None else beside
    for left in place.glob(f"{_NAME}*"):
        with suppress(OSError):
            if is_of_the_dead(left.name, _NAME) and not left.is_symlink() and left.lstat().st_uid == _user():
                shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=f"{_NAME}{our_mark()}", dir=place) as folder:
        yield Path(folder)


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0  # where there is none, lstat says 0 too
