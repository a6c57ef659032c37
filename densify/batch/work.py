"""A batch: its units made side by side, here or as jobs of a cluster, and what became of all of them."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from densify.batch.cluster import SlurmConfig, check_cluster, submitted
from densify.batch.folder import JOBS, begin, check_ours, in_turn
from densify.batch.make import GOES_ON, TRIES, Ended, Maker, clear_locks, ended_before
from densify.batch.planned import plan_batch
from densify.batch.table import Line, line_of, summary, write_table
from densify.batch.units import Unit, parsed_share, share_of
from densify.batch.workers import Lost, pinned_threads, worked
from lightdepth.command_line.dry import is_dry
from lightdepth.command_line.outcome import is_quiet, outcome
from lightdepth.counting import counted
from lightdepth.errors import InputError, Interrupted
from lightdepth.files.machine import machine_failure
from lightdepth.files.named_inputs import real_inputs, write_inputs
from lightdepth.files.replacing import RECORD, discard
from lightdepth.files.writing import folders_for, our_mark
from lightdepth.foreign_text import for_line
from lightdepth.ranges import COUNT, at_least, checked
from lightdepth.reporting.names import Names, names_of
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.record import write_run_json

_MOST_UNREAD = 10
"""Sequences that cannot be read which have a line each; a manifest of a disk that is not there may have thousands."""


@dataclass(frozen=True)
@checked
class Running:
    """Which sequences are made, by how many processes, and where."""

    shard: str | None = None
    """Share of the sequences to make, I/N: 2/8 makes the second eighth. Shares cost about the same (frames times
    pixels), and all of them may go to the same output, from several machines at once. Left out, all are made."""
    jobs: Annotated[int, at_least(0, up_to=10_000)] = 1
    """Number of processes that are at work at once, each on one sequence and with its own copy of the checkpoint; with
    --executor slurm the number of jobs. More take less time and more memory. 0 works in this process, one sequence
    after the other, and ends with it where a library crashes."""
    threads: Annotated[int, COUNT] = 1
    """Number of threads of each process. More are faster on long sequences, but less so than more jobs, and results are
    then no longer the same to the last bit."""
    executor: Literal["local", "slurm"] = "local"
    """Where the processes run: local, on this machine, or slurm, as an array of jobs that this one waits for (pip
    install 'lightdepth[slurm]')."""
    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    """what each job of --executor slurm is given"""


@dataclass(frozen=True)
class Batch:
    """What a batch is of, and where it goes to."""

    units: Sequence[Unit]
    output: Path
    """With links followed."""
    maker: Maker
    arguments: Mapping[str, object]
    """The options that decide what comes out."""
    notes: Sequence[str] = ()
    """Sentences on the manifest."""


def check_running(running: Running) -> None:
    """Raises InputError, before any work, where what is asked for is not there."""
    parsed_share(running.shard)
    if running.executor == "slurm":
        if running.jobs < 1:
            raise InputError("--jobs", "0, with --executor slurm", "expected the number of jobs, at least 1")
        check_cluster()


def batch_run(batch: Batch, running: Running) -> list[Line]:
    """Makes the units of a share that nobody has made, then the table of all units. Returns the lines of the share."""
    start, output = time.monotonic(), batch.output
    if is_dry():
        plan_batch(batch.units, output, batch.arguments, batch.maker.predicting, running.shard, running.jobs)
    share = share_of(batch.units, parsed_share(running.shard))
    with folders_for([output]), in_turn(output):
        begin(output, batch.arguments)
        check_ours(output)
        before = {unit.name: ended_before(unit, output) for unit in share}
        todo = [unit for unit in share if (one := before[unit.name]) is None or one.state == "failed"]
        if todo:
            (output / RECORD).unlink(missing_ok=True)  # it says that nothing is left to be done
        _write_names(batch)
    of = f" of {len(batch.units)}" if running.shard else ""
    _say(f"{counted(len(share), 'sequence')}{of}, {len(share) - len(todo)} of them already made")
    with _kept():
        ended = {unit.name: one for unit, one in _made(batch, running, todo)}
        with in_turn(output):
            lines = {unit.name: _line(unit, ended.get(unit.name), batch) for unit in batch.units}
            clear_locks((unit for unit in share if lines[unit.name].state == "done"), output)
            write_table(list(lines.values()), output, batch.notes)
            _write_record(batch, list(lines.values()), start)
    _say(summary([lines[unit.name] for unit in share]))
    return [lines[unit.name] for unit in batch.units if unit.name in before]


@contextmanager
def _kept() -> Iterator[None]:
    """What a signal or the machine ends within it is told with how to go on."""
    try:
        yield
    except Interrupted as error:
        error.kept = f"finished sequences are kept: {GOES_ON}"
        raise
    except Exception as error:
        if (failure := machine_failure(error, kept=f"Finished sequences are kept: {GOES_ON}")) is None:
            raise
        raise failure from error


def told_failures(lines: Sequence[Line]) -> list[str]:
    """A sentence for each sequence that failed, as a whole or in part."""
    return [f"{line.sequence}: {line.error}" for line in lines if line.state in ("failed", "in part")]


def _made(batch: Batch, running: Running, todo: Sequence[Unit]) -> Iterator[tuple[Unit, Ended]]:
    """What came of each unit; those whose process died are tried once more, by another one."""
    unread = 0
    with Progress("Sequences", len(todo)) as bar:
        for tries in range(1, TRIES + 1):
            lost = []
            for unit, found in _tried(batch, running, todo):
                if isinstance(found, Lost) and tries < TRIES:
                    _say(f"{unit.name}: {found}; it is tried once more")
                    lost.append(unit)
                    continue
                ended = batch.maker.failed(unit, str(found), tries) if isinstance(found, Lost) else found
                bar.advance()
                unread += bool(unit.trouble)
                if not unit.trouble or unread <= _MOST_UNREAD:
                    _say(f"{bar.done}/{bar.total} {_in_short(unit, ended, batch)}")
                yield unit, ended
            todo = lost
    if unread > _MOST_UNREAD:
        _say(f"{unread - _MOST_UNREAD} more cannot be read: the table has them all")


def _tried(batch: Batch, running: Running, todo: Sequence[Unit]) -> Iterator[tuple[Unit, Ended | Lost]]:
    if not todo:
        return
    if running.executor == "slurm":
        yield from _on_cluster(batch, running, todo)
    elif running.jobs == 0:
        with pinned_threads(running.threads):
            work = batch.maker()
            for unit in todo:
                yield unit, work(unit)
    else:
        yield from worked(todo, batch.maker, running.jobs, running.threads)


def _on_cluster(batch: Batch, running: Running, todo: Sequence[Unit]) -> Iterator[tuple[Unit, Ended | Lost]]:
    above = batch.output / JOBS
    folder = above / f"{our_mark()}{len(todo)}"
    above.mkdir(mode=0o700, exist_ok=True)  # paths of inputs are in it
    shares = [share_of(todo, (i, running.jobs)) for i in range(1, running.jobs + 1)]
    yield from submitted(shares, batch.maker, running.slurm, folder, running.threads)
    discard(folder)
    with suppress(OSError):  # another run's are in it
        above.rmdir()


def _line(unit: Unit, ended: Ended | None, batch: Batch) -> Line:
    """What the files say of a unit, or, where they say nothing, what we saw."""
    names = Names() if batch.maker.keep_names else Names(unit.paths, (batch.output,))
    before = ended_before(unit, batch.output)
    if ended is not None and ended.state == "elsewhere" and (before is None or before.state == "failed"):
        return line_of(unit, ended, batch.output, names)  # it failed before, and another try is made of it
    return line_of(unit, before or ended, batch.output, names)


def _in_short(unit: Unit, ended: Ended, batch: Batch) -> str:
    """A unit in a line for the terminal."""
    if ended.state in ("failed", "elsewhere"):
        return f"{unit.name}: {ended.state}: {ended.error}"
    line = line_of(unit, ended, batch.output, Names())
    parts = [line.verdict or "not judged", counted(line.submaps or 0, "map"), counted(line.frames or 0, "frame")]
    parts += [f"{line.seconds:.0f} s"] if line.seconds is not None else []
    return f"{unit.name}: {', '.join(parts)}{f'; in part: {ended.error}' if ended.error else ''}"


def _write_names(batch: Batch) -> None:
    """Which sequence is behind each name, for the user's eyes only."""
    if not batch.maker.keep_names:
        paths = {name: path for unit in batch.units for name, path in unit.paths.items()}
        write_inputs(batch.output, real_inputs(batch.output) | names_of(batch.arguments).paths | paths)


def _write_record(batch: Batch, lines: Sequence[Line], start: float) -> None:
    """run.json, where nothing is left to be done."""
    if any(line.state in ("waiting", "elsewhere") for line in lines):
        return
    names = Names() if batch.maker.keep_names else names_of(batch.arguments, (batch.output,))
    record = {
        "command": ["lightdepth", "batch"],  # its words may be names of patients
        "sequences": len(lines),
        "summary": summary(lines),
        "failures": [{"what": line.sequence, "reason": line.error} for line in lines if line.error],
        "warnings": list(batch.notes),
    }
    write_run_json(batch.output, "batch", batch.arguments, start, record, names)
    outcome().made(batch.output)


def _say(line: str) -> None:
    """A line for the terminal."""
    if not is_quiet():
        print(for_line(line), file=sys.stderr, flush=True)
    outcome().stage(line)
