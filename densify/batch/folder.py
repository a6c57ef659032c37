"""The output of a batch, which grows in its place and may be shared: what it was begun with, and whose turn it is.

    OUT/  batch.json (what it was begun with)  sequences/NAME/ (the run of each)  failed/NAME.json (why there is none)
          table.csv  table.json  report.html  inputs.json  run.json (last: all sequences are done or have failed)

Each run appears whole, and is locked while it is made; the files beside them are written together, one after the other
by those who share the output.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from densify.batch.make import FAILED, SEQUENCES
from lightdepth.errors import InputError, InUse
from lightdepth.files.lock import locked
from lightdepth.files.named_inputs import INPUTS
from lightdepth.files.replacing import RECORD, check_name, hidden
from lightdepth.files.schema import read_json
from lightdepth.files.writing import write_whole
from lightdepth.reporting.names import names_of
from lightdepth.reporting.same import compared, one_by_one, own_version

BEGUN = "batch.json"
TABLE, TABLE_JSON, PAGE = "table.csv", "table.json", "report.html"
JOBS = ".jobs"
"""Holds what is handed to jobs of a cluster, and their logs, while they run."""
_OURS = (BEGUN, TABLE, TABLE_JSON, PAGE, INPUTS, RECORD, SEQUENCES, FAILED, JOBS)
_PATIENCE_S = 120.0
"""How long another one may be at the files of an output: it writes a table."""


@contextmanager
def in_turn(output: Path) -> Iterator[None]:
    """Within it nobody else writes to the files of the output, but to the runs in it. Waits for others."""
    until = time.monotonic() + _PATIENCE_S
    with ExitStack() as holding:
        while True:
            try:
                holding.enter_context(locked(output))
                break
            except InUse:
                if time.monotonic() > until:
                    raise
            time.sleep(0.2)
        yield


def real_place(output: Path) -> Path:
    """The folder that an output names, links followed. Raises InputError for what can be none."""
    check_name(output)
    try:
        real = output.resolve()
    except (OSError, RuntimeError) as error:
        raise InputError(output, f"cannot be made ({error})", "choose another -o") from error
    if os.path.lexists(real) and not real.is_dir():
        raise InputError(output, "is a file", "expected a folder to make")
    return real


def begin(output: Path, arguments: Mapping[str, object]) -> None:
    """Makes the output, or goes on with one that was begun with the same options. Raises InputError as `is_begun`."""
    if not is_begun(output, arguments):
        output.mkdir(parents=True, exist_ok=True)
        write_whole(output / BEGUN, json.dumps(_said(arguments), indent=1) + "\n")


def is_begun(output: Path, arguments: Mapping[str, object]) -> bool:
    """Whether the output was begun, with the same options. Raises InputError, naming what differs, where it is of other
    ones, or not of this program."""
    if (output / BEGUN).is_file():
        begun = read_json(output / BEGUN)
        if not isinstance(begun, dict) or begun.get("verb") != "batch" or not isinstance(begun.get("arguments"), dict):
            raise InputError(output / BEGUN, "was not made by this program", "choose another -o")
        _check_same(output, begun, _said(arguments))
        return True
    strangers = sorted(p.name for p in output.iterdir() if not hidden(p)) if output.is_dir() else []
    if strangers:
        raise InputError(output, f"holds {strangers[0]}, which no batch made", "choose another -o")
    return False


def _said(arguments: Mapping[str, object]) -> dict[str, object]:
    return {"verb": "batch", "version": own_version(), "arguments": _as_it_is_known_again(arguments)}


def check_ours(output: Path) -> None:
    """Raises InputError where somebody put something else into an output."""
    for path in sorted(output.iterdir()):
        if path.name not in _OURS and not hidden(path):
            raise InputError(output, f"holds {path.name}, which no batch made", "move it elsewhere")


def _check_same(output: Path, begun: Mapping[str, Any], said: Mapping[str, Any]) -> None:
    if (version := begun.get("version")) != said["version"]:
        found = f"was begun by version {version}, and this is {said['version']}"
        raise InputError(output, found, "go on with that version, or choose another -o")
    now, then = one_by_one(said["arguments"]), one_by_one(begun["arguments"])
    for name in dict.fromkeys([*now, *then]):
        if now.get(name) != then.get(name):
            option = f"--{name.replace('_', '-')}"
            found = f"was begun with {option} {then.get(name)!r}, and it is {now.get(name)!r}"
            raise InputError(output, found, "give the same options, or choose another -o")


def _as_it_is_known_again(arguments: Mapping[str, object]) -> dict[str, object]:
    """Options with files by their contents: paths may be names of patients."""
    found: dict[str, object] = names_of(arguments).hidden(compared(arguments), exactly=True)
    return found
