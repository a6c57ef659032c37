"""What a user can do wrong, told apart from what we did wrong.

`InputError` is for the user's files and numbers: it says where, what was found there, and what would be right. The
command line prints it without a traceback and exits with 3. Our own mistakes stay asserts.
"""

from __future__ import annotations

import signal
from pathlib import Path


class InputError(ValueError):
    """Input that cannot be used: missing, unreadable, or contradicting itself. Printed as `where: found; cure`."""

    where: str
    """The file, option or thing that it is about; a place inside it follows after a colon."""
    found: str
    """What was found there, with its value."""
    cure: str
    """What would be right, or what to do: `expected ...`, `give ...`, or a question that leads there."""

    def __init__(self, where: str | Path, found: str, cure: str) -> None:
        super().__init__(str(where), found, cure)  # all three in args: a copy or a pickle is made from them
        self.where, self.found, self.cure = self.args
        assert self.where and found and cure, "an InputError says where, what was found, and the cure"

    def __str__(self) -> str:
        return f"{self.where}: {self.found}; {self.cure}"

    def within(self, outer: str | Path) -> InputError:
        """The same error, told of a place inside `outer`, such as the file that the wrong number is in."""
        return InputError(f"{outer}: {self.where}", self.found, self.cure)


class MissingOption(InputError):
    """An option that has to be given and was not: wrong usage. Exit code 2."""


class InUse(InputError):
    """An output that another run writes to now. Exit code 3; `batch` leaves it to that run."""


class WrongUsage(SystemExit):
    """Wrong words on the command line, of which a line has told. Exit code 2."""

    found: str
    """What is wrong with them."""
    cure: str
    """Where to read on, or empty."""

    def __init__(self, found: str, cure: str = "") -> None:
        super().__init__(2)
        self.found, self.cure = found, cure


class PartialFailure(RuntimeError):
    """Part of the work failed; the rest was done and written. Exit code 4; `run.json` says what failed."""


class Interrupted(BaseException):
    """A signal asked the program to end. Exit code 128 + its number; cleaning up comes first."""

    signal: int
    """Its number."""
    kept: str
    """What is kept and how to go on, or empty."""

    def __init__(self, signal: int, kept: str = "") -> None:
        super().__init__(signal, kept)
        self.signal, self.kept = self.args

    def __str__(self) -> str:
        kept = self.kept or "nothing half-written is left; the same command begins anew"
        return f"stopped by {signal.Signals(self.signal).name}; {kept}"


class MachineFailure(RuntimeError):
    """The machine failed: a full disk, a folder that is gone, no memory. Exit code 5; says what was kept."""


class AlreadyFinished(Exception):
    """`--resume` of a run that is finished and the same: there is nothing to do. Exit code 0, one line."""
