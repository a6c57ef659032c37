"""The folder of a training run: what of an older one is in the way, and how the new one takes its place.

A run into an empty place is made there, for all to watch, and `begun.json` says that it is a run of ours until run.json
says that it is whole. `--overwrite` of a run makes the new one hidden beside it, in `.OUT.unfinished`: the old result
stays whole, and says so, until the new one is; then one rename puts it there, and the old one is deleted last. A new
one that ends before its first checkpoint leaves nothing; later, `--resume` goes on with it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lightning.pytorch.utilities import rank_zero_only

from lightdepth.command_line.outcome import outcome
from lightdepth.errors import InputError, PartialFailure
from lightdepth.files.lock import locked
from lightdepth.files.machine import machine_failure
from lightdepth.files.named_inputs import INPUTS
from lightdepth.files.replacing import (
    BEGUN,
    RECORD,
    STATE,
    check_apart,
    check_replaceable,
    discard,
    read_record,
    real_output,
    recover,
    replace,
    stamp,
    unfinished_path,
)
from lightdepth.files.writing import PARTIAL
from lightdepth.reporting.unfinished import begin, begun_with

from .checkpoints import BEST, LAST, PREVIOUS

_OURS = (
    *("config.yaml", "log.txt", "tensorboard", "csv", "checkpoints", "model.safetensors", "model.md", "report.html"),
    *("uncertainty.png", INPUTS, STATE),
)
"""What a run writes, besides run.json and begun.json."""


def first_process() -> bool:
    """Known before there is a Trainer: the launcher's environment says it. Of several machines without a launcher that
    counts processes over all of them (RANK), Lightning itself learns of NODE_RANK only then."""
    other_machine = "RANK" not in os.environ and any(os.environ.get(n, "0") != "0" for n in ("NODE_RANK", "GROUP_RANK"))
    return getattr(rank_zero_only, "rank", 0) == 0 and not other_machine


def check_output(output: Path, resume: bool, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Raises InputError when what the folder holds is not ours, or neither flag says what to do with it."""
    if resume and overwrite:
        raise InputError("--resume, --overwrite", "they contradict each other", "give one of them")
    if output.exists() and not output.is_dir():
        raise InputError(output, "is a file", "expected a folder to write the run to")
    complete, begun, hidden = (
        (output / RECORD).exists(),
        _is_begun(output),
        _is_begun(unfinished_path(output.resolve())),
    )
    if not resume and not overwrite and (complete or has_checkpoint(output) or hidden):
        state = "a complete" if complete and not hidden else "an unfinished"
        raise InputError(output, f"holds {state} run", "--resume continues it, --overwrite starts anew")
    if resume and complete:
        _check_resumable(output, begun, hidden)
    if overwrite:
        real_output(output)
        if output.is_dir() and any(output.iterdir()):
            check_apart(output, inputs)
            if complete or not begun:
                check_replaceable(output, "train")
            there = {path.name for path in output.iterdir() if not path.name.startswith(PARTIAL)}
            strangers = sorted(there - {*_OURS, RECORD, BEGUN})
            if strangers and not complete:
                found = f"not overwritten, {strangers[0]} in it is not of a run"
                raise InputError(output, found, "move it elsewhere, or choose another -o")
    elif not (complete or begun or has_checkpoint(output)):
        strangers = [name for name in _OURS if (output / name).exists()]
        if strangers:
            found = f"{strangers[0]} is in it, and no run.json: it was not made by this program"
            raise InputError(output, found, "choose another -o, or move it elsewhere")


def _check_resumable(output: Path, begun: bool, hidden: bool) -> None:
    """Raises InputError where what says that it is complete is no training, or one that cannot go on."""
    record = read_record(output)
    if record is None and not begun:
        raise InputError(output, f"not resumed, its {RECORD} was not written by this program", "choose another -o")
    if record is not None and record["verb"] != "train":
        raise InputError(output, f"not resumed, it was made by {record['verb']}", "choose another -o")
    if record is not None and not hidden and not has_checkpoint(output):
        found = "not resumed, it is complete, and its checkpoints are gone"
        raise InputError(output, found, "choose another -o, or give --overwrite to start anew")


