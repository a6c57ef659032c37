"""Finished parts of a verb that writes single files: they are kept in a hidden folder beside these, and go with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightdepth.files.lock import locked
from lightdepth.files.replacing import check_name, check_ours, discard, unfinished_path
from lightdepth.files.writing import folders_for
from lightdepth.reporting.run import Run, going_on, kept_or_gone, kept_parts
from lightdepth.reporting.unfinished import begun_with, clean, finished_parts


def goes_on(output: Path) -> bool:
    """Whether a run that was stopped has finished parts for the file `output`."""
    made = unfinished_path(_place(output))
    return begun_with(made) is not None and bool(finished_parts(made))


@contextmanager
def kept_beside(
    output: Path, verb: str, arguments: Mapping[str, Any], overwrite: bool = False, resume: bool = False
) -> Iterator[Run]:
    """A Run whose finished parts are kept beside the file `output` when the block is stopped, until one ends well.

    What it is of is noted with `Run.check_inputs`. Raises InputError when the file is being made by another run, or
    parts are there and neither `resume` nor `overwrite` is given, or they are of another run.
    """
    check_name(output)
    real = _place(output)
    made = unfinished_path(real)
    with folders_for([made]), locked(real):
        check_ours(made, output)
        parts = going_on(real, verb, arguments, overwrite, resume, "beside it is an unfinished run")
        run = Run(made, real, verb, arguments, parts)
        with kept_or_gone(run, real, True), run.hearing():
            if parts:
                clean(made, parts)
                print(f"resumed: {kept_parts(parts)}", flush=True)
            else:
                made.mkdir(mode=0o700)
                run.begin()
            yield run
        discard(made)


def _place(output: Path) -> Path:
    """Where the file comes to stand: in the place of a link that has its name, not of what that leads to."""
    return output.parent.resolve() / output.name
