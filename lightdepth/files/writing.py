"""What is written appears whole or not at all, also when the machine dies on the way.

A file is written beside its place, brought to the disk and renamed; then the folder that names it is brought to the
disk too. Files inside a run folder in the making need none of this: the folder appears whole.
"""

from __future__ import annotations

import errno
import glob
import hashlib
import os
import re
import socket
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from lightdepth.errors import InputError
from lightdepth.files.machine import FAILS
from lightdepth.signals import finishing_first

Content = str | bytes | Callable[[Path], object]
"""Text, bytes, or a function that writes a file at the path that it is given (the ending is that of the real one)."""


PARTIAL = ".partial-"
"""How names begin of what is not whole yet; then follow the machine, the process and the real name."""

_LONGEST = 255
"""What file systems take as a name, in bytes."""
_BEFORE = len(PARTIAL) + 8 + 1 + 9 + 1
"""Bytes that stand before the real name at the most, whatever number the process has: killed runs had others."""

_MORE = bytes(1 << 16)
"""What a file is asked to take where a library that wrote it failed for a reason of its own."""

_NOT_HERE = (errno.EINVAL, errno.ENOTSUP)
"""Some file systems cannot bring a folder to the disk, and say so; a finished run is not lost over it."""


def write_whole(path: str | Path, content: Content) -> None:
    """One file; its folder is made. Raises InputError where it cannot be written, and leaves what was there."""
    write_together({Path(path): content})


def write_together(contents: Mapping[Path, Content]) -> None:
    """Several files: nothing takes its place before all are written; then they do, in the order given, and a signal
    waits until all have."""
    partial = {path: _partial(path) for path in contents}
    try:
        with folders_for(contents):
            _write_together(contents, partial)
    except OSError as error:
        real = {os.fspath(unfinished): path for path, unfinished in partial.items()}
        where = real.get(error.filename, error.filename or next(iter(contents)))
        if error.errno in FAILS:
            error.filename = os.fspath(where)  # writing alone names none
            raise
        raise InputError(where, f"cannot be written ({error.strerror or error})", "choose another place") from error


def _write_together(contents: Mapping[Path, Content], partial: Mapping[Path, Path]) -> None:
    try:
        for path, content in contents.items():
            _clear_dead(path)
            _write(partial[path], content)
            sync(partial[path])
        with finishing_first():
            for path in contents:
                os.replace(partial[path], path)
            for folder in {path.parent for path in contents}:
                sync(folder)
    finally:
        with finishing_first():
            for unfinished in partial.values():
                _remove(unfinished)


def write_remade(path: Path, content: bytes) -> None:
    """A file that can be made anew, and that shows by itself whether it is whole: it is not waited for until it is on
    the disk. Its folder has to be there; OSErrors are the caller's, and what killed runs left is not cleared."""
    partial = _partial(path)
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except BaseException:
        _remove(partial)
        raise


@contextmanager
def folders_for(outputs: Iterable[Path]) -> Iterator[None]:
    """Makes the folders that outputs are to be in; those that it made go where the block fails and leaves nothing."""
    places = {path.parent for path in outputs}
    missing = {folder for place in places for folder in (place, *place.parents) if not folder.exists()}
    try:
        for place in places:
            place.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with finishing_first():
            for folder in sorted(missing, reverse=True):  # the innermost first
                with suppress(OSError):  # something is kept in it
                    folder.rmdir()
        raise


def check_writable(path: Path) -> None:
    """Raises InputError where a file cannot be written, before the work for it; nothing is left there."""
    try:
        existing = next(folder for folder in path.absolute().parents if folder.exists())
        probe = _partial(existing / path.name)
        with finishing_first():
            _clear_dead(existing / path.name)
            try:
                probe.touch()
            finally:
                _remove(probe)
    except OSError as error:
        if error.errno in FAILS:
            error.filename = os.fspath(path)
            raise
        raise InputError(path, f"cannot be written ({error.strerror or error})", "choose another place") from error


def usual_mode(folder: Path) -> int:
    """The mode that a new folder inside this one gets: by the umask, which says who may read what the user makes, and
    by what a folder of a group hands on."""
    probe = folder / f"{PARTIAL}mode"
    probe.mkdir(exist_ok=True)
    try:
        return stat.S_IMODE(probe.stat().st_mode)
    finally:
        probe.rmdir()


def move_whole(made: Path, path: Path) -> None:
    """A finished folder takes its place: all that is in it is on the disk before it does."""
    sync_below(made)
    made.rename(path)
    sync(path.parent)


def sync_below(made: Path) -> None:
    """Brings all that is in a folder to the disk."""
    for folder, _, files in os.walk(made):
        for file in files:
            sync(Path(folder) / file)
        sync(Path(folder))


def sync(path: Path) -> None:
    """Brings a file, or the names in a folder, to the disk."""
    if path.is_dir() and os.name == "nt":  # a folder cannot be opened there
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NOT_HERE:
            raise
    finally:
        os.close(descriptor)


def is_dead_partial(path: Path) -> bool:
    """Whether a file is what a process of this machine, which is dead, had written of one."""
    return is_of_the_dead(path.name, PARTIAL)


def is_of_the_dead(name: str, beginning: str) -> bool:
    """Whether a name is that beginning, the `our_mark` of a process of this machine that is dead, and more."""
    found = re.fullmatch(rf"{re.escape(beginning)}([0-9a-f]{{8}})-(\d{{1,9}})-.*", name, re.DOTALL)
    if found is None or found[1] != _machine():
        return False
    try:
        os.kill(int(found[2]), 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def our_mark() -> str:
    """What says in a name whose it is: this machine and this process."""
    return f"{_machine()}-{os.getpid()}-"


def _partial(path: Path) -> Path:
    """A name beside a file for what is written of it, with its ending, of this process alone."""
    return path.with_name(f"{PARTIAL}{our_mark()}{_ending(path)}")


def _ending(path: Path) -> str:
    """How the names of a file's parts end: in its own name, or where that is too long in a hash of it."""
    if len(os.fsencode(path.name)) + _BEFORE <= _LONGEST:
        return path.name
    return hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16] + path.suffix


def _clear_dead(path: Path) -> None:
    """What killed runs had written of this file."""
    for old in path.parent.glob(f"{PARTIAL}*-{glob.escape(_ending(path))}"):
        if is_dead_partial(old):
            _remove(old)


def _machine() -> str:
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def _remove(path: Path) -> None:
    with suppress(OSError):  # it never came to be
        path.unlink()


def _write(path: Path, content: Content) -> None:
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8", errors="surrogateescape")  # names of files, whatever they are
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        try:
            content(path)
        except RuntimeError:  # torch.save's, of a full disk; it is the only writer that keeps the system's number back
            _check_room(path)
            raise


def _check_room(file: Path) -> None:
    """Raises the system's OSError where it does not let a file grow: for libraries that only say that they failed. The
    file is longer afterwards."""
    try:
        with file.open("ab") as end:
            end.write(_MORE)
            end.flush()
            os.fsync(end.fileno())
    except OSError as error:
        if error.errno in FAILS:
            raise
