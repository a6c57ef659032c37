"""One door for whatever parses a file: what a parser or a library raises there is the file's fault, and is told so.

Strangers' files make libraries raise what no caller can foresee: `OverflowError` of a size of twenty digits,
`RecursionError` of brackets in one another, `NotImplementedError` of a zip's method. `reading` turns all of them into
an InputError that names the file. Four pass through: an InputError, which says more; a failed assert of ours, which is
our own mistake; a warning that was made an error; and what the machine does wrong, such as a disk that is gone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from lightdepth.counting import with_article
from lightdepth.errors import InputError, MachineFailure
from lightdepth.files.machine import FAILS

_OURS = ("lightdepth", "densify", "train")
_WORDS = 160  # characters of a library's message: some quote the whole file

LARGEST_NUMBER = 1e12
"""Coordinates and parameters beyond it are of a broken file: their squares and products leave single precision."""
MOST_PIXELS = 2**25
"""Pixels of one picture: 8192 x 4096 (8K video fits). A larger one is refused by its header, before it is decoded."""
LONGEST_SIDE = 65535
"""Pixels of a picture's or a camera's side."""
MOST_TEXT = 16 << 20
"""Bytes of a calibration or another small text: nerfstudio's with ten thousand frames has as many."""


@contextmanager
def reading(
    path: str | Path, what: str = "a readable file", cure: str = "copy it again, or leave it out"
) -> Iterator[None]:
    """The block reads `path`, which should be `what`. Raises InputError for whatever is raised in it."""
    try:
        yield
    except (InputError, MachineFailure, Warning):
        raise
    except AssertionError as error:
        if _raised_by_us(error.__traceback__):
            raise
        raise InputError(path, f"not {what} ({said(error)})", cure) from error
    except OSError as error:
        if error.errno in FAILS:
            error.filename = error.filename or str(path)  # a file that is open already says no name
            raise
        raise InputError(
            error.filename or path,
            f"cannot be read ({error.strerror or said(error)})",
            "expected a file that is there and may be read" if error.errno else cure,
        ) from error
    except EOFError as error:
        raise InputError(path, "cannot be read (it ends too early)", cure) from error
    except MemoryError as error:
        raise InputError(path, "it needs more memory than there is", cure) from error
    except RecursionError as error:
        raise InputError(path, "its parts are nested without end", cure) from error
    except Exception as error:  # whatever a broken file makes a parser stumble over
        raise InputError(path, f"not {what} ({said(error)})", cure) from error


def said(error: BaseException) -> str:
    """What an error says, in one short line."""
    words = " ".join(str(error).split())
    words = "".join(c if c.isprintable() else "?" for c in words)
    short = words if len(words) <= _WORDS else f"{words[:_WORDS]}..."
    return f"{type(error).__name__}: {short}" if short else type(error).__name__


def check_pixels(width: int, height: int, where: str | Path) -> None:
    """Raises InputError where a picture of this size is none that is decoded."""
    if width < 1 or height < 1 or max(width, height) > LONGEST_SIDE or width * height > MOST_PIXELS:
        raise InputError(
            where,
            f"a picture of {brief(width)}x{brief(height)}",
            f"expected up to {MOST_PIXELS} pixels (8192x4096)",
        )


def check_bytes(size: int, most: int, where: str | Path, what: str = "file") -> None:
    """Raises InputError where a file of `what` is too large to be one."""
    if size > most:
        raise InputError(where, f"{size} bytes", f"expected {with_article(what)} of at most {most} bytes")


def brief(number: int) -> str:
    """A whole number, or how many digits it has where these are too many to print."""
    return str(number) if abs(number) < 10**15 else "more than 10^15"


def _raised_by_us(traceback: TracebackType | None) -> bool:
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    name = "" if traceback is None else str(traceback.tb_frame.f_globals.get("__name__", ""))
    return name.split(".")[0] in _OURS
