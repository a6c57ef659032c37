"""The packages that come with `lightdepth` win over a user's files of the same name.

A folder with a `train.py` of one's own is no rarity, and Python looks there first under `python -m` and with
PYTHONPATH=. . Folders that hold such files are moved to the end of sys.path, which processes that are started later
(loader workers, spawned or forked) take over. Nothing is put in front: the standard library must stay before the
folder that packages are installed in.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

from lightdepth.errors import InputError

NAMES = ("train", "densify")


def own_packages_first(home: Path = Path(__file__).resolve().parents[2]) -> None:
    """Makes NAMES mean the packages in `home`, the folder that `lightdepth` was imported from.

    Raises InputError when another module of such a name is loaded already: whoever loaded it may still need it.
    """
    for name in NAMES:
        spec = getattr(sys.modules.get(name), "__spec__", None)
        if spec is not None and _is_foreign(spec, name, home):
            raise InputError(
                spec.origin,
                f"loaded under the name {name!r}, which lightdepth's own package has",
                "run lightdepth in a process of its own, or rename that file",
            )
    foreign = [entry for entry in sys.path if any(_is_foreign(_found(name, entry), name, home) for name in NAMES)]
    if foreign:
        others = [entry for entry in sys.path if entry not in foreign]
        # An editable installation is found by a hook that comes after sys.path, so its folder need not be there.
        own = [] if any(_same(entry, home) for entry in others) else [str(home)]
        sys.path[:] = [*others, *own, *foreign]


def _found(name: str, entry: str) -> ModuleSpec | None:
    return PathFinder.find_spec(name, [entry])


def _is_foreign(spec: ModuleSpec | None, name: str, home: Path) -> bool:
    """A module or package with code. A folder without __init__.py never wins over a package."""
    if spec is None or spec.origin is None:
        return False
    return not _same(spec.origin, home / name / "__init__.py")


def _same(path: str, other: Path) -> bool:
    return os.path.realpath(path or os.curdir) == os.path.realpath(other)
