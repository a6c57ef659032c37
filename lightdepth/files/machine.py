"""What the machine does wrong: a full disk, a folder that is gone, memory that ran out; told apart from bad input.

Python and the libraries say these in many ways; here each becomes one sentence, with the disk and what is free on it.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from pathlib import Path

from lightdepth.errors import InputError, MachineFailure, PartialFailure

FAILS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EFBIG: "a file grew beyond the size that is allowed here",
    errno.EIO: "the disk could not be read or written",
    errno.EROFS: "the disk is read-only",
    errno.ESTALE: "the folder is gone from its server",
    errno.ENODEV: "the disk is gone",
    errno.ENXIO: "the disk is gone",
    errno.ENOTCONN: "the server of the folder does not answer",
    errno.ETIMEDOUT: "the server of the folder does not answer",
    errno.ENOMEM: "the memory is used up",
    errno.EMFILE: "too many files are open",
    errno.ENFILE: "too many files are open",
}
"""What no other input would cure, by the number that the system gives."""

_FULL = 1 << 16
"""A disk with less room than this, in bytes, when a writer failed: then that is why. Libraries do not always say, but
what they wrote of their file has filled the disk."""

_NUMBER = re.compile(r"\(os error (\d+)\)")
"""Where libraries in Rust (safetensors) say the number that the system gave; their errors are no OSError."""

_WORDS = {"database or disk is full": errno.ENOSPC, "disk I/O error": errno.EIO}
"""What SQLite says instead of a number, in errors of sqlite3 and of those who use it."""

_MEMORY = ("can't allocate memory", "out of memory", "Insufficient memory", "Cannot allocate memory", "bad_alloc")


def machine_failure(
    error: BaseException, folder: Path | None = None, kept: str = "", place: Path | None = None
) -> MachineFailure | None:
    """The failure of the machine that `error` tells of, or None. `folder` is where the work was being written,
    hidden, and `place` where it was to come to; `kept` is a sentence on what is left of it."""
    if isinstance(error, MachineFailure):
        said = str(error)
        return MachineFailure(". ".join(filter(None, (said, kept)))) if kept not in said else error
    reason = _reason(error, folder)
    if reason is None:
        return None
    named = getattr(error, "filename", None)
    named = None if isinstance(named, int) else named  # a descriptor says nothing to a reader
    if reason == FAILS[errno.ENOMEM]:
        return MachineFailure(". ".join(filter(None, (reason, kept))))
    where = Path(os.fsdecode(named)) if named is not None else folder or place
    if where is None:
        return MachineFailure(". ".join(filter(None, (reason, kept))))
    inside = folder is not None and where.is_relative_to(folder)
    said = f"{place if inside and place else where}: {reason}{_room(where)}"
    return MachineFailure(". ".join(filter(None, (said, kept))))


def is_lost() -> bool:
    """Whether the folder that the process is in is gone, so that no name without a folder means anything."""
    try:
        os.getcwd()
    except OSError:
        return True
    return False


def _reason(error: BaseException, folder: Path | None) -> str | None:
    if isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(sign in str(error) for sign in _MEMORY)
    ):
        return FAILS[errno.ENOMEM]
    if isinstance(error, FileNotFoundError) and is_lost():
        return "the folder that you are in is gone"
    if isinstance(error, OSError) and error.errno in FAILS:
        return FAILS[error.errno]
    if (said := _said(error)) in FAILS:
        return FAILS[said]
    if folder is None or isinstance(error, InputError | PartialFailure) or not isinstance(error, Exception):
        return None
    if not folder.is_dir():
        return "the folder that was being written to is gone"
    try:
        full = shutil.disk_usage(folder).free < _FULL
    except OSError:
        return FAILS[errno.EIO]
    return FAILS[errno.ENOSPC] if full else None


def _said(error: BaseException) -> int:
    """The system's number that a library tells of in words; 0 where it tells of none."""
    if isinstance(error, InputError | PartialFailure | OSError) or not isinstance(error, Exception):
        return 0
    found = _NUMBER.search(str(error))
    return int(found[1]) if found else next((n for words, n in _WORDS.items() if words in str(error)), 0)


def _room(path: Path) -> str:
    for place in (path, *path.parents):
        try:
            return f" ({shutil.disk_usage(place).free / 1e6:.1f} MB are free)"
        except OSError:
            continue
    return ""
