"""Output whose reader may leave: `lightdepth densify ... | head -1` takes one line, and the work goes on without it.

So it does where the words cannot be written for another reason (the disk of a log is full), which the end tells of.
"""

from __future__ import annotations

import errno
import io
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from lightdepth.errors import MachineFailure

_GONE = (errno.EPIPE, errno.EIO)
"""A pipe whose reader left, and a terminal that was closed."""


class Outliving:
    """A text stream that goes on, into nothing, when whoever reads it is gone or it can hold no more."""

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.failed: OSError | None = None
        self.heard = time.monotonic()
        """when something was written last"""

    def write(self, text: str) -> int:
        self.heard = time.monotonic()
        try:
            return self._stream.write(text)
        except OSError as error:
            self._leave(error)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._leave(error)

    def _leave(self, error: OSError) -> None:
        """What is still in the stream's buffer, and all that follows, goes where nobody reads: Python writes the
        buffer once more when it ends."""
        if error.errno not in _GONE:
            self.failed = self.failed or error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def fill_closed_streams() -> None:
    """Opens what was closed before the program began (`>&-`) onto nothing: Python has no stream there, and the next
    file that is opened would get its number, and with it what libraries print."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it takes the lowest free number: this one
    sys.stdout = sys.stdout or io.TextIOWrapper(io.FileIO(1, "w", closefd=False), "utf-8")
    sys.stderr = sys.stderr or io.TextIOWrapper(io.FileIO(2, "w", closefd=False), "utf-8")


@contextmanager
def outliving_readers() -> Iterator[None]:
    """Within it a reader of standard output or error who leaves ends no run. Raises MachineFailure at the end of the
    block where what was said could not be written for another reason."""
    streams = sys.stdout, sys.stderr
    ours = tuple(Outliving(stream) for stream in streams)
    sys.stdout, sys.stderr = ours
    try:
        yield
    finally:
        for stream in ours:
            stream.flush()
        sys.stdout, sys.stderr = streams
    for stream, name in zip(ours, ("standard output", "standard error"), strict=True):
        if stream.failed is not None:
            reason = stream.failed.strerror or stream.failed
            raise MachineFailure(f"{name}: {reason}. What was said is not all there; what was made is")
