"""What nobody sets is what the golden runs took: a default changes on purpose, with its figures, or not at all."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml

from densify.agreement import AgreementConfig
from densify.alignment import AlignmentConfig
from densify.bending import BendingConfig
from densify.fusion.rectify import RectifyConfig
from densify.fusion.volume import FusionConfig
from lightdepth.losses import LossConfig

GOLDEN = Path(__file__).parent / "golden"
CHANGED = {
    "agreement.shared_error": 0.03,
    "bending.finer": 9,
    "bending.slope_deviation": 0.25,
    "bending.layers": 7,
    "bending.columns": 3,
    "bending.reach": 0.35,
    "bending.layer_deviation": 0.1,
    "rectify.feather": 0.15,
    "fusion.front": 0.3,
    "fusion.max_error": 12.0,
}
"""Defaults that are newer than the golden runs, or have changed since; docs/far-field.md has the figures of all but the
first."""


def recorded(run: str) -> tuple[dict, list[str]]:
    """The options of a golden run, and the words of its command."""
    options = yaml.safe_load((GOLDEN / run / "config.yaml").read_text(encoding="utf-8"))
    return options, json.loads((GOLDEN / run / "run.json").read_text(encoding="utf-8"))["command"]


@pytest.mark.parametrize(
    ("section", "config"),
    [
        ("alignment", AlignmentConfig()),
        ("agreement", AgreementConfig()),
        ("bending", BendingConfig()),
        ("rectify", RectifyConfig()),
        ("fusion", FusionConfig()),
    ],
)
def test_densify_takes_by_default_what_the_golden_run_took(section, config):
    options, command = recorded("densified")
    for name, value in asdict(config).items():
        if f"--{section}.{name}" not in command:
            expected = CHANGED.get(f"{section}.{name}", options[section].get(name))
            assert (list(value) if isinstance(value, tuple) else value) == expected, name


def test_the_loss_weighs_its_terms_as_in_the_golden_training():
    then = recorded("trained")[0]["model"]["loss"]
    assert {name: value for name, value in asdict(LossConfig()).items() if name in then} == then
    assert (FusionConfig().voxels_per_distance, FusionConfig().voxel) == (52, None)
