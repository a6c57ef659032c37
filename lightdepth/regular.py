"""Only regular files are opened: a named pipe, a socket or a device that is named like one would be waited for without
end, or never stop giving."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from lightdepth.errors import InputError

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def regular(path: str | Path, expected: str = "expected the file itself") -> Path:
    """The path, of which it is known that opening it waits for nobody. Raises InputError where it is there and is no
    regular file, ending with what was `expected`; what is not there is left to whoever opens it."""
    kind = irregular(path)
    if kind:
        raise InputError(path, f"{kind}, not a file", expected)
    return Path(path)


def irregular(path: str | Path) -> str:
    """What stands at a path in place of a file, in words; "" where a regular file or nothing is there."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # not there, no right to look, or no name at all (a zero byte)
        return ""
    return next((words for is_one, words in _KINDS if is_one(mode)), "")
