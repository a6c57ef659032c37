"""Predicted uncertainty on colons that nobody trained, calibrated or tuned on: sparsification and coverage.

LIGHTDEPTH_CHECKPOINT names a checkpoint with an uncertainty head, as configs/train/uncertainty.yaml makes one; skipped
without. Colons 42000-42017, 6 frames each at 160x128, drawn as in training. A chart goes where LIGHTDEPTH_CHART says.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from lightdepth.checkpoint import load_model
from lightdepth.tube import lens, tube_frames
from lightdepth.uncertainty import LEVELS, chart_png, coverage, doubted, sparsification, summary
from train.colons import TubeData, tube_config

SEEDS = range(42000, 42018)


def test_uncertainty_beats_chance_by_half_and_its_intervals_hold():
    checkpoint = os.environ.get("LIGHTDEPTH_CHECKPOINT")
    if not checkpoint:
        pytest.skip("LIGHTDEPTH_CHECKPOINT names no checkpoint")
    model, tube = load_model(checkpoint, details=False), TubeData()
    frames = []
    for i, seed in enumerate(SEEDS):
        camera = lens(tube.lenses[i % len(tube.lenses)], 160, 128)
        for frame in tube_frames(seed, 6, camera, travel=tube.travel, config=tube_config(tube)):
            found = model(frame)
            assert found.uncertainty is not None and frame.true_distance is not None
            frames.append(doubted(found.distance, found.uncertainty, frame.true_distance, found.valid))
    print(f"\n{checkpoint}: {summary(frames)}")
    if os.environ.get("LIGHTDEPTH_CHART"):
        Path(os.environ["LIGHTDEPTH_CHART"]).write_bytes(chart_png(frames))
    assert sparsification(frames, 2).relative < 0.5
    assert np.abs(coverage(frames) - LEVELS).max() < 0.05
