"""The bundled checkpoints beside the closed form, on colons that they were not trained and not tuned on.

Median-aligned errors of depth [mm] over the frame mask with 0 < depth < 100 mm, ray z above .15, mean over frames, and
their ratios to the closed form's; with weak and with strong interreflection apart. Colons of the plain family
(seeds 5000-5017), realistic ones (7500-7517, 7520-7537) and those of another renderer (8100-8117), which no network was
trained on; none of these seeds was looked at while anything was chosen. What a checkpoint says of its uncertainty is
judged on the same frames. LIGHTDEPTH_CHECKPOINT names one more checkpoint. Run by `make bench`.
"""

import os
from dataclasses import replace

import numpy as np
import pytest
import torch

from lightdepth.checkpoint import DEFAULT_CHECKPOINT, bundled, load_model
from lightdepth.frame import Frame
from lightdepth.geometry import depth_from_distance
from lightdepth.metrics import depth_errors
from lightdepth.prediction import DepthPrediction
from lightdepth.tube import TubeConfig, lens, realistic, tube_frames
from lightdepth.tube.variant import variant_frames
from lightdepth.uncertainty import Doubted, coverage, doubted, sparsification

LENSES = ("c3vd", "fisheye", "pinhole")
REFLECTANCE = {"weak": (0.0, 0.2), "strong": (0.5, 0.7)}
BAR = 0.85  # of the default checkpoint's errors on another renderer, over the closed form's


def drawn(config: TubeConfig, strength: str, first: int, mu: tuple[float, float], gamma: tuple[float, float]):
    sensor = replace(config.sensor, reflectance=REFLECTANCE[strength], mu=mu, gamma=gamma)
    for i in range(18):
        yield from tube_frames(first + i, 2, lens(LENSES[i % 3], 160, 128), config=replace(config, sensor=sensor))


def frames_of(family: str, strength: str) -> list[Frame]:
    if family == "plain":
        return list(drawn(TubeConfig(), strength, 5000, (0.0, 3.5), (1.8, 2.6)))
    if family == "realistic":
        return list(drawn(realistic(), strength, 7500 if strength == "weak" else 7520, (1.3, 3.6), (1.7, 2.6)))
    return [f for i in range(18) for f in variant_frames(8100 + i, 2, lens(LENSES[i % 3], 160, 128), strength)]


def errors(distance: np.ndarray, frame: Frame) -> list[float]:
    """AbsRel, RMSE mm and MedAE mm."""
    assert frame.true_distance is not None
    ray_z = frame.camera.rays()[0][..., 2]
    found, truth, z = (torch.from_numpy(np.array(a, np.float64)) for a in (distance, frame.true_distance, ray_z))
    depth = depth_from_distance(truth, z)
    valid = torch.from_numpy(frame.valid) & (depth > 0) & (depth < 100) & (z > 0.15)
    judged = depth_errors(depth_from_distance(found, z), depth, valid)
    assert judged is not None
    return [float(judged[key]) for key in ("abs_rel", "rmse_mm", "medae_mm")]


def _uncertainty(predictions: list[DepthPrediction], frames: list[Frame]) -> str:
    def doubts(log: bool) -> list[Doubted]:
        pairs = zip(predictions, frames, strict=True)
        return [doubted(p.distance, p.uncertainty, f.true_distance, p.valid, log) for p, f in pairs]

    held = " ".join(f"{100 * share:.0f}" for share in coverage(doubts(True)))
    areas = [f"{sparsification(doubts(log), power).relative:.2f}" for log in (True, False) for power in (1, 2)]
    return (
        f"   intervals for 50 68 90 95 % hold {held} %; sparsification error over that of a random order: "
        f"log distance, mean {areas[0]}, RMS {areas[1]}; mm, mean {areas[2]}, RMS {areas[3]}"
    )


@pytest.mark.parametrize("strength", ["weak", "strong"])
@pytest.mark.parametrize("family", ["plain", "realistic", "another renderer"])
def test_the_bundled_checkpoints_beside_the_closed_form(family, strength):
    more = [os.environ["LIGHTDEPTH_CHECKPOINT"]] if "LIGHTDEPTH_CHECKPOINT" in os.environ else []
    models = {name: load_model(name, details=False) for name in ("decline", *bundled(), *more)}
    frames = frames_of(family, strength)
    found = {name: [model(frame) for frame in frames] for name, model in models.items()}
    means = {
        name: np.mean([errors(p.distance, f) for p, f in zip(predictions, frames, strict=True)], 0)
        for name, predictions in found.items()
    }
    print(
        f"\n{family}, {strength} interreflection, {len(frames)} frames: AbsRel / RMSE mm / MedAE mm, ratios to decline"
    )
    for name, mean in means.items():
        ratio = mean / means["decline"]
        numbers = [" / ".join(f"{value:.{digits}f}" for value in row) for row, digits in ((mean, 3), (ratio, 2))]
        line = f"  {name[-40:]:<24}{numbers[0]}   {numbers[1]}"
        if all(p.uncertainty is not None for p in found[name]):
            line += _uncertainty(found[name], frames)
        print(line)
    ratio = means[DEFAULT_CHECKPOINT] / means["decline"]
    assert (ratio < (BAR if family == "another renderer" else 1)).all()
