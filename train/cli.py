"""`lightdepth train`."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from lightdepth.command_line.pages import PAGES

from .trainer_options import TRAINER_OPTIONS

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

    from lightdepth.command_line.parsing import Parser

TRAINER_DEFAULTS = {
    "trainer.max_steps": 1500,
    "trainer.val_check_interval": 250,
    "trainer.check_val_every_n_epoch": None,  # so that the interval counts steps, not epochs
    "trainer.num_sanity_val_steps": 0,
    "trainer.gradient_clip_val": 1.0,
    "trainer.log_every_n_steps": 10,
    "trainer.enable_model_summary": False,
}


def train(argv: list[str] | None = None) -> int:
    """Train a depth network on frames alone, from the decline of the light.

    `lightdepth train --preset NAME -o RUN [--resume | --overwrite] [overrides]`: every option of data, model and
    Lightning's Trainer is a dotted override. `--resume` without --preset and --config takes the run's config.yaml.
    """
    import lightning.pytorch as pl

    from lightdepth.command_line.gone_settings import without_gone
    from lightdepth.command_line.parsing import parsed
    from lightdepth.command_line.presets import with_preset

    from .datamodule import FrameDataModule
    from .fit import check_output, fit

    given = list(sys.argv[1:] if argv is None else argv)
    parser = training_parser()
    argv = without_gone("train", _with_own_config(with_preset("train", given, parser.error)))
    config = parsed(parser, argv)

    output = Path(config.output)
    check_output(output, config.resume, config.overwrite)  # before the seconds that the rest takes
    pl.seed_everything(config.seed, workers=True, verbose=False)
    made = parser.instantiate(config)
    text = as_yaml(parser, config)
    flags = {"resume": config.resume, "overwrite": config.overwrite, "arguments": given, "settings": made.fit}
    fit(made.model, FrameDataModule(made.data), output, vars(made.trainer), text, config.seed, **flags)
    return 0


def training_parser() -> Parser:
    """Every option of a training run: of the model, its data, how it is watched, and Lightning's Trainer."""
    import lightning.pytorch as pl

    from lightdepth.command_line.parsing import Parser, finish
    from lightdepth.command_line.presets import preset_help
    from lightdepth.module import LightDepth

    from .datamodule import FrameData
    from .fit import FitConfig

    summary = "Train a depth network on frames alone, from the decline of the light."
    parser = Parser(prog="lightdepth train", description=summary, allow_abbrev=False)
    parser.add_argument("--config", action="config")
    parser.add_argument("--preset", metavar="NAME", help=preset_help("train"))
    parser.add_argument("-o", "--output", required=True, help="Folder of the run, with its checkpoints and its model.")
    parser.add_argument("--resume", action="store_true", help="Go on from the run's own checkpoints/last.ckpt.")
    parser.add_argument("--overwrite", action="store_true", help="Replace a run that is already there.")
    seed = "Number that draws weights, colons, order and augmentation. Another one makes another run."
    parser.add_argument("--seed", type=int, default=0, help=seed)
    parser.add_class_arguments(LightDepth, "model")
    parser.add_class_arguments(FrameData, "data")
    parser.add_class_arguments(FitConfig, "fit")
    parser.add_class_arguments(pl.Trainer, "trainer", instantiate=False, skip={"default_root_dir"})
    parser.link_arguments("seed", "data.seed")
    parser.link_arguments("data.size", "model.rows", compute_fn=lambda size: size[1])
    parser.set_defaults(TRAINER_DEFAULTS)
    for action in parser._actions:
        action.help = TRAINER_OPTIONS.get(action.dest, action.help)
    assert parser.groups is not None
    parser.groups["trainer"].title = "Lightning's Trainer"
    finish(parser, PAGES["train"])
    return parser


def as_yaml(parser: ArgumentParser, config: Namespace) -> str:
    """The settings of a run, without where it goes and what becomes of what is there."""
    kept = config.clone()
    for key in ("config", "preset", "output", "resume", "overwrite"):
        kept.pop(key, None)
    result: str = parser.dump(kept, skip_validation=True)
    return result


def _with_own_config(argv: list[str]) -> list[str]:
    """`--resume` without --preset and --config takes the config.yaml of the run."""
    if "--resume" not in argv or any(a == "--config" or a.startswith("--config=") for a in argv):
        return argv
    for flag, value in pairwise([*argv, ""]):
        folder = flag.partition("=")[2] if flag.startswith("--output=") else value if flag in ("-o", "--output") else ""
        if folder and (Path(folder) / "config.yaml").is_file():
            return ["--config", str(Path(folder) / "config.yaml"), *argv]
    return argv
