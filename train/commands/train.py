"""The verb train: a depth network on frames alone."""

from __future__ import annotations

import sys
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from pathlib import Path
from shlex import quote

import lightning.pytorch as pl

from lightdepth.command_line.dry import DRY
from lightdepth.command_line.gone_settings import without_gone
from lightdepth.command_line.mistakes import fail
from lightdepth.command_line.outcome import end, outcome
from lightdepth.command_line.parsing import Parser, parsed
from lightdepth.command_line.presets import with_preset
from lightdepth.files.replacing import unfinished_path
from lightdepth.reporting.names import KEPT
from lightdepth.reporting.own_settings import with_real_settings
from lightdepth.reporting.same import paths_in

from ..datamodule import FrameDataModule
from ..fit import fit
from ..folder import check_output, first_process
from ..parser import as_yaml, training_parser


def train(argv: list[str] | None = None) -> int:
    """Train a depth network on frames alone, from the decline of the light.

    `lightdepth train --preset NAME -o RUN [--resume | --overwrite] [overrides]`: every option of data, model and
    Lightning's Trainer is a dotted override. `--resume` without --preset and --config takes the run's config.yaml.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    if not first_process():
        outcome().json = False  # the first one prints the document of all
    parser = training_parser()
    argv = without_gone(
        "train", with_real_settings(_with_own_config(with_preset("train", given, partial(fail, parser))))
    )
    config = parsed(parser, argv)
    KEPT.set(config.keep_names)
    DRY.set(config.dry_run)

    output = Path(config.output)
    inputs = paths_in(config.as_dict())
    check_output(output, config.resume, config.overwrite, inputs)  # before the seconds that the rest takes
    pl.seed_everything(config.seed, workers=True, verbose=False)
    made = parser.instantiate(config)
    text = as_yaml(parser, config)
    flags = {"resume": config.resume, "overwrite": config.overwrite, "arguments": given, "settings": made.fit}
    flags["inputs"] = inputs
    fit(made.model, FrameDataModule(made.data), output, asdict(made.trainer), text, config.seed, **flags)
    if first_process():
        outcome().made(output)
        then = f"lightdepth densify DATA --map MAP --checkpoint {quote(str(output / 'model.safetensors'))} -o runs/own"
        end(output, then=then, page=output / "report.html")
    return 0


def parsers() -> dict[str, Parser]:
    """What the command line of train is."""
    return {"": training_parser()}


def _with_own_config(argv: list[str]) -> list[str]:
    """`--resume` without --preset and --config takes the config.yaml of the run that goes on: one that was to take the
    place of a finished one lies beside it."""
    if "--resume" not in argv or any(a == "--config" or a.startswith("--config=") for a in argv):
        return argv
    for flag, value in pairwise([*argv, ""]):
        folder = flag.partition("=")[2] if flag.startswith("--output=") else value if flag in ("-o", "--output") else ""
        for place in (unfinished_path(Path(folder).resolve()), Path(folder)) if folder else ():
            if (place / "config.yaml").is_file():
                return ["--config", str(place / "config.yaml"), *argv]
    return argv
