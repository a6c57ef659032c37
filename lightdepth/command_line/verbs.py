"""The verbs, found through the entry points `lightdepth.commands`, and the parsers of their options."""

from __future__ import annotations

import ast
import inspect
import sys
from importlib import metadata, util
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightdepth.command_line import dry
from lightdepth.command_line.pages import PAGES, Page

if TYPE_CHECKING:
    from lightdepth.command_line.parsing import Parser

GROUP = "lightdepth.commands"
KEEP_NAMES = """Write the paths of inputs as they are into run.json, log and reports. Without it, each input is named
there by its option and a hash of its contents, because paths often hold names of patients; only inputs.json has the
paths."""
ORDER = (
    "demo",
    "doctor",
    "synth",
    "import",
    "calibrate-light",
    "convert-camera",
    "select",
    "train",
    "adapt",
    "ablate",
    "predict",
    "sparse",
    "densify",
    "batch",
    "live",
    "evaluate",
    "bench",
    "scale",
    "measure",
    "view",
    "export",
    "completion",
)


def parsers_of(verb: str, function: Any) -> dict[str, Parser]:
    """The parsers of a verb: under "" its own, and under the words that may follow it those of its other ways. A verb
    that parses its own arguments has a function `parsers` beside it."""
    if list(inspect.signature(function).parameters) == ["argv"]:
        made: dict[str, Parser] = sys.modules[function.__module__].parsers()
        return made
    return {"": verb_parser(function, verb)}


def all_verbs() -> dict[str, metadata.EntryPoint]:
    """The verbs in the order of the work."""
    found = {entry.name: entry for entry in metadata.entry_points(group=GROUP)}
    order = sorted(found, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))
    return {name: found[name] for name in order}


def summary_of(entry: metadata.EntryPoint) -> str:
    """First line of the verb's docstring, read from the source: importing it would cost seconds."""
    spec = util.find_spec(entry.module)
    if spec is None or spec.origin is None:
        return ""
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8-sig")).body:
        if isinstance(node, ast.FunctionDef) and node.name == entry.attr:
            return (ast.get_docstring(node) or "").split("\n")[0]
    return ""


def verb_parser(function: Any, verb: str) -> Parser:
    """The options of a verb: the parameters of its function."""
    from docstring_parser import parse as parse_docstring

    from lightdepth.command_line.options import add_groups, groups_of
    from lightdepth.command_line.parsing import Parser, finish
    from lightdepth.command_line.presets import preset_help, presets
    from lightdepth.command_line.ranges import ranges_in

    said = {p.arg_name: p.description for p in parse_docstring(inspect.getdoc(function) or "").params}
    # The first line only: jsonargparse shows the rest of the docstring beside the options.
    summary = (inspect.getdoc(function) or "").split("\n")[0]
    parser = Parser(prog=f"lightdepth {verb}", description=summary, default_env=False)
    parser.add_argument("--config", action="config")
    if presets(verb):
        parser.add_argument("--preset", metavar="NAME", help=preset_help(verb))
    parameters = inspect.signature(function).parameters
    # Declared here, because options derived from parameters have no short form and no bare flags.
    if "output" in parameters:
        default = parameters["output"].default
        needed = default is inspect.Parameter.empty
        parser.add_argument(
            "-o",
            "--output",
            type=Path if needed else Path | None,  # a folder may be called null
            required=needed,
            default=None if needed else default,
            help=said.get("output"),
        )
    if "overwrite" in parameters:
        parser.add_argument("--overwrite", action="store_true", help=said.get("overwrite"))
    if "no_frames" in parameters:
        parser.add_argument("--no_frames", action="store_true", help=said.get("no_frames"))
    if verb in dry.VERBS:
        parser.add_argument("--dry_run", action="store_true", help=dry.DRY_RUN)
    if "output" in parameters and "keep_names" not in parameters:
        parser.add_argument("--keep_names", action="store_true", help=KEEP_NAMES)
    declared: set[str | int] = {name for name in ("output", "overwrite", "no_frames") if name in parameters}
    add_groups(parser, function)
    parser.add_function_arguments(
        function, as_positional=True, sub_configs=True, skip={*declared, *groups_of(function)}
    )
    finish(parser, PAGES.get(verb, Page()), ranges_in(function))
    return parser
