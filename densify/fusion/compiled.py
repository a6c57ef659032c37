"""compiled(): a loop over arrays as machine code, by Numba: made at the first call, kept on disk for the next process.

Numba notices that a function's own file has changed, and no other: a compiled function may call only what is compiled
in the same file. Numbers without a type are double precision; where single is meant, np.float32 is written.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one thread, with the interpreter's lock released.

    Machine code is kept beside the source, or in the user's cache, or where NUMBA_CACHE_DIR says; where nothing can be
    written, each process makes its own.
    """
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no place to keep it
        return numba.njit(nogil=True, error_model="numpy")(function)
