"""bench completion: each way on points whose answer is known, other programs' files, curves by hand, and the verb."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from raising import refused

from densify.bench.completion import methods, run, scenes
from densify.bench.completion.external import external_folders, read_external
from densify.bench.completion.figures import CellFigures, KeyframeErrors, RowFigures
from densify.bench.completion.methods import LMEDS, METHODS, SHIFT, SHIFT_INVERSE, lmeds_scale, median_scale
from densify.bench.completion.methods import scale_and_shift as by_shift
from densify.bench.completion.methods import scale_and_shift_of_inverse as by_inverse
from densify.bench.completion.poisson import POISSON, _gradients, _interpolation, poisson_completion
from densify.bench.completion.tables import BEST_SHIFT, better_shift, notes, read_cell, shown_rows, tables
from densify.bench.completion.work import DELIVERED, Cell
from densify.bench.curves import bands_of, front, sorted_errors
from densify.bench.scenes import Rendered, Scene, render
from densify.bench.work import Predicted, load_models
from densify.commands.bench import bench
from densify.config import DensifyConfig
from densify.evaluation.errors import ComparedDepth, TrueSurface
from densify.similarity import Similarity
from lightdepth.camera import Pinhole
from lightdepth.observations import ObservedDistances, sample_distance
from lightdepth.prediction import DepthPrediction
from lightdepth.tube import ShapeConfig, TubeConfig

CAMERA = Pinhole(80, 64, 48.0, 48.0, 40.0, 32.0)
SCALE = 0.2


def predicted() -> DepthPrediction:
    """A tube's distance."""
    rays, _ = CAMERA.rays()
    distance = 18 / np.maximum(np.linalg.norm(rays[..., :2], axis=-1), 0.2)
    return DepthPrediction("000001", distance.astype(np.float32), np.ones((64, 80), bool), CAMERA, "a tube")


