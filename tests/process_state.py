"""What a process holds at a moment, and whether it grew: memory, handles, threads, files, and how the process is set.

Memory is what is resident of the process's own (RssAnon), after the garbage is collected and the C library has given
back what it can; what is mapped from files is shared and comes and goes. Linux only.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import hashlib
import importlib
import logging
import os
import random
import re
import signal
import sys
import typing
import urllib.parse
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType

import numpy as np

PROCESS = Path("/proc/self")


@dataclass(frozen=True)
class State:
    """What a process holds. All but `settings` are counted; what `settings` says of is to stay as it was."""

    memory_kb: float
    """resident memory of its own, kB"""
    objects: int
    """objects that the garbage collector knows, caches that bound themselves being emptied before"""
    handles: int
    """open files, pipes and sockets"""
    threads: int
    """threads, those of libraries included"""
    children: int
    """processes that it started and that are not waited for"""
    shared: int
    """pieces of shared memory that it has mapped"""
    files: int
    """files and folders below the folder of temporary files"""
    figures: int
    """figures that matplotlib's pyplot holds"""
    handlers: int
    """handlers of all loggers"""
    filters: int
    """filters of warnings"""
    settings: dict[str, str]
    """environment, working folder, signal handlers and other things that a process is set to, by name"""

    @classmethod
    def now(cls, temporary: Path) -> State:
        """`temporary` is the folder of temporary files."""
        gc.collect()
        _give_back()
        memory_kb = _memory_kb()
        _empty_caches()
        gc.collect()
        tasks = list((PROCESS / "task").iterdir())
        pyplot = sys.modules.get("matplotlib.pyplot")
        return cls(
            memory_kb=memory_kb,
            objects=len(gc.get_objects()),
            handles=len(os.listdir(PROCESS / "fd")) - 1,  # that of the listing itself
            threads=len(tasks),
            children=sum(len((task / "children").read_text(encoding="utf-8").split()) for task in tasks),
            shared=_mapped_from(Path(os.sep) / "dev" / "shm"),
            files=sum(1 for _ in temporary.rglob("*")),
            figures=len(pyplot.get_fignums()) if pyplot else 0,
            handlers=sum(len(logger.handlers) for logger in _loggers()),
            filters=len(warnings.filters),
            settings=_settings(),
        )


def _mapped_from(folder: Path) -> int:
    """Pieces of memory that are mapped from files in a folder."""
    return sum(f" {folder}/" in line for line in (PROCESS / "maps").read_text(encoding="utf-8").splitlines())


def _memory_kb() -> float:
    status = (PROCESS / "status").read_text(encoding="utf-8")
    line = next(line for line in status.splitlines() if line.startswith("RssAnon:"))
    return float(line.split()[1])


def _empty_caches() -> None:
    """Caches that end at some hundred entries are no growth, but take hours to fill: the interpreter's and ours."""
    re.purge()
    urllib.parse.clear_cache()
    importlib.invalidate_caches()  # what a folder of packages holds is listed again whenever the folder changes
    for clear in typing._cleanups:  # type: ignore[attr-defined]  # what Python's own tests for leaks call
        clear()
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("lightdepth", "densify", "train"):
            for one in vars(module).values():
                if isinstance(one, functools._lru_cache_wrapper) and one.cache_parameters()["maxsize"] is not None:
                    one.cache_clear()


def _give_back() -> None:
    """What the C library keeps of freed memory goes back to the system, where it can."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _loggers() -> list[logging.Logger]:
    known = logging.Logger.manager.loggerDict.values()
    return [logging.getLogger(), *(one for one in known if isinstance(one, logging.Logger))]


def _settings() -> dict[str, str]:
    import torch

    umask = os.umask(0)
    os.umask(umask)
    draws = repr((random.getstate(), np.random.get_state(), torch.get_rng_state().numpy().tobytes()))  # noqa: NPY002
    return {
        "environment": repr(sorted(os.environ.items())),
        "working folder": os.getcwd(),
        "module path": repr(sys.path),
        "signal handlers": repr([(int(n), str(signal.getsignal(n))) for n in sorted(signal.valid_signals())]),
        "how warnings look": repr((warnings.formatwarning, warnings.showwarning)),
        "log levels": repr(sorted((one.name, one.level) for one in _loggers() if one.level)),
        "streams": repr((id(sys.stdout), id(sys.stderr), id(sys.stdin))),
        "hooks": repr((sys.excepthook, sys.unraisablehook, sys.displayhook)),
        "umask": oct(umask),
        "floating-point errors": repr(np.geterr()),
        "torch": repr((torch.get_num_threads(), torch.is_grad_enabled(), torch.get_default_dtype())),
        "common generators": hashlib.sha256(draws.encode()).hexdigest()[:12],
        "recursion": str(sys.getrecursionlimit()),
        "garbage": repr((gc.isenabled(), gc.get_threshold())),
    }


def changed(before: State, after: State) -> list[str]:
    """Names of the settings that are not what they were."""
    return [name for name, value in before.settings.items() if after.settings[name] != value]


_NOT_OF_IT = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType, CodeType)


def reached(*roots: object, without: Iterable[object] = ()) -> int:
    """Bytes of all objects that can be reached from some, arrays' memory included; `without` and what hangs on them,
    modules, classes and code do not count."""
    known, waiting, total = {id(one) for one in without}, list(roots), 0
    while waiting:
        one = waiting.pop()
        if id(one) in known or isinstance(one, _NOT_OF_IT):
            continue
        known.add(id(one))
        total += sys.getsizeof(one)
        if isinstance(one, np.ndarray):
            if one.base is not None:
                waiting.append(one.base)
        else:
            waiting += gc.get_referents(one)
    return total


def slope(places: Sequence[float], values: Sequence[float]) -> float:
    """The median of the slopes between all pairs of points (Theil, Sen): a jump, or some, do not tilt it."""
    pairs = [(b - a, d - c) for (a, c), (b, d) in combinations(zip(places, values, strict=True), 2) if a != b]
    return float(np.median([rise / run for run, rise in pairs])) if pairs else 0.0
