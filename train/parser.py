"""The parser of `lightdepth train`: every option of the model, its data, how it is watched, and Lightning's Trainer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lightdepth.cli import KEEP_NAMES
from lightdepth.command_line.pages import PAGES

from .trainer_options import TRAINER_OPTIONS, WITHOUT

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

_OUTPUT = "Folder of the run to make: checkpoints, model.safetensors, logs and run.json."
_RESUME = """Go on with the run in OUTPUT from its checkpoints/last.ckpt, with its own config.yaml where no other is
given. Without it, a folder that holds a run is refused."""
_OVERWRITE = "Replace the run in OUTPUT by a new one. Without it, a folder that holds a run is refused."
_SEED = """Number that all chance follows from: first weights, synthetic colons, order of frames and augmentation.
Another one makes another run, better or worse by chance alone."""


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
    parser.add_argument("-o", "--output", required=True, help=_OUTPUT)
    parser.add_argument("--resume", action="store_true", help=_RESUME)
    parser.add_argument("--overwrite", action="store_true", help=_OVERWRITE)
    parser.add_argument("--keep_names", action="store_true", help=KEEP_NAMES)
    parser.add_argument("--seed", type=int, default=0, help=_SEED)
    parser.add_class_arguments(LightDepth, "model")
    parser.add_class_arguments(FrameData, "data")
    parser.add_class_arguments(FitConfig, "fit")
    parser.add_class_arguments(pl.Trainer, "trainer", instantiate=False, skip=WITHOUT)
    parser.link_arguments("seed", "data.seed")
    parser.link_arguments("data.size", "model.rows", compute_fn=lambda size: size[1])
    parser.set_defaults(TRAINER_DEFAULTS)
    for action in parser._actions:
        action.help = TRAINER_OPTIONS.get(action.dest, action.help)
    assert parser.groups is not None
    parser.groups["model"].title = "How the network learns, and from which weights"
    parser.groups["trainer"].title = "Lightning's Trainer: device, length of the run, and what is logged"
    finish(parser, PAGES["train"])
    return parser


def as_yaml(parser: ArgumentParser, config: Namespace) -> str:
    """The settings of a run, without where it goes and what becomes of what is there."""
    kept = config.clone()
    for key in ("config", "preset", "output", "resume", "overwrite", "keep_names"):
        kept.pop(key, None)
    result: str = parser.dump(kept, skip_validation=True)
    return result