def points_of(prediction: DepthPrediction, truth: np.ndarray, wrong: float = 0.0, count: int = 600, seed: int = 0):
    """Points at random pixels of a true distance (H, W); a share of them 1.3 times too far and more."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((1, 1), (79, 63), (count, 2))
    mapped, _ = sample_distance(replace(prediction, distance=truth.astype(np.float32)), pixels)
    mapped = mapped * np.where(rng.random(count) < wrong, 1.3 + rng.exponential(4, count), 1.0)
    own, _ = sample_distance(prediction, pixels)
    return ObservedDistances(np.arange(count), mapped, own, pixels, CAMERA.unproject(pixels)[0])


def off(found: DepthPrediction, truth: np.ndarray) -> float:
    """Largest relative error of all pixels but those at the border, which lie outside the points."""
    return float(np.abs(found.distance / truth - 1)[3:-3, 3:-3].max())


# Scales and shifts


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_a_scale_and_a_shift_are_found_again_among_wrong_points(wrong):
    p = predicted()
    shifted = SCALE * p.distance + 0.6
    inverse = 1 / (1 / (SCALE * p.distance) + 0.04)
    for way, truth in ((by_shift, shifted), (by_inverse, inverse)):
        found = way(p, points_of(p, truth, wrong), SCALE)
        assert off(found, truth) < 0.01 and found.unit == "map units"
        assert off(lmeds_scale(p, points_of(p, truth, wrong), SCALE), truth) > 0.1


def test_a_shift_brings_no_pixel_behind_the_camera():
    p = predicted()
    found = by_shift(p, points_of(p, np.maximum(SCALE * p.distance - 3.4, 1e-2), count=40), SCALE)
    assert (found.distance >= 0.0999 * SCALE * p.distance).all()


def test_the_median_of_ratios_and_the_lmeds_scale_are_one_number_each():
    p = predicted()
    five = points_of(p, p.distance, count=5)
    observed = replace(five, mapped=five.predicted * (1.0, 10.0, 3.0, 2.0, 12.0))
    np.testing.assert_allclose(median_scale(p, observed, SCALE).distance, 3 * p.distance, rtol=1e-6)
    np.testing.assert_allclose(lmeds_scale(p, observed, SCALE).distance, SCALE * p.distance, rtol=1e-6)


# Poisson


def test_gradients_are_summed_as_by_hand():
    f = np.random.default_rng(0).standard_normal((4, 5))
    by_hand = sum((f[i, j] - f[i, j + 1]) ** 2 for i in range(4) for j in range(4))
    by_hand += sum((f[i, j] - f[i + 1, j]) ** 2 for i in range(3) for j in range(5))
    assert f.ravel() @ _gradients((4, 5)) @ f.ravel() == pytest.approx(by_hand)


def test_a_field_is_read_between_the_middles_of_its_cells():
    u, v = np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(4) + 0.5) / 4)
    x = np.random.default_rng(1).uniform((1 / 12, 1 / 8), (11 / 12, 7 / 8), (50, 2))
    found = _interpolation(x, (4, 6)) @ (2 * u - 3 * v + 1).ravel()
    np.testing.assert_allclose(found, 2 * x[:, 0] - 3 * x[:, 1] + 1, atol=1e-12)
    outside = _interpolation(np.array([[0.0, 0.0], [1.0, 1.0]]), (4, 6)) @ np.arange(24.0)
    np.testing.assert_allclose(outside, [0, 23])


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_poisson_follows_a_smooth_change_of_depth_among_wrong_points(wrong):
    p = predicted()
    u, v = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 64))
    truth = SCALE * p.distance * np.exp(0.15 * u * v + 0.1 * u)
    found = poisson_completion(p, points_of(p, truth, wrong), SCALE)
    assert off(found, truth) < 0.04 and found.unit == "map units"
    assert off(p.scaled(SCALE), truth) > 0.2


def test_poisson_keeps_the_prediction_s_shape_where_its_gradients_hold_and_the_scale_where_the_screen_does():
    p = predicted()
    u = np.linspace(-1, 1, 80)
    truth = SCALE * p.distance * np.exp(0.15 * u)
    observed = points_of(p, truth)
    stiff = poisson_completion(p, observed, SCALE, replace(POISSON, gradient=1e-5))
    ratio = stiff.distance / p.distance
    assert ratio.std() / ratio.mean() < 1e-3
    screened = poisson_completion(p, observed, SCALE, replace(POISSON, pull=1e-5))
    np.testing.assert_allclose(screened.distance, SCALE * p.distance, rtol=1e-3)


# Scenes


def test_six_colons_under_four_lenses_have_seeds_of_their_own_that_nothing_was_tuned_on():
    made = scenes.completion_scenes()
    assert [s.seed for s in made] == list(scenes.SEEDS) and len({s.name for s in made}) == 6
    assert {s.lens for s in made} == {"c3vd", "pinhole", "fisheye", "telescope"}
    assert not set(scenes.SEEDS) & set(scenes.TUNING_SEEDS)


@pytest.fixture(scope="module")
def tiny() -> Rendered:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Scene, "colon", TubeConfig(ShapeConfig(length=90.0, step=1.2)))
        return render(Scene("tiny", 8400, 40, 5, travel_mm=8.0), (64, 52))


def test_three_in_ten_points_are_wrong_alone_or_together(tiny):
    alone = tiny.slam(scenes.WRONG_SHARE)
    (ids,) = alone.spurious_ids.values()
    assert len(ids) / len(alone.map.submaps[0].points) == pytest.approx(0.3, abs=0.04)
    (clean,) = tiny.tracked(scenes.ALONE_SHARE, scenes.MapErrors()).submaps
    (moved,) = scenes.map_with(tiny, "coherent").submaps
    share = (clean.points != moved.points).any(1).mean()
    assert share == pytest.approx(0.27, abs=0.01)


# Other programs


@pytest.fixture(scope="module")
def task(tiny) -> methods.Task:
    seen = Predicted.of(tiny, load_models(("decline",)))
    return Cell(tiny, "independent", seen.predictions["decline"], DensifyConfig()).task()


def test_distance_and_depth_of_another_program_are_read_alike_and_what_is_missing_is_counted(task, tmp_path):
    chosen = task.keyframes[:2]
    for k in chosen:
        prediction = task.seen[k.keyframe.name].prediction
        z = prediction.camera.rays()[0][..., 2]
        for kind, values in (("distance", prediction.distance), ("depth", prediction.distance * z)):
            (tmp_path / kind).mkdir(exist_ok=True)
            np.savez(tmp_path / kind / f"{k.keyframe.number:06d}.npz", **{kind: 0.3 * values})
    for kind in ("distance", "depth"):
        found, lacking = read_external(tmp_path / kind, task)
        assert list(found) == [k.keyframe.name for k in chosen] and lacking == len(task.keyframes) - 2
        for name, read in found.items():
            own = task.seen[name].prediction
            np.testing.assert_allclose(read.distance[read.valid], 0.3 * own.distance[read.valid], rtol=1e-5)
    assert read_external(tmp_path / "nowhere", task) == ({}, len(task.keyframes))


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"distance": np.ones((52, 64)), "depth": np.ones((52, 64))}, "2 of the arrays"),
        ({"depths": np.ones((52, 64))}, "0 of the arrays"),
        ({"distance": np.ones((52, 100))}, "100x52"),
        ({"distance": np.full((52, 64), np.nan)}, "no finite number"),
        ({"distance": np.array([[{}]], object)}, "Python objects"),
    ],
)
def test_an_array_that_is_no_completion_is_refused(task, tmp_path, arrays, said):
    np.savez(tmp_path / f"{task.keyframes[0].keyframe.number:06d}.npz", **arrays)
    with refused(said):
        read_external(tmp_path, task)


def test_names_of_other_programs_are_their_own(tmp_path):
    place = tmp_path / "c3vd" / "coherent"
    place.mkdir(parents=True)
    with refused(found="no completions"):
        external_folders([f"mine={tmp_path}"], run.RESERVED)
    np.savez(place / "000001.npz", distance=np.ones((2, 2)))
    assert external_folders([f"mine={tmp_path}"], run.RESERVED) == {"mine": tmp_path}
    for given in ([f"ours={tmp_path}"], [f"mine={tmp_path}"] * 2, ["mine"], [f"={tmp_path}"]):
        with refused(where="--external"):
            external_folders(given, run.RESERVED)


# Curves


def compared(ratio: np.ndarray, truth: np.ndarray) -> ComparedDepth:
    return ComparedDepth(ratio * truth, truth, np.ones(truth.shape, bool), 1.0, 1.0)


def test_bands_by_hand():
    truth = np.array([[5.0, 5.0, 25.0], [25.0, 25.0, 70.0]])
    found = bands_of([compared(np.array([[1.1, 0.9, 1.2], [1.3, 0.8, 1.0]]), truth)])
    assert [(b.from_mm, b.to_mm, b.pixels) for b in found] == [(0, 10, 2), (20, 30, 3), (60, 80, 1)]
    assert [b.abs_rel for b in found] == pytest.approx([0.1, 0.7 / 3, 0.0])
    assert [b.bias for b in found] == pytest.approx([0.0, 0.2, 0.0])


def test_a_perfect_uncertainty_drops_what_errs_most_and_a_perverse_one_what_errs_least():
    rng = np.random.default_rng(2)
    error = rng.uniform(0, 0.5, (20, 30))
    one = compared(1 + error, np.full(error.shape, 30.0))
    right, wrong = sorted_errors([one], [error]), sorted_errors([one], [-error])
    assert [p.by_uncertainty for p in right] == pytest.approx([p.by_error for p in right])
    assert all(b.by_uncertainty > 1.9 * b.by_error for b in wrong[:5])
    assert wrong[-1].by_uncertainty == pytest.approx(error.mean()) and right[0].kept_share == 0.1


def test_the_front_of_a_plane_half_of_which_is_wrong_gives_up_the_wrong_half_first():
    flat = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), -1).reshape(-1, 3)
    off = np.where(flat[:, :1] >= 20, 6.0, 0.1) * (0, 0, 1)
    dense = SimpleNamespace(vertices=(flat + off) / 2, expected_error=off[:, 2] / 2, views=None)
    found = front([(dense, Similarity(2.0, np.eye(3), np.zeros(3)))], TrueSurface(flat, "a plane"))
    whole, half = found  # two values of the expected error
    assert (whole.kept_share, whole.precision_2mm) == (1.0, 0.5) and whole.threshold == pytest.approx(6.0)
    assert (half.kept_share, half.precision_2mm) == (0.5, 1.0) and half.median_mm == pytest.approx(0.1)
    assert half.rms_mm == pytest.approx(0.1) and 0.5 < half.recall_2mm <= whole.recall_2mm < 0.6


# Tables


def cell(errors: dict[str, float]) -> CellFigures:
    rows = {name: RowFigures("", KeyframeErrors(e, 10 * e, 5 * e, 1.0), {}) for name, e in errors.items()}
    return CellFigures("c3vd", 1, "c3vd", "coherent", 9, 1, {}, rows, (), ())


def test_of_scale_and_shift_the_better_one_stands_in_the_table_and_ratios_count_what_reaches_the_bar():
    errors = dict.fromkeys([*METHODS, DELIVERED], 0.1) | {SHIFT: 0.08, SHIFT_INVERSE: 0.05, "ours": 0.04}
    found = [cell(errors), cell(errors | {SHIFT: 0.03})]
    assert [better_shift(c) for c in found] == [SHIFT_INVERSE, SHIFT]
    assert [shown_rows(c)[BEST_SHIFT].depth.abs_rel for c in found] == [0.05, 0.03]
    ratio = next(row for row in tables(found)[2].rows if row[0] == f"ours / {BEST_SHIFT}")
    assert ratio[1] == "0.80 1.33; 1 of 2"
    assert "c3vd, coherent: of 1 / distance" in "".join(notes(found))


# The verb


def test_a_run_judges_every_row_and_another_program_that_scales_as_lmeds_gets_its_figures(tmp_path, monkeypatch):
    monkeypatch.setattr(Scene, "colon", TubeConfig(ShapeConfig(length=90.0, step=1.2)))
    monkeypatch.setattr(run, "completion_scenes", lambda: [Scene("tiny", 8400, 40, 5, travel_mm=8.0)])
    common = ["--image-size", "[64, 52]", "--checkpoint", "decline"]
    assert bench(["completion", "-o", str(tmp_path / "first"), "--inputs", "true", *common]) == 0
    found = json.loads((tmp_path / "first" / "completion.json").read_text(encoding="utf-8"))
    cells = [read_cell(c) for c in found["cells"]]
    assert [(c.scene, c.errors) for c in cells] == [("tiny", "independent"), ("tiny", "coherent")]
    for c in cells:
        assert list(c.rows) == [*METHODS, DELIVERED] and not any(row.error for row in c.rows.values())
        for row in c.rows.values():
            assert 0 < row.depth.abs_rel < 0.6 and 0 < row.surface.chamfer_mm < 20 and row.bands
            assert set(row.surface.precision) >= {"1mm", "2mm"}
        assert {p.by for p in c.front} == {"expected error", "views"} and c.sorted == []  # decline states none
    text = (tmp_path / "first" / "completion.md").read_text(encoding="utf-8")
    assert "ours / Poisson" in text and "30 % wrong points, coherent" in text
    assert (tmp_path / "first" / "report.html").stat().st_size > 100_000

    lacking = _as_another_program(tmp_path / "first" / "inputs", tmp_path / "theirs")
    given = ["--errors", "[independent]", "--external", f"[theirs={tmp_path / 'theirs'}]"]
    assert bench(["completion", "-o", str(tmp_path / "second"), *given, *common]) == 0
    (again,) = json.loads((tmp_path / "second" / "completion.json").read_text(encoding="utf-8"))["cells"]
    theirs, lmeds = (again["rows"][name] for name in ("theirs", LMEDS))
    assert lmeds == found["cells"][0]["rows"][LMEDS]
    assert lacking not in theirs["keyframes"] and len(theirs["keyframes"]) == len(lmeds["keyframes"]) - 1
    for name, errors in theirs["keyframes"].items():
        assert errors == pytest.approx(lmeds["keyframes"][name], rel=1e-4)


def _as_another_program(inputs: Path, out: Path) -> str:
    """Completes all keyframes of the first cell but the last by the scale with the least median of squares. The name of
    the one that is left out."""
    from lightdepth.robust import inlier_sigma, refine_scale
    from lightdepth.robust import lmeds_scale as of_ratios

    place = out / "tiny" / "independent"
    place.mkdir(parents=True)
    files = sorted((inputs / "tiny" / "independent").glob("*.npz"))
    for file in files[:-1]:
        given = np.load(file)
        camera = json.loads((file.parent / "camera.json").read_text(encoding="utf-8"))
        prediction = DepthPrediction(
            file.stem,
            given["predicted"],
            given["valid"],
            Pinhole(camera["width"], camera["height"], 1.0, 1.0, 0.0, 0.0),
            "",
        )
        own, _ = sample_distance(prediction, given["pixels"])
        best = of_ratios(given["mapped"], own)
        sigma = inlier_sigma(best.median, len(own))
        inlier = np.abs(given["mapped"] - best.scale * own) <= 2.5 * sigma
        scale = refine_scale(given["mapped"][inlier], own[inlier], best.scale, sigma)
        np.savez(place / file.name, distance=np.where(given["valid"], scale * given["predicted"], np.nan))
    return f"{files[-1].stem}.png"
