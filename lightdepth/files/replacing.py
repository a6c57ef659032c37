"""How a finished folder takes the place of what was there, and what a run that died on the way left behind.

Beside OUT stand, hidden, `.OUT.unfinished` (what is being made) and, for a moment, `.OUT.old` (what was there, moved
aside). Whoever holds the lock of OUT (`lock.py`) knows that both are remains of the dead, and clears them up.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightdepth.errors import InputError
from lightdepth.files.lock import is_live, is_lock, lock_path
from lightdepth.files.writing import PARTIAL, check_writable, is_dead_partial, move_whole, sync, sync_below
from lightdepth.signals import finishing_first

RECORD = "run.json"
"""The file that says that a folder is the whole result of a run, of which verb, and which files are the run's."""

BEGUN, PARTS, STATE = "begun.json", "parts.jsonl", ".state"
"""In an unfinished run: what it was begun with, which also says that the folder is ours; its finished parts; and a
folder for what only a run that is resumed reads."""

_LONGEST = 240
"""The longest name of an output, in bytes: file systems take 255, and its hidden neighbours have longer names."""


def unfinished_path(output: Path) -> Path:
    """Where a run into `output` is made."""
    return output.with_name(f".{output.name}.unfinished")


def old_path(output: Path) -> Path:
    """Where what was at `output` waits for its successor."""
    return output.with_name(f".{output.name}.old")


@dataclass(frozen=True)
class Stamp:
    """What stood at an output: None in both where nothing did."""

    folder: tuple[int, int] | None
    record: tuple[int, int, int] | None


def stamp(output: Path) -> Stamp:
    """What stands there now, to compare with later."""
    try:
        of_folder = output.stat()
    except FileNotFoundError:
        return Stamp(None, None)
    try:
        of_record = (output / RECORD).stat()
    except OSError:
        return Stamp((of_folder.st_ino, of_folder.st_mtime_ns), None)
    record = (of_record.st_ino, of_record.st_size, of_record.st_mtime_ns)
    return Stamp((of_folder.st_ino, of_folder.st_mtime_ns), record)


def real_output(output: Path) -> Path:
    """The folder that an output names, links followed. Raises InputError for what can never become a run folder."""
    output = Path(output)
    check_name(output)
    try:
        if output.is_symlink() and not output.exists():
            raise InputError(output, "is a link to nothing", "choose another -o, or make the folder that it names")
        real = output.resolve()
    except OSError as error:
        raise InputError(_short(output), f"cannot be made ({error.strerror})", "choose another -o") from error
    except RuntimeError as error:
        raise InputError(_short(output), "cannot be made (links in a circle)", "choose another -o") from error
    if real.exists() and not real.is_dir():
        raise InputError(output, "is a file", "expected a folder to make")
    if real == real.parent or Path.cwd().resolve().is_relative_to(real):
        raise InputError(
            output, "is the folder that you are in, and cannot be replaced", f"give one in it: -o {output / 'run'}"
        )
    return real


def check_name(output: Path) -> None:
    """Raises InputError where hidden neighbours of an output could not be called after it."""
    if (length := len(os.fsencode(output.name))) > _LONGEST:
        raise InputError(_short(output), f"its name has {length} bytes", f"expected up to {_LONGEST}")


def try_place(output: Path) -> None:
    """Does with what stands at `output` what the end of the run will do. Raises InputError where that will not go."""
    probe = old_path(output)
    try:
        with finishing_first():
            if output.is_dir():
                os.rename(output, probe)
                os.rename(probe, output)
            else:
                probe.mkdir()
                try:
                    os.rename(probe, output)
                finally:
                    with suppress(OSError):
                        probe.rmdir()
                output.rmdir()
    except OSError as error:
        if error.errno in (errno.EBUSY, errno.EXDEV):
            raise InputError(
                output,
                "is where a disk is mounted, and no folder can take its place",
                f"give one in it: -o {output / 'run'}",
            ) from error
        raise


def read_record(folder: Path) -> dict[str, Any] | None:
    """The run.json of a folder that this program wrote, or None."""
    if not (folder / RECORD).is_file():
        return None  # a pipe would be waited for
    try:
        found = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    kinds = {"verb": str, "versions": dict}
    if not (isinstance(found, dict) and all(isinstance(found.get(name), kind) for name, kind in kinds.items())):
        return None
    whole = all(isinstance(found.get(name, {}), dict) for name in ("arguments", "inputs"))
    return found if whole and all(isinstance(known, dict | str) for known in found.get("inputs", {}).values()) else None


def listed(folder: Path) -> dict[str, int]:
    """Every file of a run, links too, with its size in bytes: names as run.json has them, in order."""
    own = {folder / name for name in (RECORD, BEGUN, PARTS)}
    found = (p for p in sorted(below(folder)) if p not in own and not p.is_relative_to(folder / STATE))
    return {str(p.relative_to(folder)): p.lstat().st_size for p in found}


