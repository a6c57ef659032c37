"""The order of the house: how long modules are, how wide functions are, and where values without a type may be."""

from __future__ import annotations

import ast
import inspect
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, get_type_hints

import pytest

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["lightdepth"]
PACKAGES = ("lightdepth", "densify", "train")
Function = ast.FunctionDef | ast.AsyncFunctionDef


def modules(*packages: str) -> dict[str, Path]:
    """Files of packages, by the name of the module."""
    files = (path for package in packages for path in sorted((ROOT / package).rglob("*.py")))
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}


@cache
def functions() -> list[tuple[str, Function]]:
    """All functions outside tests, by place."""
    found = []
    for name, path in modules(*PACKAGES).items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, Function):
                found.append((f"{name}:{node.lineno} {node.name}", node))
    return found


def parameters(function: Function) -> list[str]:
    named = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    names = [a.arg for a in (*named, function.args.vararg, function.args.kwarg) if a is not None]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def compiled(function: Function) -> bool:
    """By Numba, or as a kernel of Warp: either takes arrays and numbers, and no record of them."""
    decorators = [ast.unparse(decorator) for decorator in function.decorator_list]
    return any("compiled" in each or each.startswith("wp.kernel") for each in decorators)


def verbs() -> Iterator[tuple[str, Callable[..., Any]]]:
    """The functions whose parameters are options: the verbs, and where one has several ways, each of them."""
    for entry in metadata.entry_points(group="lightdepth.commands"):
        verb = entry.load()
        if list(inspect.signature(verb).parameters) != ["argv"]:
            yield entry.name, verb
    from densify.commands import bench

    yield from (("bench", bench.run), ("bench compare", bench.compare_runs))
    yield "bench estimators", bench.compare_estimators
    yield "bench per-frame", bench.compare_per_frame
    yield "bench completion", bench.compare_completions
    yield "bench speed", bench.measure_speed


def test_values_without_a_type_are_only_where_files_are_read_and_written():
    untyped = {name for name, path in modules("densify", "train").items() if "dict[str, Any]" in path.read_text()}
    assert untyped == set(SETTINGS["untyped"])


@pytest.mark.parametrize(("folder", "most"), [*((package, 400) for package in PACKAGES), ("tests", 600)])
def test_no_module_is_longer_than_one_reads_at_once(folder, most):
    lengths = {name: len(path.read_text().splitlines()) for name, path in modules(folder).items()}
    assert [name for name, length in lengths.items() if length > most] == []


def test_no_function_has_more_than_twelve_parameters():
    wide = [place for place, function in functions() if len(parameters(function)) > 12 and not compiled(function)]
    assert wide == []


def test_no_verb_has_more_than_ten_options_besides_its_settings():
    wide = {}
    for name, verb in verbs():
        own = [hint for key, hint in get_type_hints(verb).items() if key != "return" and not is_dataclass(hint)]
        if len(own) > 10:
            wide[name] = len(own)
    assert wide == {}


def passed_on(function: Function) -> list[ast.Call]:
    """Calls that are given the arguments a function has no name for. Overriding a library's method may be done so:
    what else it takes is the library's own affair."""
    given = function.args.kwarg
    if given is None:
        return []
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    spread = [(call, k.value) for call in calls for k in call.keywords if k.arg is None]
    through = [
        call for call, value in spread if given.arg in {n.id for n in ast.walk(value) if isinstance(n, ast.Name)}
    ]
    return [call for call in through if ast.unparse(call.func) != f"super().{function.name}"]


def test_no_function_passes_on_arguments_that_it_does_not_name():
    assert [place for place, function in functions() if passed_on(function)] == []


def test_the_method_fits_on_a_screen():
    """densify_submap with what it calls in its own module; everything else that it calls has a room of its own."""
    source = (ROOT / "densify" / "pipeline.py").read_text()
    own = {node.name: node for node in ast.parse(source).body if isinstance(node, Function)}
    method = own["densify_submap"]
    called = {node.id for node in ast.walk(method) if isinstance(node, ast.Name)} & own.keys()
    lengths = [(own[name].end_lineno or 0) - own[name].lineno + 1 for name in {"densify_submap", *called}]
    assert ast.get_docstring(method) and sum(lengths) <= 50


PARSED_IN = {
    # files.arrays looks at what is declared first; these two read what a run of ours left for itself to go on with
    "np.load": {"lightdepth.files.packed", "lightdepth.reporting.batches"},
    "np.fromfile": set(),
    "np.genfromtxt": set(),
    "np.loadtxt": {"lightdepth.files.tum", "lightdepth.datasets.c3vd", "lightdepth.datasets.simcol"},
    "loadmat": set(),  # SciPy's crashes on spoilt files; calibration.mat_file reads them
    "trimesh.load": {"lightdepth.files.meshes"},
    "zipfile.ZipFile": {"lightdepth.files.arrays", "lightdepth.files.weights"},
    "tarfile.open": {"lightdepth.datasets.scared_files", "lightdepth.datasets.scared_writing"},
    "msgpack.unpackb": {"lightdepth.maps.stella"},
    "cv2.imread": {"densify.speed.stages"},  # of what it wrote itself, to be beside it in time
    "cv2.imdecode": {"lightdepth.files.images", "lightdepth.tube.sensor"},  # the second, of what it packed itself
    "Image.open": {"lightdepth.files.headers", "lightdepth.exporting.example"},  # the second is a script for others
    "av.open": {"lightdepth.datasets.video", "lightdepth.datasets.endomapper", "lightdepth.datasets.scared_writing"},
    "pydicom.dcmread": {"lightdepth.datasets.dicom"},
}


def test_libraries_parse_files_only_in_rooms_that_turn_what_they_raise_into_words_and_look_at_sizes_first():
    found: dict[str, set[str]] = {call: set() for call in PARSED_IN}
    for name, path in modules(*PACKAGES).items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and (called := ast.unparse(node.func)) in found:
                found[called].add(name)
    assert found == PARSED_IN
