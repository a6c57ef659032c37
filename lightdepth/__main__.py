"""`python -m lightdepth` is the command `lightdepth`."""

import sys

from lightdepth.cli import main

if __name__ == "__main__":
    sys.exit(main())
