"""`--dry-run`: all that is read is checked, what would be done is said, and nothing is written.

The verbs in VERBS take it. What opens their run folder (`reporting.run.run_folder`, and train's own) makes nothing
then, and the verb ends with `Planned` where its work would begin.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextvars import ContextVar
from dataclasses import asdict, dataclass

from lightdepth.command_line.heartbeat import duration

VERBS = frozenset(
    {
        *("import", "train", "adapt", "predict", "sparse", "densify", "batch", "live"),
        *("bench", "bench per-frame", "bench completion", "bench speed"),
    }
)
DRY: ContextVar[bool] = ContextVar("dry", default=False)
"""Of the call of the command that is at work."""
DRY_RUN = """Check all that is read, say what would be done and about how long it takes, and write nothing. Without it,
the work is done."""


def is_dry() -> bool:
    """Whether nothing is to be done but to say what would be."""
    return DRY.get()


@dataclass(frozen=True)
class Step:
    """A piece of the work."""

    what: str
    """in words, with how much of it there is"""
    seconds: float | None = None
    """about, on this machine; None where nothing tells"""

    def __str__(self) -> str:
        return f"{self.what}: {'time not known' if self.seconds is None else f'about {duration(self.seconds)}'}"


class Planned(Exception):
    """A dry run is at its end: what would be done is known. Exit code 0."""

    def __init__(self, said: Sequence[str], steps: Sequence[Step], output: str) -> None:
        super().__init__(said, steps, output)
        self.said, self.steps, self.output = tuple(said), tuple(steps), output

    @property
    def seconds(self) -> float | None:
        """Of the steps whose time is known; None where that of none is."""
        known = [step.seconds for step in self.steps if step.seconds is not None]
        return sum(known) if known else None

    def __str__(self) -> str:
        lines = [*self.said, *(f"  {step}" for step in self.steps)]
        if self.seconds is None:
            lines.append("how long it takes cannot be told beforehand")
        else:
            more = ", besides what is not known" if any(step.seconds is None for step in self.steps) else ""
            lines.append(f"estimate: {duration(self.seconds)}{more}, as this machine is now; an estimate, no promise")
        return "\n".join(lines)

    def record(self) -> dict[str, object]:
        """For --json."""
        said = {"would": list(self.said), "steps": [asdict(step) for step in self.steps]}
        return {"dry_run": True, "output": self.output, **said, "estimated_seconds": self.seconds}
