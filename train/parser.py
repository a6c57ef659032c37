"""The parser of `lightdepth train`: every option of the model, its data, how it is watched, and Lightning's Trainer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lightdepth.command_line.dry import DRY_RUN
from lightdepth.command_line.pages import PAGES
from lightdepth.command_line.verbs import KEEP_NAMES
from lightdepth.ranges import SEED

from .trainer_options import TrainerSettings

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

    from lightdepth.command_line.parsing import Parser

_OUTPUT = "Folder of the run to make: checkpoints, model.safetensors, logs and run.json."
_RESUME = """Go on with the run in OUTPUT from its checkpoints/last.ckpt, with its own config.yaml where no other is
given. Without it, a folder that holds a run is refused."""
_OVERWRITE = "Replace the run in OUTPUT by a new one. Without it, a folder that holds a run is refused."
_SEED = """Number that seeds all randomness: first weights, synthetic colons, order of frames and augmentation. Another
one makes another run, better or worse by chance alone."""


def training_parser() -> Parser:
    """Every option of a training run: of the model, its data, how it is watched, and Lightning's Trainer."""
    from lightdepth.command_line.parsing import Parser, finish
    from lightdepth.command_line.presets import preset_help
    from lightdepth.command_line.ranges import below, ranges_in
    from lightdepth.module import LightDepth

    from .datamodule import FrameData
    from .watching import FitConfig

    summary = "Train a depth network on frames alone, from the decline of the light."
    parser = Parser(prog="lightdepth train", description=summary, allow_abbrev=False)
    parser.add_argument("--config", action="config")
    parser.add_argument("--preset", metavar="NAME", help=preset_help("train"))
    parser.add_argument("-o", "--output", required=True, help=_OUTPUT)
    parser.add_argument("--resume", action="store_true", help=_RESUME)
    parser.add_argument("--overwrite", action="store_true", help=_OVERWRITE)
    parser.add_argument("--dry_run", action="store_true", help=DRY_RUN)
    parser.add_argument("--keep_names", action="store_true", help=KEEP_NAMES)
    parser.add_argument("--seed", type=int, default=0, help=_SEED)
    parser.add_class_arguments(LightDepth, "model")
    parser.add_class_arguments(FrameData, "data")
    parser.add_class_arguments(FitConfig, "fit")
    parser.add_class_arguments(TrainerSettings, "trainer")
    parser.link_arguments("seed", "data.seed")
    parser.link_arguments("data.size", "model.rows", compute_fn=lambda size: size[1])
    assert parser.groups is not None
    parser.groups["model"].title = "How the network learns, and from which weights"
    parser.groups["trainer"].title = "Lightning's Trainer: device, length of the run, and what is logged"
    ranges = {"seed": SEED}
    for group, made in (("model", LightDepth), ("data", FrameData), ("fit", FitConfig), ("trainer", TrainerSettings)):
        ranges |= below(group, ranges_in(made))
    finish(parser, PAGES["train"], ranges)
    return parser


def as_yaml(parser: ArgumentParser, config: Namespace) -> str:
    """The settings of a run, without where it goes and what becomes of what is there."""
    kept = config.clone()
    for key in ("config", "preset", "output", "resume", "overwrite", "dry_run", "keep_names", "quiet", "json"):
        kept.pop(key, None)
    result: str = parser.dump(kept, skip_validation=True)
    return result
