"""compiled(): a loop over arrays as machine code, by Numba: made at the first call, kept on disk for the next process.

Numba notices that a function's own file has changed, and no other: a compiled function may call only what is compiled
in the same file. Numbers without a type are double precision; where single is meant, np.float32 is written.

What is kept is a pickle that is loaded and machine code that is run: it lies in a folder of the user's own that nobody
else may write to, and what is damaged there is thrown away and made anew.
"""

# Numba has no annotations.
# mypy: disable-error-code="no-untyped-call, misc, no-any-return, attr-defined"

from __future__ import annotations

import hashlib
import pickle
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)

from lightdepth.command_line.heartbeat import compiles
from lightdepth.native import open_to_others, user_cache


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one thread, with the interpreter's lock released.

    Machine code is kept in `cache_folder()`; where nothing can be written, each process makes its own.
    """
    made = numba.njit(nogil=True, error_model="numpy")(function)
    if hasattr(made, "_cache"):  # not with Numba off, which leaves the function as it is
        with suppress(RuntimeError, OSError):  # no place to keep it
            made._cache = _Kept(function)
    return made


def cache_folder() -> Path | None:
    """Where machine code is kept: NUMBA_CACHE_DIR, or a folder of the user's; None where there is none."""
    given = numba.config.CACHE_DIR  # set at run time
    if given:
        return Path(given)
    home = user_cache()
    return None if home is None else home / "compiled"


class _Own(UserWideCacheLocator):
    """`cache_folder()`, mode 700, where it is nobody else's."""

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)
        folder = cache_folder()
        self._folder = folder
        self._cache_path = str((folder or Path()) / self.get_suitable_cache_subpath(file))

    def ensure_cache_path(self) -> None:
        if self._folder is None:
            raise OSError("no home")
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if open_to_others(self._folder):
            raise OSError("others may write there")
        super().ensure_cache_path()


class _Place(CompileResultCacheImpl):
    _locator_classes: ClassVar = [UserProvidedCacheLocator, _Own]


class _Files(IndexDataCacheFile):
    """Machine code with its digest before it: half a file would crash the process, not raise."""

    def _save_data(self, name: str, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(hashlib.sha256(content).digest() + content)

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        if hashlib.sha256(content[32:]).digest() != content[:32]:
            raise ValueError("damaged")
        return pickle.loads(content[32:])


class _Kept(FunctionCache):
    """Machine code of a function on disk. What cannot be read or written there costs time, and never the run."""

    _impl_class = _Place

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = self._loaded(sig, target_context)
        compiles(id(self), begins=found is None)
        return found

    def _loaded(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except OSError:
            return None
        except Exception:  # half a pickle can raise anything
            warnings.warn(f"{self._cache_path}: damaged machine code is deleted and compiled anew", stacklevel=2)
            self._empty()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        compiles(id(self), begins=False)
        for _ in range(2):
            try:
                super().save_overload(sig, data)
                return
            except OSError:
                return
            except Exception:  # the index, which is read first, is damaged
                self._empty()

    def _empty(self) -> None:
        with suppress(OSError):
            self.flush()
