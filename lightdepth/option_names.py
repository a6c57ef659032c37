"""What options are called where an error advises one: by the verb at work, as `--camera`, or `--data.camera` in train.

Who finds that a calibration is lacking, a reader of frames, does not know which verb asked for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_GROUP: ContextVar[str] = ContextVar("group", default="")


def option(name: str) -> str:
    """An option of those that say what frames are read, and how: camera, light, mask, format, bit-depth."""
    return f"--{_GROUP.get()}{name}"


@contextmanager
def options_below(group: str) -> Iterator[None]:
    """Within it the verb's options of that kind lie below a group, as in `--data.camera`."""
    before = _GROUP.set(f"{group}.")
    try:
        yield
    finally:
        _GROUP.reset(before)
