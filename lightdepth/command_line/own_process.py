"""What a process that is all ours is set to, before anything is loaded; a caller's process is left as it is."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os

_MB = 1 << 20
_ALLOCATOR = {-3: 32 * _MB, -1: 256 * _MB, -2: 64 * _MB}
"""By glibc's number of each option (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD, M_TOP_PAD): what is larger is asked of the
system each time, how much may be kept at the end of the heap, and by how much it grows."""


def set_own_process() -> None:
    """One thread for the solvers, and an allocator that keeps what was freed; what the user has set holds. An end that
    does not look through all objects, several times, for what nobody needs any more.

    Systems that are solved are many and small: threads of each would wait for each other, for long where a container or
    other work leaves fewer cores than the machine has. Images and feature maps of a few megabytes come and go all the
    time, and by default each goes back to the system, which hands out new pages, one by one and full of zeros.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    atexit.register(gc.freeze)
    if not any(name.startswith("MALLOC_") for name in os.environ):
        _keep_freed_memory()


def _keep_freed_memory() -> None:
    try:
        mallopt = ctypes.CDLL(None).mallopt  # glibc's
    except (OSError, AttributeError, TypeError):
        return
    for option, value in _ALLOCATOR.items():
        mallopt(option, value)