def clear_notes(folder: Path) -> None:
    """Removes from a run that is whole what an unfinished one is resumed from."""
    discard(folder / STATE)
    for name in (BEGUN, PARTS):
        (folder / name).unlink(missing_ok=True)


def check_replaceable(output: Path, verb: str) -> None:
    """Raises InputError unless all that stands at `output` was written by a run of this verb."""
    record = read_record(output)
    cure = "choose another -o, or remove it yourself"
    if record is None:
        raise InputError(output, "not overwritten, it has no run.json and so was not made by this program", cure)
    if record["verb"] != verb:
        raise InputError(output, f"not overwritten, it was made by {record['verb']}, not by {verb}", cure)
    if not isinstance(record.get("files"), dict):
        found = "not overwritten, its run.json is of an earlier version and does not say which files are the run's"
        raise InputError(output, found, cure)
    ours = _owned(output)
    for path in sorted(below(output)):
        if path not in ours:
            found = f"not overwritten, {path.relative_to(output)} in it is not of the run that made it"
            raise InputError(output, found, "move that file elsewhere, or choose another -o")
    for place in sorted({path.parent for path in ours}):
        if not os.access(place, os.W_OK | os.X_OK):  # it could be moved aside, but not be removed
            which = "it" if place == output else f"{place.relative_to(output)} in it"
            found = f"not overwritten, {which} is protected, and you may not change what is there"
            raise InputError(output, found, "choose another -o, or lift the protection (chmod u+w)")


def check_apart(output: Path, inputs: Iterable[Path]) -> None:
    """Raises InputError when the output is one of the inputs, or holds one."""
    output = output.resolve()
    for path in inputs:
        try:
            inside = path.exists() and _lies_in(path.resolve(), output)
        except (OSError, ValueError, RuntimeError):  # no path after all: too long, or links in a circle
            continue
        if inside:
            raise InputError(output, f"not overwritten, {path} is read from it", "choose another -o")


def _lies_in(path: Path, folder: Path) -> bool:
    """Whether a path is a folder or below it: by name, or under another one (a folder that is mounted at two places; a
    disk that takes capital letters for small ones)."""
    if path.is_relative_to(folder):
        return True
    try:
        same = folder.stat()
    except OSError:
        return False
    return any(os.path.samestat(place.stat(), same) for place in (path, *path.parents))


def check_files(paths: Iterable[Path], overwrite: bool, inputs: Iterable[Path | None] = ()) -> None:
    """Raises InputError, before any work, unless these files can be written: none is an input or a folder, none is
    there already without `overwrite`, and their folders take files."""
    given = [path for path in inputs if path is not None]
    for path in paths:
        if path.is_dir():
            raise InputError(path, "is a folder", "expected the name of a file to write")
        if path.is_symlink() and not path.exists():
            raise InputError(path, "is a link to nothing", "choose another name, or remove the link")
        if path.exists():
            if not overwrite:
                raise InputError(path, "already there", "choose another -o, or give --overwrite")
            check_apart(path, given)
        check_writable(path)


def check_rewritable(path: Path, beginning: str, inputs: Iterable[Path | None] = ()) -> None:
    """Raises InputError, before any work, where a file is to be written that no earlier run wrote: what is there does
    not begin as ours do."""
    if path.is_file():
        with path.open(encoding="utf-8", errors="replace") as file:
            if not file.read(len(beginning)) == beginning:
                raise InputError(path, "is there already, and was not made by this verb", "choose another name")
    check_files([path], True, inputs)


def replace(made: Path, output: Path, before: Stamp) -> None:
    """The finished folder takes its place; what was there goes last, and of that only what its run.json lists.

    Where something else came to stand there meanwhile, both are kept, and an InputError says where. A signal waits for
    the end of it.
    """
    with finishing_first():
        _replace(made, output, before)


def _replace(made: Path, output: Path, before: Stamp) -> None:
    if stamp(output) != before and output.is_dir() and any(output.iterdir()):
        spare = _spare(output)
        move_whole(made, spare)
        raise InputError(output, "was changed by another program during this run", f"the result is in {spare}")
    aside = old_path(output)
    sync_below(made)  # so that the time between the two renames is short
    if output.is_dir() and any(output.iterdir()):
        os.rename(output, aside)
    try:
        os.rename(made, output)
    except OSError:
        if aside.is_dir():
            os.rename(aside, output)
        raise
    sync(output.parent)
    if aside.is_dir():
        _remove_old(aside, output)


def recover(output: Path) -> bool:
    """Finishes what a run that died at its last step had begun: what was there comes back, or goes. Only for whoever
    holds the lock. Returns whether a finished result took its place now."""
    with finishing_first():
        return _recover(output)


