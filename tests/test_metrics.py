"""Depth errors against a slow reference, and their mean over frames."""

from __future__ import annotations

import math
import socket

import numpy as np
import pytest
import torch

from lightdepth.metrics import ALIGNMENTS, NAMES, DepthErrors, aligned, depth_errors
from lightdepth.robust import lmeds_scale


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


def slow_lmeds(pairs: list[tuple[float, float]]) -> float:
    """Of all proposals, the one with the least lower median over the others."""
    best = None
    for j, (pj, qj) in enumerate(pairs):
        others = [abs(q - qj / pj * p) for k, (p, q) in enumerate(pairs) if k != j]
        if best is None or lower_median(others) < best[0]:
            best = (lower_median(others), qj / pj)
    return best[1]


def slow_aligned(pairs: list[tuple[float, float]], alignment: str) -> list[tuple[float, float]]:
    if alignment == "none":
        return pairs
    if alignment == "scale_shift":
        n = len(pairs)
        p_mean, q_mean = sum(p for p, _ in pairs) / n, sum(q for _, q in pairs) / n
        scale = sum((p - p_mean) * (q - q_mean) for p, q in pairs) / sum((p - p_mean) ** 2 for p, _ in pairs)
        scale = max(scale, 0)
        return [(max(scale * (p - p_mean) + q_mean, 1e-3), q) for p, q in pairs]
    scale = lower_median([q / p for p, q in pairs]) if alignment == "median" else slow_lmeds(pairs)
    return [(scale * p, q) for p, q in pairs]


def slow_errors(predicted, truth, valid, alignment: str) -> dict[str, float]:
    """Pixel by pixel, as the module's docstring writes it."""
    pairs = [
        (p, q)
        for p, q, v in zip(
            predicted.flatten().tolist(), truth.flatten().tolist(), valid.flatten().tolist(), strict=True
        )
        if v and math.isfinite(p) and math.isfinite(q) and p > 0 and q > 0
    ]
    pairs = slow_aligned(pairs, alignment)
    n = len(pairs)
    return {
        "abs_rel": sum(abs(p - q) / q for p, q in pairs) / n,
        "sq_rel_mm": sum((p - q) ** 2 / q for p, q in pairs) / n,
        "rmse_mm": math.sqrt(sum((p - q) ** 2 for p, q in pairs) / n),
        "mae_mm": sum(abs(p - q) for p, q in pairs) / n,
        "medae_mm": lower_median([abs(p - q) for p, q in pairs]),
        "rmse_log": math.sqrt(sum((math.log(p) - math.log(q)) ** 2 for p, q in pairs) / n),
        **{f"delta{k}": sum(max(p / q, q / p) < 1.25**k for p, q in pairs) / n for k in (1, 2, 3)},
    }


@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("seed", range(5))
def test_errors_of_a_frame_agree_with_a_slow_reference(alignment, seed):
    found = depth_errors(*case(seed), alignment)
    assert {k: float(v) for k, v in found.items()} == pytest.approx(slow_errors(*case(seed), alignment), rel=1e-9)


def test_by_hand():
    truth, predicted = torch.tensor([[10.0, 20, 40]]), torch.tensor([[11.0, 18, 60]])
    found = depth_errors(predicted, truth, torch.ones(1, 3, dtype=torch.bool), "none")
    expected = {"abs_rel": 0.7 / 3, "rmse_mm": math.sqrt(405 / 3), "mae_mm": 23 / 3, "medae_mm": 2.0}
    expected |= {"sq_rel_mm": (0.1 + 0.2 + 10) / 3, "delta1": 2 / 3, "delta2": 1.0, "delta3": 1.0}
    expected["rmse_log"] = math.sqrt((math.log(1.1) ** 2 + math.log(0.9) ** 2 + math.log(1.5) ** 2) / 3)
    assert {k: float(v) for k, v in found.items()} == pytest.approx(expected)


def test_a_perfect_prediction_has_no_error():
    truth = case(0)[1]
    found = depth_errors(truth, truth, torch.ones_like(truth, dtype=torch.bool), "none")
    assert [float(found[name]) for name in NAMES] == [0, 0, 0, 0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 70.0])
def test_median_alignment_forgives_any_scale_and_none_forgives_nothing(scale):
    predicted, truth, valid = case(1)
    reference, scaled = depth_errors(predicted, truth, valid), depth_errors(predicted * scale, truth, valid)
    assert {k: float(v) for k, v in scaled.items()} == pytest.approx(
        {k: float(v) for k, v in reference.items()}, rel=1e-4
    )
    raw = depth_errors(truth * scale, truth, valid, "none")
    assert float(raw["abs_rel"]) == pytest.approx(abs(scale - 1), rel=1e-5)


@pytest.mark.parametrize("alignment", ["median", "lmeds", "scale_shift"])
def test_every_alignment_forgives_scale_and_only_one_forgives_shift(alignment):
    truth = case(1)[1]
    known = torch.isfinite(truth) & (truth > 0)
    scaled = depth_errors(0.02 * truth, truth, known, alignment)
    assert float(scaled["rmse_mm"]) < 1e-4 and float(scaled["delta1"]) == 1
    shifted = depth_errors(0.02 * truth + 3, truth, known, alignment)
    assert (float(shifted["rmse_mm"]) < 1e-3) == (alignment == "scale_shift")


