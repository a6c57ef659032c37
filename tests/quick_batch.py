"""The command lightdepth, whose `batch` makes its runs in an instant: what is tried is how it is killed and goes on."""

from __future__ import annotations

import sys

from sequences import quick_run

import densify.batch.make
from lightdepth.cli import main

if __name__ == "__main__":
    densify.batch.make.dense_run = quick_run
    sys.exit(main(sys.argv[1:]))