def has_checkpoint(folder: Path) -> bool:
    return any((folder / "checkpoints" / name).is_file() for name in (LAST, PREVIOUS, BEST))


@contextmanager
def training_folder(output: Path, resume: bool, overwrite: bool, inputs: Iterable[Path] = ()) -> Iterator[Path]:
    """The folder to write to, which is `output` after the block, if run.json is in it. No other run writes to it
    meanwhile. Raises InputError as `check_output` does."""
    if not first_process():
        made = unfinished_path(output.resolve())
        yield made if made.is_dir() and (resume or overwrite) else output
        return
    real = output.resolve()
    real.parent.mkdir(parents=True, exist_ok=True)
    with locked(real):
        recover(real)
        check_output(output, resume, overwrite, inputs)
        made = unfinished_path(real)
        before = stamp(real)
        if overwrite:
            discard(made)
        elif read_record(made) is not None:  # killed before it took its place
            _put(made, real)
        hidden = made.is_dir() or (overwrite and real.is_dir() and any(real.iterdir()))
        folder = made if hidden else output
        with _kept_or_gone(folder, output, hidden):
            yield folder
        if read_record(folder) is not None:
            (folder / BEGUN).unlink(missing_ok=True)
            if hidden:
                if stamp(real) == before:
                    _put(made, real)
                else:
                    replace(made, real, before)  # keeps both, and says where


@contextmanager
def _kept_or_gone(folder: Path, output: Path, hidden: bool) -> Iterator[None]:
    """A block that fails keeps its checkpoints; without one, nothing is left of a run that it began.

    Not `reporting.run.kept_or_gone`, which removes a hidden folder as a whole and counts finished parts: a training may
    stand in the output itself, beside files of others, which stay, and its checkpoints are kept whatever made it fail.
    """
    there, fresh = folder.is_dir(), not any((folder / name).exists() for name in (*_OURS, BEGUN, RECORD))
    try:
        yield
    except BaseException as error:
        kept = has_checkpoint(folder)
        named = str(getattr(error, "filename", ""))
        begun = folder.is_dir() or (isinstance(error, FileNotFoundError) and Path(named).is_relative_to(folder))
        resumable = kept and not isinstance(error, InputError | PartialFailure)
        left = outcome().keeping("Its checkpoints are kept") if resumable else ""
        if not resumable and outcome().goes_on:  # else who called says what is kept
            left = "Nothing of it is kept"
        failure = machine_failure(error, folder if begun else None, left, output)
        if not kept and hidden:
            discard(folder)
        elif not kept and fresh:
            _clear(folder)
            if not there:
                with suppress(OSError):  # others put something into it
                    folder.rmdir()
        if failure is not None:
            raise failure from error
        raise


def begin_in(folder: Path) -> None:
    """What is in the folder is from now on an unfinished run."""
    folder.mkdir(parents=True, exist_ok=True)
    begin(folder, {"verb": "train", "arguments": {}})
    (folder / RECORD).unlink(missing_ok=True)


def _is_begun(folder: Path) -> bool:
    begun, record = begun_with(folder), read_record(folder)
    return any(found is not None and found["verb"] == "train" for found in (begun, record))


def _put(made: Path, output: Path) -> None:
    """A whole run takes the place of the old one; an unfinished old one lists no files, and goes before."""
    if output.is_dir() and read_record(output) is None:
        _clear(output)
    replace(made, output, stamp(output))


def _clear(folder: Path) -> None:
    """Removes what a run wrote, and what it was writing when it was killed, and no other file."""
    for path in [*(folder / name for name in (*_OURS, BEGUN)), *folder.glob(f"{PARTIAL}*")]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