def test_lmeds_shrugs_off_a_third_of_wrong_pixels_and_least_squares_does_not():
    truth = torch.linspace(10, 60, 90)[None]
    predicted = 0.1 * truth * (1 + 0.001 * torch.sin(torch.arange(90)))
    predicted[:, ::3] *= 4
    valid = torch.ones_like(truth, dtype=torch.bool)
    assert float(depth_errors(predicted, truth, valid, "lmeds")["medae_mm"]) < 0.1
    assert float(depth_errors(predicted, truth, valid, "scale_shift")["medae_mm"]) > 2


def test_depth_turned_inside_out_is_not_mended_by_a_negative_scale():
    truth = torch.linspace(10, 60, 50)[None]
    valid = torch.ones_like(truth, dtype=torch.bool)
    found = depth_errors(70 - truth, truth, valid, "scale_shift")
    assert float(found["rmse_mm"]) == pytest.approx(float(truth.double().std(correction=0)))
    flat = depth_errors(torch.full_like(truth, 3), truth, valid, "scale_shift")
    assert float(flat["rmse_mm"]) == pytest.approx(float(found["rmse_mm"]))


@pytest.mark.parametrize("alignment", ALIGNMENTS)
def test_one_pixel_has_errors_too(alignment):
    one = torch.tensor([[5.0]])
    found = depth_errors(one, 2 * one, torch.ones(1, 1, dtype=torch.bool), alignment)
    assert float(found["mae_mm"]) == (5 if alignment == "none" else 0)


def test_many_pixels_are_thinned_evenly_for_lmeds_alone():
    rng = np.random.default_rng(0)
    truth = torch.from_numpy(rng.uniform(5, 90, 120_000))
    predicted = truth * torch.from_numpy(rng.lognormal(0.3, 0.1, 120_000))
    scale = lmeds_scale(truth[::3].numpy(), predicted[::3].numpy()).scale
    np.testing.assert_allclose(aligned(predicted, truth, "lmeds"), scale * predicted, rtol=1e-12)


def test_units_of_the_prediction_do_not_matter_but_under_none():
    predicted, truth, valid = (t.double() if t.dtype != torch.bool else t for t in case(3))
    for alignment in ALIGNMENTS:
        mm = depth_errors(predicted, truth, valid, alignment)
        metres = depth_errors(predicted / 1000, truth, valid, alignment)
        same = all(float(mm[n]) == pytest.approx(float(metres[n]), rel=1e-9) for n in NAMES)
        assert same == (alignment != "none")


def test_an_unknown_alignment_is_refused():
    with pytest.raises(ValueError, match="expected one of none, median, lmeds, scale_shift"):
        aligned(torch.ones(2), torch.ones(2), "mean")


def batch(*seeds: int) -> list[torch.Tensor]:
    return [torch.stack(tensors)[:, None] for tensors in zip(*map(case, seeds), strict=True)]


@pytest.mark.parametrize("alignment", ALIGNMENTS)
def test_the_metric_is_the_mean_over_frames_however_they_are_batched(alignment):
    metric = DepthErrors(alignment)
    metric.update(*batch(0, 1, 2))
    metric.update(*batch(3))
    frames = [slow_errors(*case(seed), alignment) for seed in range(4)]
    expected = {f"{name}_{alignment}": np.mean([f[name] for f in frames]) for name in NAMES}
    assert {k: float(v) for k, v in metric.compute().items()} == pytest.approx(expected, rel=1e-9)


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


def test_the_mean_over_sequences_gives_each_the_same_weight():
    metric = DepthErrors("median", sequences=3)
    metric.update(*batch(0, 1, 2), torch.tensor([0, 0, 2]))
    metric.update(*batch(3), torch.tensor([0]))
    frames = [slow_errors(*case(seed), "median") for seed in range(4)]
    found = metric.compute()
    for name in NAMES:
        first, last = np.mean([frames[i][name] for i in (0, 1, 3)]), frames[2][name]
        assert float(found[f"{name}_median"]) == pytest.approx(np.mean([f[name] for f in frames]), rel=1e-9)
        assert float(found[f"{name}_median_over_sequences"]) == pytest.approx((first + last) / 2, rel=1e-9)


def test_processes_that_saw_parts_agree_on_the_whole():
    """As under DDP: what torchmetrics gathers from each process is summed."""
    whole, second = DepthErrors("median", sequences=2), DepthErrors("median", sequences=2)
    others = iter([second.total, second.frames])  # states are gathered in the order of their names' declaration
    first = DepthErrors("median", sequences=2)
    first.dist_sync_fn, first.distributed_available_fn = lambda own, group=None: [own, next(others)], lambda: True
    whole.update(*batch(0, 1, 2), torch.tensor([0, 1, 1]))
    first.update(*batch(0, 1), torch.tensor([0, 1]))
    second.update(*batch(2), torch.tensor([1]))
    found, expected = first.compute(), whole.compute()
    assert {k: float(v) for k, v in found.items()} == pytest.approx({k: float(v) for k, v in expected.items()})


def in_process(rank: int, port: int, folder: str) -> None:
    torch.distributed.init_process_group("gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    metric = DepthErrors("lmeds")
    metric.update(*batch(*((0, 1), (2,))[rank]))
    torch.save(metric.compute(), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_two_real_processes_compute_the_mean_over_all_frames(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    torch.multiprocessing.spawn(in_process, (port, str(tmp_path)), nprocs=2)
    frames = [slow_errors(*case(seed), "lmeds") for seed in range(3)]
    for rank in range(2):
        found = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        expected = {f"{name}_lmeds": np.mean([f[name] for f in frames]) for name in NAMES}
        assert {k: float(v) for k, v in found.items()} == pytest.approx(expected, rel=1e-9)
