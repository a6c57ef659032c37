"""Depth errors against a slow reference, and their mean over frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lightdepth.metrics import NAMES, DepthErrors, aligned, depth_errors


def case(seed: int, height: int = 9, width: int = 11) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(5, 90, (height, width))
    predicted = truth * rng.lognormal(0.3, 0.2, (height, width))
    valid = rng.random((height, width)) < 0.8
    truth[0, :3] = [0, np.nan, np.inf]
    predicted[1, :3] = [0, np.nan, -1]
    return tuple(map(torch.from_numpy, (predicted.astype(np.float32), truth.astype(np.float32), valid)))


def lower_median(values: list[float]) -> float:
    return sorted(values)[(len(values) - 1) // 2]


def slow_errors(predicted, truth, valid, alignment: str) -> dict[str, float]:
    """Pixel by pixel, as the module's docstring writes it."""
    pairs = [
        (p, q)
        for p, q, v in zip(
            predicted.flatten().tolist(), truth.flatten().tolist(), valid.flatten().tolist(), strict=True
        )
        if v and math.isfinite(p) and math.isfinite(q) and p > 0 and q > 0
    ]
    scale = lower_median([q / p for p, q in pairs]) if alignment == "median" else 1.0
    pairs = [(scale * p, q) for p, q in pairs]
    n = len(pairs)
    return {
        "abs_rel": sum(abs(p - q) / q for p, q in pairs) / n,
        "rmse_mm": math.sqrt(sum((p - q) ** 2 for p, q in pairs) / n),
        "medae_mm": lower_median([abs(p - q) for p, q in pairs]),
        "delta1": sum(max(p / q, q / p) < 1.25 for p, q in pairs) / n,
    }


@pytest.mark.parametrize("alignment", ["none", "median"])
@pytest.mark.parametrize("seed", range(5))
def test_errors_of_a_frame_agree_with_a_slow_reference(alignment, seed):
    found = depth_errors(*case(seed), alignment)
    assert {k: float(v) for k, v in found.items()} == pytest.approx(slow_errors(*case(seed), alignment), rel=1e-6)


def test_by_hand():
    truth, predicted = torch.tensor([[10.0, 20, 40]]), torch.tensor([[11.0, 18, 60]])
    found = depth_errors(predicted, truth, torch.ones(1, 3, dtype=torch.bool), "none")
    assert {k: float(v) for k, v in found.items()} == pytest.approx(
        {"abs_rel": 0.7 / 3, "rmse_mm": math.sqrt(405 / 3), "medae_mm": 2.0, "delta1": 2 / 3}
    )


def test_a_perfect_prediction_has_no_error():
    truth = case(0)[1]
    found = depth_errors(truth, truth, torch.ones_like(truth, dtype=torch.bool), "none")
    assert [float(found[name]) for name in NAMES] == [0, 0, 0, 1]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 70.0])
def test_median_alignment_forgives_any_scale_and_none_forgives_nothing(scale):
    predicted, truth, valid = case(1)
    reference, scaled = depth_errors(predicted, truth, valid), depth_errors(predicted * scale, truth, valid)
    assert {k: float(v) for k, v in scaled.items()} == pytest.approx(
        {k: float(v) for k, v in reference.items()}, rel=1e-4
    )
    raw = depth_errors(truth * scale, truth, valid, "none")
    assert float(raw["abs_rel"]) == pytest.approx(abs(scale - 1), rel=1e-5)


def test_an_unknown_alignment_is_refused():
    with pytest.raises(ValueError, match="expected 'none' or 'median'"):
        aligned(torch.ones(2), torch.ones(2), "lmeds")


def batch(*seeds: int) -> list[torch.Tensor]:
    return [torch.stack(tensors)[:, None] for tensors in zip(*map(case, seeds), strict=True)]


@pytest.mark.parametrize("alignment", ["none", "median"])
def test_the_metric_is_the_mean_over_frames_however_they_are_batched(alignment):
    metric = DepthErrors(alignment)
    metric.update(*batch(0, 1, 2))
    metric.update(*batch(3))
    frames = [slow_errors(*case(seed), alignment) for seed in range(4)]
    expected = {f"{name}_{alignment}": np.mean([f[name] for f in frames]) for name in NAMES}
    assert {k: float(v) for k, v in metric.compute().items()} == pytest.approx(expected, rel=1e-6)


def test_frames_without_truth_do_not_count():
    predicted, truth, valid = batch(0, 1)
    alone, metric = DepthErrors(), DepthErrors()
    alone.update(predicted[:1], truth[:1], valid[:1])
    metric.update(predicted, truth, valid & torch.tensor([True, False]).reshape(2, 1, 1, 1))
    assert float(metric.frames) == 1
    assert metric.compute() == alone.compute()


@pytest.mark.parametrize("nothing", ["valid", "truth", "prediction"])
def test_a_frame_with_nothing_to_compare_has_no_errors(nothing):
    predicted, truth, valid = case(0)
    if nothing == "valid":
        valid = torch.zeros_like(valid)
    elif nothing == "truth":
        truth = torch.zeros_like(truth)
    else:
        predicted = torch.full_like(predicted, torch.nan)
    assert depth_errors(predicted, truth, valid) is None


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_the_mean_over_no_frames_is_not_a_perfect_score():
    predicted, truth, valid = batch(0, 1)
    metric = DepthErrors()
    metric.update(predicted, torch.zeros_like(truth), valid)
    assert all(math.isnan(v) for v in metric.compute().values())


def test_reset_forgets():
    metric = DepthErrors("none")
    metric.update(*batch(0, 1))
    metric.reset()
    metric.update(*batch(2))
    expected = slow_errors(*case(2), "none")
    assert float(metric.compute()["abs_rel_none"]) == pytest.approx(expected["abs_rel"], rel=1e-6)
