"""Old names of modules, for one release: importing one gives the module of the new name, and a DeprecationWarning.

The table is asked only for modules that Python does not find, so it costs nothing where nothing old is imported. A
module that became a package of the same name needs no line here: the package's `__init__` names what stood in it.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from importlib.abc import Loader, MetaPathFinder

MOVED: dict[str, str] = {
    "densify.compiled": "lightdepth.compiled",
    "densify.fusion.compiled": "lightdepth.compiled",
    "densify.judge": "densify.evaluation.judge",
    "densify.marching": "densify.fusion.patches",
    "densify.marching_cubes": "densify.fusion.marching_cubes",
    "densify.packed": "densify.live.packed",
    "densify.plain_fusion": "densify.fusion.plain",
    "densify.play": "densify.live.play",
    "densify.rectify": "densify.fusion.rectify",
    "densify.retrieval": "lightdepth.sfm.retrieval",
    "densify.second_core": "densify.fusion.second_core",
    "densify.sfm": "lightdepth.sfm.reconstruction",
    "densify.suite": "densify.evaluation.suite",
    "densify.tables": "densify.evaluation.tables",
    "densify.trajectory": "densify.evaluation.trajectory",
    "densify.unmapped": "lightdepth.sfm.unmapped",
    "lightdepth.figures": "lightdepth.reporting.figures",
    "lightdepth.importing.measures": "lightdepth.image_quality",
    "lightdepth.light_fit": "lightdepth.light.fit_on_map",
    "lightdepth.light_page": "lightdepth.light.report",
    "lightdepth.light_truth": "lightdepth.light.fit_on_truth",
    "lightdepth.predict": "lightdepth.models",
    "lightdepth.progress": "lightdepth.reporting.progress",
    "lightdepth.report": "lightdepth.reporting.report",
    "lightdepth.run": "lightdepth.reporting.run",
}
"""Old name of a module -> new name."""


class _Package(ModuleType):
    """A package whose public names no submodule takes: Python sets a submodule as an attribute once it is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (isinstance(value, ModuleType) and name in self.__all__):
            super().__setattr__(name, value)


class _Moved:
    """A finder and loader of modules; not a subclass of importlib's, which take 20 ms to import."""

    def __init__(self, moved: Mapping[str, str]):
        self.moved = moved

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, cast("Loader", self)) if fullname in self.moved else None

    def create_module(self, spec: ModuleSpec) -> None:
        """Leaves it to Python to make a module, which is then replaced."""

    def exec_module(self, module: ModuleType) -> None:
        old, new = module.__name__, self.moved[module.__name__]
        # The frames between are importlib's own, which warnings leaves out when it counts.
        warnings.warn(f"{old} is now {new}; the next release drops the old name", DeprecationWarning, stacklevel=2)
        package = sys.modules[old.rpartition(".")[0]]
        if old.rpartition(".")[2] in getattr(package, "__all__", ()):
            package.__class__ = _Package
        sys.modules[old] = import_module(new)


def install(moved: Mapping[str, str] = MOVED) -> None:
    """Has Python ask the table last; a second call changes nothing."""
    if not any(isinstance(finder, _Moved) and finder.moved is moved for finder in sys.meta_path):
        sys.meta_path.append(cast("MetaPathFinder", _Moved(moved)))


def names_of(package: str, home: str) -> Callable[[str], object]:
    """`__getattr__` of a package that was a module: the names that stood in it are those of its new home, silently."""

    def __getattr__(name: str) -> object:
        if name.startswith("__"):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found: object = getattr(import_module(home), name)
        return found

    return __getattr__