def check_ours(path: Path, output: Path) -> None:
    """Raises InputError where a hidden folder beside an output was not made by this program."""
    if os.path.lexists(path) and not _is_of_a_run(path):
        found = f"{path.name} beside it is in the way, and was not made by this program"
        raise InputError(output, found, "rename it, or choose another -o")


def _recover(output: Path) -> bool:
    made, aside = unfinished_path(output), old_path(output)
    for path in (made, aside):
        check_ours(path, output)
    complete = read_record(made) is not None
    empty = not output.exists() or (output.is_dir() and not any(output.iterdir()))
    if aside.is_dir() and empty and not complete:
        os.rename(aside, output)
        return False
    if complete and empty:
        clear_notes(made)
        move_whole(made, output)
    if aside.is_dir():
        _remove_old(aside, output)
    return complete and empty


def _remove_old(aside: Path, output: Path) -> None:
    """What was there goes; of what others put into it meanwhile nothing does, and it shows itself again."""
    if not remove_owned(aside):
        os.rename(aside, _spare(output))


def remove_owned(folder: Path) -> bool:
    """Removes the files of a run, and no others; returns whether the folder is gone."""
    ours = _owned(folder) & set(below(folder))  # not through links
    records = {path for path in ours if path.name == RECORD}
    for path in [
        *sorted(ours - records),
        *sorted(records, reverse=True),
    ]:  # the lists go last, the outermost at the end
        with suppress(PermissionError):  # protected since: it shows itself again
            path.unlink(missing_ok=True)
    for place, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):  # another's file is in it
            os.rmdir(place)
    return not folder.exists()


def hidden(path: Path) -> bool:
    """Whether a name is one that this program hides what it is writing under."""
    return path.name.startswith(PARTIAL) or output_of(path) is not None


def remains(parent: Path) -> Iterator[Path]:
    """What dead runs left in a folder, hidden: unfinished results, results moved aside, locks, parts of files."""
    for path in sorted(parent.glob(".*")):
        output = output_of(path)
        if is_dead_partial(path) or (output is not None and not is_live(output) and _is_of_a_run(path)):
            yield path


def discard(folder: Path) -> None:
    """Removes a folder of our own making, as far as that goes: what fails here must not hide why. What says that it is
    ours goes last, and a result that is half removed says no more that it is whole."""
    with suppress(OSError):
        os.replace(folder / RECORD, folder / BEGUN)
    with suppress(OSError):
        for path in folder.iterdir():
            if path.name == BEGUN:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def output_of(path: Path) -> Path | None:
    """The output that something hidden is beside, by its name; None for other names."""
    for made in (unfinished_path, old_path, lock_path):
        ending = made(Path("x")).suffix
        if path.suffix == ending and len(path.name) > len(ending) + 1:
            return path.with_name(path.name[1 : -len(ending)])
    return None


def _is_of_a_run(path: Path) -> bool:
    """Whether what has such a name was written by this program: others hide files too, and a link leads to theirs."""
    if path.is_symlink():
        return False
    if path.is_dir():
        said = (path / BEGUN).is_file() or read_record(path) is not None
        # A run killed at its first or last step: its list is not there yet, or is gone and folders alone are left.
        return said or all(f.name.startswith(PARTIAL) and f.name.endswith(BEGUN) for f in below(path))
    return path == lock_path(output_of(path) or path) and is_lock(path)


def _owned(folder: Path) -> set[Path]:
    """The files that runs wrote: those of this run.json, and of runs into folders below it (RUN/evaluation)."""
    owned: set[Path] = set()
    for place, _, names in os.walk(folder):
        if RECORD not in names:
            continue
        record = read_record(Path(place))
        files = record.get("files") if record else None
        if not isinstance(files, dict):
            continue
        owned.add(Path(place) / RECORD)
        for name, size in files.items():
            path = Path(place) / name
            if ".." in path.parts or not path.is_relative_to(folder):  # a list that another wrote
                continue
            with suppress(OSError, ValueError):  # a text that is no name
                if path.lstat().st_size == size:
                    owned.add(path)
    return owned


def below(folder: Path) -> Iterator[Path]:
    """The files below a folder, and links to folders, which are not followed."""
    for place, folders, names in os.walk(folder):
        yield from (Path(place) / name for name in names)
        yield from (Path(place) / name for name in folders if (Path(place) / name).is_symlink())


def _spare(output: Path) -> Path:
    number = 1
    while (spare := output.with_name(f"{output.name}.{number}")).exists():
        number += 1
    return spare


def _short(path: Path) -> str:
    text = str(path)
    return text if len(text) < 100 else f"{text[:60]}…{text[-20:]}"
