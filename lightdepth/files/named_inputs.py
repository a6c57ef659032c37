"""inputs.json of a run folder: which path stands behind each name by which the run's other files call an input.

Paths are often names of patients; a folder of results is mailed and published, and this file is what to leave behind.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lightdepth.errors import InputError
from lightdepth.files.writing import write_whole

INPUTS = "inputs.json"
"""Readable by the user alone, and never read into a report."""

TOKEN = re.compile(r"[a-z][a-z0-9-]*-[0-9a-f]{8}(?:-[0-9]+)?(?![\w-])")
"""The name of an input: of its option, then eight digits of its contents' SHA-256."""


def write_inputs(folder: Path, paths: Mapping[str, str]) -> None:
    """Writes which path each name stands for, with mode 600 whatever the umask is."""

    def private(path: Path) -> None:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8", errors="surrogateescape") as file:
            path.chmod(0o600)
            file.write(json.dumps(dict(paths), indent=1) + "\n")

    write_whole(folder / INPUTS, private)


def real_inputs(folder: Path) -> dict[str, str]:
    """The path behind each name in a run folder; none where the run has no such file, or kept its paths. Raises
    InputError where the file is spoilt."""
    path = folder / INPUTS
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8", errors="surrogateescape"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, "cannot be read", "give the inputs themselves") from error
    if not isinstance(found, dict) or not all(isinstance(value, str) for value in found.values()):
        raise InputError(path, "not as a run writes it", "give the inputs themselves")
    return found


def real(value: Any, paths: Mapping[str, str]) -> Any:
    """A value as JSON or YAML gives it, its names of inputs replaced by their paths."""
    if isinstance(value, Mapping):
        return {key: real(each, paths) for key, each in value.items()}
    if isinstance(value, list):
        return [real(each, paths) for each in value]
    if isinstance(value, str):
        name, slash, rest = value.partition("/")
        return f"{paths[name]}{slash}{rest}" if name in paths else value
    return value


def with_real_inputs(record: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    """A run.json whose arguments and inputs have their paths again, where inputs.json stands beside it."""
    paths = real_inputs(folder)
    if not paths:
        return record
    return {key: real(value, paths) if key in ("arguments", "inputs") else value for key, value in record.items()}


def unknown_names(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """What is still called by its name in settings, with the last part of the key that it stands under."""
    if isinstance(value, Mapping):
        for inner, each in value.items():
            yield from unknown_names(each, str(inner).rpartition(".")[2])
    elif isinstance(value, list):
        for each in value:
            yield from unknown_names(each, key)
    elif isinstance(value, str) and TOKEN.match(value):
        yield key, value
