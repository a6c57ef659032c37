"""What a process is set to that is all ours."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys

import pytest

HAS_MALLOPT = hasattr(ctypes.CDLL(None), "mallopt")
CODE = """
import resource, sys
from lightdepth.command_line.own_process import set_own_process
if "ours" in sys.argv:
    set_own_process()
import numpy as np
def used():
    for _ in range(3):
        [np.ones(1 << 20) for _ in range(16)]  # 8 MB each, all freed at once, as the maps of a network are
used()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
used()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def new_pages(*words: str, **more: str) -> int:
    """Pages that the system hands out for arrays of sizes that were in use before."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")} | more
    # Pages of the usual size, which are counted one by one, whatever the machine prefers
    off = "import ctypes; ctypes.CDLL(None).prctl(41, 1, 0, 0, 0);"
    done = subprocess.run([sys.executable, "-c", off + CODE, *words], env=env, capture_output=True, check=True)
    return int(done.stdout)


@pytest.mark.skipif(not HAS_MALLOPT, reason="this C library has no mallopt")
def test_memory_that_was_freed_is_used_again():
    assert new_pages("ours") < 100 < 10_000 < new_pages()


@pytest.mark.skipif(not HAS_MALLOPT, reason="this C library has no mallopt")
def test_an_allocator_that_the_user_has_set_stays_as_it_is():
    assert new_pages("ours", MALLOC_MMAP_THRESHOLD_="65536") > 10_000
