"""Whatever this program writes appears whole: an audit of every call that writes a file, over the source.

A call is whole when it is inside `write_whole` or `write_together`, or writes below `run.folder`, the folder of a run
in the making. A function that writes where it is told has a name that begins with `write_`; whoever calls it is looked
at in its place. What cannot be seen so is named below, with its reason.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MACHINERY = (
    "lightdepth/files/writing.py",  # write_whole itself
    "lightdepth/files/replacing.py",  # how a finished folder takes its place
    "lightdepth/files/lock.py",
    "lightdepth/reporting/run.py",  # the folder in the making: log.txt, config.yaml
    "lightdepth/reporting/names.py",  # texts of the folder in the making, before run.json is
    "lightdepth/reporting/unfinished.py",  # what is kept of a run that can be resumed
)
_HIDDEN = "in a temporary folder that is hidden in the run folder in the making, whose models arrive by a rename"
_RUN = "it is given the run, or its folder in the making"
ALLOWED = {
    "lightdepth/command_line/outcome.py: _streams": "os.devnull, where --quiet says all that it does not say",
    "lightdepth/commands/convert_camera.py: convert_camera": "each format's writer uses write_whole",
    "lightdepth/commands/import_frames.py: import_frames": _RUN,
    "lightdepth/commands/predict.py: _written": _RUN,
    "lightdepth/exporting/example.py: main": "an example that is exported, and that users run by themselves",
    "densify/batch/work.py: batch_run": "write_table uses write_together",
    "lightdepth/reporting/kept.py: kept": _RUN,
    "lightdepth/prediction.py: save": "predict gives it the run's folder",
    "lightdepth/reporting/batches.py: finish": _HIDDEN,
    "lightdepth/reporting/report.py: write": "verbs give it the run's folder, or write_together",
    "lightdepth/sfm/features.py: _match": _HIDDEN,
    "lightdepth/sfm/mapping.py: mapped": _HIDDEN,
    "lightdepth/sfm/reconstruction.py: sparse_map_from_frames": _HIDDEN,
    "lightdepth/sfm/reconstruction.py: _triangulated": _HIDDEN,
    "lightdepth/sfm/reconstruction.py: _move_models": _HIDDEN,
    "lightdepth/sfm/repair.py: repaired_submap": _HIDDEN,
    "lightdepth/sfm/repair.py: _as_it_was": _RUN,
    "lightdepth/sfm/self_calibration.py: self_calibrated": "in a temporary folder that is no output",
    "lightdepth/uncalibrated.py: found_camera": "in a temporary folder that is no output",
    "densify/commands/bench.py: run": _RUN,
    "densify/commands/bench.py: compare_estimators": _RUN,
    "densify/commands/bench.py: compare_per_frame": _RUN,
    "densify/commands/bench.py: compare_completions": _RUN,
    "densify/commands/bench_speed.py: measure_speed": _RUN,
    "densify/speed/work.py: measured": "in a temporary folder that is no output",
    "densify/bench/completion/run.py: _write": _RUN,
    "densify/thumbnails.py: write": _RUN,
    "densify/dense_map.py: write": _RUN,
    "densify/densified.py: write": _RUN,
    "densify/exporting/work.py: export_maps": _RUN,
    "densify/viewing/drawn.py: gltf": "bytes for a browser: there is no file",
    "train/commands/ablate.py: _ablate": "write_table and write_inputs use write_whole",
    "train/checkpoints.py: _keep": "renames a checkpoint that write_whole wrote: the one before is kept",
    "train/frame_cache.py: keep": "write_remade renames, and what it writes shows by its sum whether it is whole",
    "train/fit.py: _fitted": "write_inputs uses write_whole",
    "train/watching.py: __call__": "log.txt of a training, which grows while it lasts",
    "train/commands/adapt.py: _fit": _RUN,
}
"""Where a path is not seen to be below a run folder, and why it is whole nevertheless."""
WRITERS = {"write_text", "write_bytes", "imwrite", "savez", "savez_compressed", "savetxt", "save_file", "tofile"}
WRITERS |= {"to_csv", "write_triangle_mesh", "write_point_cloud", "copyfile", "copytree", "copy2", "rename"}
WRITERS |= {"symlink_to", "hardlink_to", "extractall"}
OF_MODULES = {"np": {"save"}, "torch": {"save"}, "json": {"dump"}, "pickle": {"dump"}, "os": {"replace", "link"}}
OF_MODULES |= {"shutil": {"copy", "move"}, "export": {"save"}, "made": {"export", "save"}, "mesh": {"export"}}


def sources() -> Iterator[tuple[str, ast.Module]]:
    for package in ("lightdepth", "densify", "train"):
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if name not in MACHINERY:
                yield name, ast.parse(path.read_text(encoding="utf-8"))


def named(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def writes(call: ast.Call) -> bool:
    """Whether a call writes a file itself, by its name and, of `open`, by its mode."""
    name, owner = named(call), call.func.value if isinstance(call.func, ast.Attribute) else None
    if name == "open":
        given = [*call.args[:2], *(k.value for k in call.keywords if k.arg == "mode")]
        modes = [a.value for a in given if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        return any(set(mode.partition(":")[0]) & set("wax+") and len(mode) < 5 for mode in modes)
    of = owner.attr if isinstance(owner, ast.Attribute) else getattr(owner, "id", "")
    return name in WRITERS or name in OF_MODULES.get(of, ())


def calls(node: ast.AST, inside: tuple[ast.AST, ...] = ()) -> Iterator[tuple[ast.Call, tuple[ast.AST, ...]]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Call):
            yield child, inside
        yield from calls(child, (*inside, child))


def whole(call: ast.Call, inside: tuple[ast.AST, ...]) -> bool:
    """Whether what a call writes appears whole: it is told so by what it stands in, or by its path."""
    if any(isinstance(n, ast.Call) and named(n) in ("write_whole", "write_together") for n in inside):
        return True
    return any(isinstance(n, ast.Attribute) and n.attr == "folder" for n in ast.walk(call))


def writes_where_told(name: str) -> bool:
    """Whether a function is one that writes at a path that it is given: our names say so."""
    return name.lstrip("_").startswith("write_") and name not in ("write_whole", "write_together", "write_run_json")


def not_whole() -> Iterator[tuple[str, str]]:
    """Function and code of each call that writes in place, but in functions that write where they are told."""
    for file, tree in sources():
        for call, inside in calls(tree):
            if not (writes(call) or writes_where_told(named(call))) or whole(call, inside):
                continue
            functions = [n.name for n in inside if isinstance(n, ast.FunctionDef)] or [""]
            if not writes_where_told(functions[-1]):
                yield f"{file}: {functions[-1]}", ast.unparse(call)


def test_every_file_is_written_whole_or_below_a_run_folder_in_the_making():
    found = dict(not_whole())
    assert not {where: code for where, code in found.items() if where not in ALLOWED}
    assert not set(ALLOWED) - set(found), "no longer needed"
