"""The bundled checkpoint beside the closed form, on colons that it was not trained and not tuned on.

Median-aligned errors of depth [mm] over the frame mask with 0 < depth < 100 mm, mean over frames; colons with weak and
with strong interreflection apart. Run by `make bench`.
"""

from dataclasses import replace

import numpy as np
import pytest

from densify.evaluation import evaluate_depth
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.tube import TubeConfig, lens, tube_frames

SEEDS = range(5000, 5018)
KEYS = ("abs_rel_median", "rmse_mm_median", "medae_mm_median")


@pytest.mark.parametrize("reflectance", [(0.0, 0.3), (0.4, 0.7)], ids=["weak", "strong"])
def test_the_bundled_checkpoint_is_not_worse_than_the_closed_form(reflectance):
    models = {name: load_model(name, details=False) for name in ("decline", DEFAULT_CHECKPOINT)}
    config = TubeConfig()
    config = replace(config, sensor=replace(config.sensor, reflectance=reflectance, mu=(0.0, 3.5), gamma=(1.8, 2.6)))
    rows = {name: [] for name in models}
    for i, seed in enumerate(SEEDS):
        camera = lens(("c3vd", "fisheye", "pinhole")[i % 3], 320, 256)
        for frame in tube_frames(seed, 3, camera, config=config):
            for name, model in models.items():
                errors = evaluate_depth(model(frame), frame)
                rows[name].append([errors[key] for key in KEYS])
    means = {name: np.mean(values, axis=0) for name, values in rows.items()}
    print(
        f"\nreflectance {reflectance}, {len(SEEDS)} colons, {len(rows['decline'])} frames: AbsRel / RMSE mm / MedAE mm"
    )
    for name, mean in means.items():
        print(f"  {name:<16} " + " / ".join(f"{value:.3f}" for value in mean))
    ratio = means[DEFAULT_CHECKPOINT] / means["decline"]
    print("  ratio            " + " / ".join(f"{value:.2f}" for value in ratio))
    assert (ratio < 1).all()
