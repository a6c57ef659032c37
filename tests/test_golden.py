"""What earlier versions wrote is still read.

`golden/` was made by 0.1.0 on a colon of 8 frames of 48x40 (`synth --seed 3 --lens pinhole`): `densified` by `densify
--checkpoint decline --fusion.voxels_per_distance 6 --withhold 0.3`, without its report; `trained` by two steps of
configs/train/tube_smoke.yaml at 32x24 with a network of width 1, with its paths made relative.
"""

from __future__ import annotations

import json
import shutil
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from lightdepth.camera import Pinhole
from lightdepth.checkpoint import load_model, read_card
from lightdepth.cli import main, parse
from lightdepth.command_line.gone_settings import GONE_SETTINGS, without_gone
from lightdepth.frame import Frame
from lightdepth.models import predict

GOLDEN = Path(__file__).parent / "golden"


def grey_frame() -> Frame:
    camera = Pinhole(32, 24, 20.0, 20.0, 16.0, 12.0)
    return Frame("0000", np.full((24, 32, 3), 0.4, np.float32), camera)


@pytest.mark.parametrize("file", ["model.safetensors", "checkpoints/last.ckpt"])
def test_a_checkpoint_of_0_1_0_still_predicts(file):
    model = load_model(GOLDEN / "trained" / file)
    (found,) = predict(model, [grey_frame()])
    assert found.distance.shape == (24, 32) and (found.distance[found.valid] > 0).all() and found.valid.any()


def test_the_card_of_a_checkpoint_of_0_1_0_is_read():
    assert read_card(GOLDEN / "trained" / "model.safetensors")["rows"] == 24


def test_a_run_folder_of_0_1_0_is_judged_by_its_withheld_points(tmp_path):
    assert main(["evaluate", str(GOLDEN / "densified"), "-o", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["withheld"]


def test_a_surface_of_0_1_0_is_measured(tmp_path):
    frame = (GOLDEN / "densified" / "map_001" / "keyframes.csv").read_text().splitlines()[1].split(",")[0]
    argv = ["measure", str(GOLDEN / "densified" / "map_001"), "--frame", str(int(Path(frame).stem))]
    assert main([*argv, "--pixels", "[[24, 20]]", "--radius", "2", "-o", str(tmp_path / "m.json")]) == 0
    assert (tmp_path / "m.json").is_file()


def parsed(verb: str, config: Path) -> dict[str, Any]:
    (entry,) = metadata.entry_points(group="lightdepth.commands", name=verb)
    return parse(entry.load(), verb, ["--config", str(config), "-o", "O"])


def test_the_settings_of_a_run_of_0_1_0_are_taken_as_they_are_but_for_those_that_are_gone():
    with pytest.warns(UserWarning, match="withhold .*blocks of wall judge it|given with each run: output") as warned:
        found = parsed("densify", GOLDEN / "densified" / "config.yaml")
    assert len(warned) == 2
    then = yaml.safe_load((GOLDEN / "densified" / "config.yaml").read_text())
    assert found["predicting"].checkpoint == then["checkpoint"]
    assert found["merging"].min_agreeing == then["merging"]["min_agreeing"]


def test_the_settings_of_a_training_of_0_1_0_are_taken_as_they_are():
    from train.parser import as_yaml, training_parser

    parser = training_parser()
    argv = without_gone("train", ["--config", str(GOLDEN / "trained" / "config.yaml"), "-o", "out"])
    now = yaml.safe_load(as_yaml(parser, parser.parse_args(argv)))
    then = yaml.safe_load((GOLDEN / "trained" / "config.yaml").read_text())
    for key in GONE_SETTINGS["train"]:
        then["trainer"].pop(key.removeprefix("trainer."), None)
    assert _of(now, then) == then  # settings that came since have their defaults


def _of(now, then):
    """What `then` has settings of."""
    return {key: _of(now[key], then[key]) if isinstance(then[key], dict) else now[key] for key in then}


def test_a_training_of_0_1_0_goes_on(tmp_path):
    shutil.copytree(GOLDEN / "trained", tmp_path / "run")
    assert main(["train", "--resume", "-o", str(tmp_path / "run"), "--trainer.max_steps", "3"]) == 0
    assert "step 3/3" in (tmp_path / "run" / "log.txt").read_text()
