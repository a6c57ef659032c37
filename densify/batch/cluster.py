"""Shares of the units as jobs of a Slurm array, by submitit (extra `slurm`).

A job that is pre-empted or runs out of time is queued again, and goes on: what is done is there.
"""

from __future__ import annotations

import logging
import re
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Generic, TypeVar

from densify.batch.workers import COUNTED, Lost, counted_threads, pinned_threads
from lightdepth.errors import InputError
from lightdepth.ranges import COUNT, above, at_least, checked

Task = TypeVar("Task")
Result = TypeVar("Result")

_POLL_S = 2.0
_RAISED = re.compile(r"[A-Za-z_][\w.]*(Error|Exception|Interrupt|Exit)\b")
"""The line of a trace that says what was raised."""


@dataclass(frozen=True)
class Gone(Lost):
    """A job ended without an answer."""

    said: str = ""

    def __str__(self) -> str:
        return f"its job ended: {self.said}"


@dataclass(frozen=True)
@checked
class SlurmConfig:
    """What Slurm gives to each job of the array."""

    partition: str | None = None
    """Partition of the cluster that the jobs go to; left out, the cluster's own default."""
    account: str | None = None
    """Account that the jobs are charged to; left out, your own default."""
    minutes: Annotated[int, COUNT] = 240
    """Longest time of a job, minutes; one that runs longer is queued again and goes on. More wait longer in the queue,
    and begin anew less often."""
    memory_gb: Annotated[float, above(0)] = 8.0
    """Memory of a job, gigabytes. More are needed for long sequences and large frames."""
    gpus: Annotated[int, at_least(0)] = 0
    """Number of GPUs of a job, on one of which the network runs (--device cuda or auto). More than 1 are of no use."""


class Share(Generic[Task, Result]):
    """What a job does: a class, because it is pickled to where the job runs."""

    def __init__(self, start: Callable[[], Callable[[Task], Result]], tasks: Sequence[Task], threads: int) -> None:
        self.start, self.tasks, self.threads = start, tasks, threads

    def __call__(self) -> list[Result]:
        with pinned_threads(self.threads), _putting_down():
            work = self.start()
            return [work(task) for task in self.tasks]

    def checkpoint(self) -> Any:
        """What submitit queues again: the same, which finds done what is done."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


@contextmanager
def _putting_down() -> Iterator[None]:
    """Within it SIGTERM, by which Slurm says that a job's time is over before it kills it, ends the job in order: what
    is half done is taken away, and its lock with it."""

    def end(number: int, frame: FrameType | None) -> None:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def check_cluster() -> None:
    """Raises InputError, before any work, where jobs cannot be handed to Slurm."""
    _submitit()
    if shutil.which("srun") is None or shutil.which("sbatch") is None:
        raise InputError(
            "--executor slurm", "no sbatch or srun here", "run it where jobs are submitted, or leave it out"
        )


def submitted(
    shares: Sequence[Sequence[Task]],
    start: Callable[[], Callable[[Task], Result]],
    config: SlurmConfig,
    folder: Path,
    threads: int = 1,
    cluster: str = "slurm",
) -> Iterator[tuple[Task, Result | Lost]]:
    """Each task with what came of it, when its share is done. `folder` holds what submitit passes to the jobs and their
    logs; `cluster` is submitit's name for where they run."""
    executor = _submitit().AutoExecutor(folder=folder, cluster=cluster)
    executor.update_parameters(**_parameters(config, threads, cluster))
    waiting: list[tuple[Any, Sequence[Task]]] = []
    try:
        with counted_threads(threads), executor.batch():
            waiting = [(executor.submit(Share(start, tasks, threads)), tasks) for tasks in shares if tasks]
        while waiting:
            for job, tasks in [pair for pair in waiting if pair[0].done()]:
                waiting.remove((job, tasks))
                yield from zip(tasks, _answers(job, len(tasks)), strict=True)
            if waiting:
                time.sleep(_POLL_S if cluster == "slurm" else 0.05)
    finally:
        for job, _ in waiting:
            job.cancel(check=False)


def _answers(job: Any, count: int) -> list[Any]:
    error = job.exception()
    if error is not None:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        said = next((line for line in reversed(lines) if _RAISED.match(line)), lines[0])
        return [Gone(None, said.strip())] * count
    found: list[Any] = job.result()
    return found


def _parameters(config: SlurmConfig, threads: int, cluster: str) -> dict[str, object]:
    given: dict[str, object] = {"timeout_min": config.minutes, "name": "lightdepth-batch"}
    if cluster != "slurm":
        return given
    given |= {"cpus_per_task": threads, "mem_gb": config.memory_gb, "slurm_signal_delay_s": 120}
    exports = [f"export {library}_NUM_THREADS={threads}" for library in COUNTED]
    given["slurm_setup"] = [*exports, "export OMP_WAIT_POLICY=passive"]
    if config.gpus:
        given["gpus_per_node"] = config.gpus
    named = {"slurm_partition": config.partition, "slurm_account": config.account}
    return given | {name: value for name, value in named.items() if value is not None}


def _submitit() -> Any:
    try:
        import submitit
    except ImportError as error:
        raise InputError("--executor slurm", "submitit is not installed", "pip install 'lightdepth[slurm]'") from error
    logging.getLogger("submitit").setLevel(logging.ERROR)
    return submitit
