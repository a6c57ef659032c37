"""What a run is of: its inputs by their contents, its arguments as plain values, and whether two runs are the same."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from lightdepth.errors import AlreadyFinished, InputError
from lightdepth.files.below import files_below
from lightdepth.files.named_inputs import INPUTS, TOKEN, with_real_inputs
from lightdepth.files.replacing import read_record
from lightdepth.regular import regular


def check_finished(output: Path, verb: str, arguments: Mapping[str, Any]) -> None:
    """Raises AlreadyFinished when the same run is finished there, else InputError."""
    record = read_record(output)
    if record is None:
        raise InputError(output, "not resumed, it holds no run of this program", "choose another -o")
    check_same(output, with_real_inputs(record, output), verb, arguments)
    _check_whole(output, record)
    raise AlreadyFinished(f"{output.name} is already finished")


def _check_whole(output: Path, record: Mapping[str, Any]) -> None:
    """Raises InputError where a file that the run wrote is gone, or is another; not for what others are not given."""
    files = record.get("files")
    for name, size in files.items() if isinstance(files, Mapping) else ():
        path = output / name
        if name == INPUTS or "\0" in name:
            continue
        if not os.path.lexists(path):
            found = f"not resumed, it is finished, but {name} of it is gone"
            raise InputError(output, found, "give --overwrite to start anew, or choose another -o")
        if path.lstat().st_size != size:
            found = f"not resumed, it is finished, but {name} of it was changed since"
            raise InputError(output, found, "choose another -o, or remove it yourself")


def check_same(output: Path, begun: Mapping[str, Any], verb: str, arguments: Mapping[str, Any]) -> None:
    """Raises InputError, naming what differs, unless this is the run that was begun there."""
    if begun["verb"] != verb:
        raise InputError(output, f"not resumed, it was made by {begun['verb']}, not by {verb}", "choose another -o")
    if (version := begun.get("version", own_version())) != own_version():
        found = f"not resumed, it was begun by version {version}, and this is {own_version()}"
        raise InputError(output, found, "go on with that version, or give --overwrite to start anew")
    now, then = one_by_one(compared(arguments)), one_by_one(compared(begun.get("arguments") or {}))
    for name in dict.fromkeys([*now, *then]):
        if now.get(name) != then.get(name):
            if isinstance(then.get(name), str) and TOKEN.fullmatch(then[name]):
                found = f"not resumed, {INPUTS} is gone, which says what {then[name]} is"
                raise InputError(output, found, "choose another -o, or give --overwrite")
            found = f"not resumed, --{name.replace('_', '-')} was {then.get(name)!r} and is {now.get(name)!r}"
            raise InputError(output, found, "give the same options, or --overwrite to start anew")
    for name, known in (begun.get("inputs") or {}).items():
        if not isinstance(known, Mapping):
            continue  # a training's: it has no more than their hashes
        path = Path(str(arguments.get(name) or known.get("path") or ""))
        if "sha256" in known and not (path.exists() and input_hash(path, output) == known["sha256"]):
            raise InputError(output, f"not resumed, {name} has changed since", "--overwrite starts anew")


def one_by_one(arguments: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Each option by its name, those of a group as the command line has them: sift.features."""
    found: dict[str, Any] = {}
    for name, value in arguments.items():
        inner = isinstance(value, Mapping) and bool(value)
        found |= one_by_one(value, f"{above}{name}.") if inner else {f"{above}{name}": value}
    return found


def fingerprint(verb: str, arguments: Mapping[str, Any], inputs: Mapping[str, Mapping[str, str]]) -> str:
    """Sixteen digits that are the same for runs of one version with the same options on inputs of the same contents,
    whatever these are called. `inputs` have the path and the SHA-256 of each."""
    hashes = {known["path"]: known["sha256"] for known in inputs.values()}

    def by_contents(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: by_contents(each) for name, each in value.items()}
        return hashes.get(value, value) if isinstance(value, str) else value

    said = json.dumps([own_version(), verb, by_contents(compared(arguments))])
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def own_version() -> str:
    """The version of the program: another one may make other files of the same inputs."""
    try:
        return metadata.version("lightdepth")
    except metadata.PackageNotFoundError:  # read from its sources
        return ""


_NOT_COMPARED = ("output", "overwrite", "resume", "keep_names")


def compared(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments that decide what comes out, as JSON reads them back."""
    chosen = {name: value for name, value in arguments.items() if name not in _NOT_COMPARED}
    same: dict[str, Any] = json.loads(json.dumps(plain(chosen)))
    return same


def paths_in(value: Any) -> list[Path]:
    """Every path among arguments, also in lists and groups; text counts, as it may name one. Not the output's."""
    if isinstance(value, Path):
        return [value]
    if isinstance(value, str):
        return [Path(value)] if value and "\0" not in value else []
    if is_dataclass(value) and not isinstance(value, type):
        return paths_in(vars(value))
    if isinstance(value, Mapping):
        return [path for name, each in value.items() if name != "output" for path in paths_in(each)]
    if isinstance(value, list | tuple | set | frozenset):
        return [path for each in value for path in paths_in(each)]
    return []


def input_hash(path: Path, without: Path | None = None) -> str:
    """SHA-256 over names and sizes of the files below a path, and over the contents of those up to 1 MB; of a single
    file, up to 1 GB: another checkpoint has the same size. Results of runs below it are passed over, and so is
    `without`, a folder that is being made."""
    if not path.exists():
        raise InputError(path, "no such file or folder", "correct its name, or put it there")
    digest = hashlib.sha256()
    files = files_below(path, without) if path.is_dir() else [regular(path)]
    read = 1 << 20 if path.is_dir() else 1 << 30
    for file in files:
        size = file.stat().st_size
        name = file.relative_to(path) if path.is_dir() else file.name
        digest.update(f"{name}\0{size}\0".encode("utf-8", "surrogateescape"))
        if size <= read:
            with file.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()


def recorded(*groups: object, **options: object) -> dict[str, object]:
    """The options of a verb, by name, as run.json and config.yaml hold them: the fields of its groups (dataclasses),
    then its own."""
    return {name: value for group in groups for name, value in vars(group).items()} | options


def plain(value: Any) -> Any:
    """Dataclasses, paths, tuples and numpy scalars as what JSON and YAML know."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item") and getattr(value, "ndim", 1) == 0:
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has neither NaN nor infinity
    return value
