"""One run at a time into an output: a lock file beside it, with who holds it.

The kernel holds the lock (flock) and lets it go when the process dies, however it dies; the words in the file are for
people, and for other machines, whose kernels do not know of each other.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightdepth.errors import InputError, InUse
from lightdepth.signals import finishing_first

_LOCK = {"host", "pid", "time"}
"""What a lock of ours says at least."""

_AS_IT_IS = os.O_NOFOLLOW | os.O_NONBLOCK
"""A link is not followed, and a pipe with nobody at its other end not waited for."""

_BOOT = Path("/proc/sys/kernel/random/boot_id")


@contextmanager
def locked(output: Path) -> Iterator[None]:
    """Within it no other run writes to `output`. Raises InUse, naming host, process and time, when one does."""
    path, descriptor = lock_path(output), None
    try:
        with finishing_first():
            descriptor = _held(path, output)
        yield
    finally:
        if descriptor is not None:
            with finishing_first():
                try:
                    if _is_at(descriptor, path):
                        path.unlink(missing_ok=True)  # while it is held: whoever waits for it sees that it is gone
                finally:
                    os.close(descriptor)


def lock_path(output: Path) -> Path:
    """Where the lock of an output is."""
    return output.with_name(f".{output.name}.lock")


def is_live(output: Path) -> bool:
    """Whether a run writes to `output` now, as far as this machine can know: what another machine holds counts."""
    try:
        descriptor = os.open(lock_path(output), os.O_RDONLY | _AS_IT_IS)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return not _is_ours(_read(descriptor))
    except OSError:
        return True
    finally:
        os.close(descriptor)


def check_free(output: Path) -> None:
    """Raises InputError as `locked` does where another run writes to `output`; makes no lock."""
    if is_live(output):
        with lock_path(output).open("rb") as file:
            holder = _read(file.fileno())
        raise InputError(
            output, f"another run is writing to it ({_told(holder)})", "wait until it ends, or choose another -o"
        )


def is_lock(path: Path) -> bool:
    """Whether a file is a lock of ours."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _AS_IT_IS)
    except OSError:
        return False
    try:
        return set(_read(descriptor)) >= _LOCK
    finally:
        os.close(descriptor)


def _held(path: Path, output: Path) -> int:
    """The lock file, held, with what we say in it. An OSError names the output: the user does not know of the lock."""
    descriptor = None
    try:
        descriptor = _opened(path, output)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, json.dumps(_ourselves()).encode(), 0)
    except OSError as error:
        if descriptor is not None:
            path.unlink(missing_ok=True)
            os.close(descriptor)
        error.filename = str(output)
        raise
    return descriptor


def _opened(path: Path, output: Path) -> int:
    """The lock file, held."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | _AS_IT_IS, 0o644)
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EISDIR):
                raise
            raise _in_the_way(path, output) from error  # a link: what it leads to would be written over
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = _read(descriptor)
            os.close(descriptor)
            raise InUse(
                output, f"another run is writing to it ({_told(holder)})", "wait until it ends, or choose another -o"
            ) from None
        except OSError:  # a file system without locks: the process alone tells
            holder = _read(descriptor)
            if holder and _is_ours(holder) and _lives(holder):
                os.close(descriptor)
                raise InUse(
                    output, f"another run is writing to it ({_told(holder)})", f"wait for its end, or remove {path}"
                ) from None
        if not _is_at(descriptor, path):  # its holder has just removed it
            os.close(descriptor)
            continue
        holder = _read(descriptor)
        if not set(holder) >= _LOCK and (holder or not _is_torn(descriptor)):
            os.close(descriptor)
            raise _in_the_way(path, output)
        if holder and not _is_ours(holder):
            os.close(descriptor)
            raise InUse(
                output,
                f"a run on another machine writes to it ({_told(holder)})",
                f"wait for its end; if it is dead, remove {path}",
            )
        return descriptor


def _ourselves() -> dict[str, Any]:
    boot = _BOOT.read_text(encoding="ascii").strip() if _BOOT.is_file() else ""
    started = time.strftime("%Y-%m-%d %H:%M:%S")
    return {"host": socket.gethostname(), "boot": boot, "pid": os.getpid(), "time": started}


def _is_ours(holder: dict[str, Any]) -> bool:
    """Whether its holder ran on this machine, so that our lock tells that it is dead: by the name, or, of another
    container on it, by when it started."""
    ours = _ourselves()
    same_boot = bool(ours["boot"]) and holder.get("boot") == ours["boot"]
    return not holder or holder.get("host") == ours["host"] or same_boot


def _lives(holder: dict[str, Any]) -> bool:
    try:
        os.kill(int(holder["pid"]), 0)
    except PermissionError:
        return True
    except (OSError, KeyError, TypeError, ValueError, OverflowError):
        return False
    return True


def _read(descriptor: int) -> dict[str, Any]:
    try:
        found = json.loads(os.pread(descriptor, 4096, 0))
    except (ValueError, OSError):
        return {}  # its holder had not written yet
    return found if isinstance(found, dict) else {}


def _in_the_way(path: Path, output: Path) -> InputError:
    found = f"{path.name} beside it is in the way, and was not made by this program"
    return InputError(output, found, "rename it, or choose another -o")


def _is_torn(descriptor: int) -> bool:
    """Whether a kill or a power cut left nothing, zeros or the beginning of what a lock of ours says."""
    left, ours = os.pread(descriptor, 4096, 0).strip(b"\0"), b'{"host"'
    return left.startswith(ours) or ours.startswith(left)


def _told(holder: dict[str, Any]) -> str:
    if not holder:
        return "it has just begun"
    return f"host {holder.get('host')}, process {holder.get('pid')}, since {holder.get('time')}"


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False
