"""From nothing to a surface: train on colons, resume, densify a colon of another seed with the checkpoint, evaluate."""

import json
from pathlib import Path

import pytest

from lightdepth.cli import main

SMOKE = Path(__file__).resolve().parents[1] / "configs" / "train" / "tube_smoke.yaml"
SMALL = ["--data.tube.scenes", "4", "--data.tube.val_scenes", "2", "--data.tube.frames", "4"]


def train(output: Path, steps: int, *more: str) -> dict:
    options = ["--trainer.max_steps", str(steps), "--trainer.val_check_interval", "40", *SMALL, *more]
    assert main(["train", "--config", str(SMOKE), "-o", str(output), *options]) == 0
    return json.loads((output / "run.json").read_text())


def validation_losses(log: Path) -> list[float]:
    lines = [line for line in log.read_text().splitlines() if "validation loss" in line and line.startswith("step")]
    return [float(line.split("validation loss")[1].split()[0]) for line in lines]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_checkpoint_trained_on_colons_densifies_another_colon(tmp_path, capsys):
    first = train(tmp_path / "run", 80)
    assert first["steps"] == 80
    resumed = train(tmp_path / "run", 160, "--resume")
    assert resumed["resumed"] and resumed["steps"] == 160
    log = (tmp_path / "run" / "log.txt").read_text()
    assert "step 16/" not in log.split("resuming from")[1], "a resumed run continues from its step"
    losses = validation_losses(tmp_path / "run" / "log.txt")
    assert losses[-1] < losses[0], losses

    synth = ["synth", "-o", tmp_path / "colon", "--seed", 901, "--frames", 12, "--size", "[160,128]", "--travel-mm", 10]
    synth += ["--slam.kind", "independent"]
    assert main([str(a) for a in synth]) == 0
    checkpoint = tmp_path / "run" / "model.safetensors"
    densify = ["densify", tmp_path / "colon", "--map", tmp_path / "colon" / "slam", "--checkpoint", checkpoint]
    assert main([str(a) for a in [*densify, "-o", tmp_path / "dense"]]) == 0
    assert main(["evaluate", str(tmp_path / "dense"), "--truth", str(tmp_path / "colon")]) == 0
    metrics = json.loads((tmp_path / "dense" / "evaluation" / "metrics.json").read_text())
    for row in metrics["maps"]:
        dense, sparse = row["dense"], row["sparse"]
        print(f"map {row['map']}: dense RMS {dense['rms_mm']:.2f} median {dense['median_mm']:.2f} mm")
        assert dense["points"] > 3 * sparse["points"]
        assert dense["rms_mm"] < 10 and dense["rms_mm"] < sparse["rms_mm"] / 3
