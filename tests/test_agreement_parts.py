"""The parts of the agreement by hand: who is compared with whom, what points weigh, and the step that is solved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_agreement_mutants import CAMERA, RIGID, SIZE, distances_to_plane, facing, keyframe_at, unbent, view_of

from densify.agreement import (
    AgreementConfig,
    View,
    _deviation,
    _overlap_rows,
    _Places,
    _point_rows,
    _Rows,
    _step,
    agree,
    compared_pairs,
    gap_between,
    inlier_deviation,
)
from densify.agreement import unbent as start
from densify.bending import Bend, BendingConfig
from densify.judging.doubts import sigma_at
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction


def test_each_view_is_compared_with_those_that_share_most_points_in_both_directions():
    shared = np.array([[9, 5, 3, 0], [5, 9, 1, 2], [3, 1, 9, 0], [0, 2, 0, 9]])
    assert compared_pairs(shared, 1) == [(0, 1), (0, 2), (1, 0), (1, 3), (2, 0), (3, 1)]
    assert compared_pairs(shared, 0) == [] and compared_pairs(np.diag([9, 9]), 4) == []
    every = compared_pairs(shared, 4)
    assert set(every) == {(i, j) for i in range(4) for j in range(4) if i != j and shared[i, j]}


def rows_of(rng: np.random.Generator, views: tuple[int, ...], m: int, n: int = 7) -> _Rows:
    return _Rows(rng.normal(size=n), rng.uniform(0.5, 2, n), {i: rng.normal(size=(n, m)) for i in views})


@pytest.mark.parametrize("dense", [0, 1000])
@pytest.mark.parametrize("views", [1, 3])
def test_the_step_is_that_of_the_dense_normal_equations(views, dense, monkeypatch):
    monkeypatch.setattr("densify.agreement._DENSE", dense)
    rng, m = np.random.default_rng(0), 3
    rows = [rows_of(rng, (i,), m) for i in range(views)]
    if views > 1:
        rows += [rows_of(rng, (0, 1), m), rows_of(rng, (2, 0), m)]
    prior, pull = rng.uniform(0, 2, views * m), rng.normal(size=views * m)
    matrix, right = np.diag(prior), -pull
    for row in rows:
        jacobian = np.zeros((len(row.residual), views * m))
        for i, block in row.blocks.items():
            jacobian[:, i * m : (i + 1) * m] = block
        matrix = matrix + jacobian.T @ (row.weight[:, None] * jacobian)
        right = right + jacobian.T @ (row.weight * row.residual)
    np.testing.assert_allclose(_step(rows, prior, pull, views), np.linalg.solve(matrix, right), rtol=1e-8)


@pytest.mark.filterwarnings("ignore::scipy.sparse.linalg.MatrixRankWarning")
@pytest.mark.parametrize("dense", [0, 1000])
@pytest.mark.parametrize("views", [1, 2])
def test_where_nothing_holds_an_unknown_there_is_no_step(views, dense, monkeypatch):
    monkeypatch.setattr("densify.agreement._DENSE", dense)
    rows = [_Rows(np.ones(2), np.ones(2), {0: np.array([[1.0, 0], [1, 0]])})]
    assert _step(rows, np.zeros(2 * views), np.zeros(2 * views), views) is None


def observed(n: int = 40) -> ObservedDistances:
    rng = np.random.default_rng(2)
    predicted = rng.uniform(10, 40, n)
    mapped = predicted * 2 * np.exp(rng.normal(0, 0.05, n))
    return ObservedDistances(np.arange(n), mapped, predicted, rng.uniform(0, 1, (n, 2)) * SIZE, np.zeros((n, 3)))


def test_points_weigh_by_their_deviation_which_grows_with_distance_and_by_the_company_they_are_in():
    o = observed()
    prediction = DepthPrediction("1", np.full(SIZE[::-1], 20.0), np.ones(SIZE[::-1], bool), CAMERA, "flat")
    view = View.of(keyframe_at(), o, prediction, 2.0)
    bend = start(view, RIGID)
    places, config = _Places(view, bend, 16), AgreementConfig(shared_error=0.2)
    ratio = o.mapped / np.median(o.mapped)
    np.testing.assert_allclose(places.growth, np.minimum(np.sqrt((1 + ratio**2) / 2), 3))
    column, row = (o.pixels / SIZE * 8).astype(int).T
    assert np.array_equal(places.cells, 8 * row + column)
    found = _point_rows(5, view, bend, places, 0.03, config)
    residual = np.log(o.mapped / o.predicted / 2)
    np.testing.assert_allclose(found.residual, residual)
    deviation = min(max(np.quantile(np.abs(residual), 0.25) / 0.3186, 0.01), 0.03)
    sigma = deviation * places.growth
    weight = 1 / (1 + (residual / sigma / 2) ** 2) ** 2 / sigma**2
    told = np.array([weight[places.cells == cell].sum() for cell in places.cells])
    np.testing.assert_allclose(found.weight, weight / (1 + told * 0.04))
    assert list(found.blocks) == [5] and np.array_equal(found.blocks[5], np.ones((40, 1)))
    wide = _point_rows(0, view, bend, places, 9.0, config).weight
    assert not np.allclose(wide, found.weight)


def test_deviations_are_those_of_a_normal_distribution_and_never_none():
    residual = np.random.default_rng(0).normal(0, 0.2, 20_000)
    assert inlier_deviation(residual) == pytest.approx(0.2, rel=0.03)
    assert _deviation(residual) == pytest.approx(0.2, rel=0.03)
    assert inlier_deviation(np.zeros(5)) == _deviation(np.zeros(5)) == 0.01


def test_the_overlap_weighs_by_its_own_deviation_but_not_less_than_the_points():
    normal = np.array([0.2, -0.1, 1.0])
    keyframes = keyframe_at(), keyframe_at(-3, 1, 2, 0.1)
    views = [view_of(k, distances_to_plane(k, normal, 20.0) * f) for k, f in zip(keyframes, (1, 1.1), strict=True)]
    bends = unbent(views)
    places = [_Places(v, b, 16) for v, b in zip(views, bends, strict=True)]
    none = np.zeros((0, 1))
    for points in (0.02, 0.3):
        rows = [_Rows(np.full(9, points), np.ones(9), {i: none}) for i in range(2)]
        config = AgreementConfig(overlap=0.5)
        found = _overlap_rows(views, bends, places, [(0, 1), (1, 0)], config, rows)
        every = np.concatenate([f.residual for f in found])
        sigma = max(1.4826 * np.median(np.abs(every)), 1.4826 * points)
        for f in found:
            np.testing.assert_allclose(f.weight, 0.5 / (1 + (f.residual / sigma / 2) ** 2) ** 2 / sigma**2)
            assert 0.05 < np.abs(f.residual).mean() < 0.15 and len(f.residual) > 30
    assert _overlap_rows(views, bends, places, [], config, rows) == []
    narrow = AgreementConfig(max_gap=0.05)
    assert _overlap_rows(views, bends, places, [(0, 1), (1, 0)], narrow, rows) == []


def test_a_view_knows_nothing_beside_its_image_and_where_a_neighbour_is_unknown():
    known = np.ones(SIZE[::-1], bool)
    known[40, 50] = False
    prediction = DepthPrediction("1", np.full(SIZE[::-1], 20.0), known, CAMERA, "flat")
    view = View.of(keyframe_at(), facing(0, 20.0).observed, prediction, 1.0)
    assert view.valid.shape == (80, 96)
    pixels = np.array([[0.5, 0.5], [95.5, 79.5], [0.4, 5], [5, 79.6], [95.6, 5], [5, 0.4], [50.5, 40.5], [51.2, 40.5]])
    log, sure = view.at(np.concatenate([pixels, [[52.0, 44.0]]]) / SIZE)
    assert sure.tolist() == [True, True, False, False, False, False, False, False, True]
    np.testing.assert_allclose(log[sure], np.log(20), rtol=1e-6)
    assert View.of(keyframe_at(), view.observed, prediction, 1.0, 40).valid.shape == (40, 48)
    assert View.of(keyframe_at(), view.observed, prediction, 1.0, 500).valid.shape == (80, 96)


def test_more_places_are_looked_at_than_opencv_takes_in_a_row():
    view, count = facing(0, 20.0), 66_000
    assert len(view.grid(300)) > 32767  # --agreement.samples 300
    x = np.random.default_rng(0).uniform(0.1, 0.9, (count, 2))
    log, sure = view.at(x)
    for few in (slice(0, 100), slice(32_000, 32_100), slice(count - 100, count)):
        np.testing.assert_array_equal(log[few], view.at(x[few])[0])
    assert log.shape == (count,) and sure.all()
    depth = DepthPrediction("1", np.full(SIZE[::-1], 20.0), np.ones(SIZE[::-1], bool), CAMERA, "flat")
    doubtful = replace(depth, uncertainty=np.tile(np.linspace(0.1, 0.2, SIZE[0]), (SIZE[1], 1)).astype(np.float32))
    sigma = sigma_at(doubtful, x * SIZE)
    assert sigma is not None and sigma.shape == (count,)
    np.testing.assert_array_equal(sigma[-100:], sigma_at(doubtful, x[-100:] * SIZE))


def test_a_gap_is_the_reach_less_the_distance_there():
    first, second = facing(0, 20.0), facing(4, 21.0)
    rays = np.array([[0, 0, 1.0], [0.1, 0.05, 1], [0, 0, -1], [5, 0, 1]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    bend = Bend(RIGID, 0.0, np.array([0.1]), SIZE)
    log_d = np.log(20.0 / np.abs(rays[:, 2]))
    found = gap_between(first, second, bend, rays, log_d)
    assert found.known.tolist() == [True, True, False, False]
    reach = np.linalg.norm(rays * np.exp(log_d)[:, None] - (0, 0, 4), axis=1)
    np.testing.assert_allclose(found.log_reach, np.log(reach))
    pixel = (60 * 2 / 16 + 47, 62 * 1 / 16 + 41)
    np.testing.assert_allclose(found.x[:2], np.array([(47, 41), pixel]) / SIZE)
    np.testing.assert_allclose(found.log_predicted[:2], np.log(17 * reach[:2] / 16), atol=1e-4)
    np.testing.assert_allclose(found.gap[:2], np.log(16 / 17) - 0.1, atol=1e-4)


def test_rounds_end_with_the_tolerance_or_their_number_and_off_does_nothing():
    prediction = DepthPrediction("1", np.full(SIZE[::-1], 20.0), np.ones(SIZE[::-1], bool), CAMERA, "flat")
    view = View.of(keyframe_at(), observed(), prediction, 1.7)
    shared, bending = np.array([[9]]), BendingConfig(grids=(2,))

    def weights(**config) -> np.ndarray:
        (found,) = agree([view], shared, AgreementConfig(**config), bending)
        return found.weights

    begun = weights(on=False)
    assert begun[0] == np.log(1.7) and not begun[1:].any() and np.array_equal(weights(rounds=0), begun)
    one, two, many = weights(rounds=1, tolerance=0), weights(rounds=2, tolerance=0), weights(rounds=150, tolerance=1e-9)
    assert np.abs(one - begun).max() > np.abs(two - one).max() > 0
    assert np.array_equal(weights(rounds=9, tolerance=9.0), one)
    np.testing.assert_allclose(weights(rounds=200, tolerance=1e-12), many, atol=1e-7)
    assert many[0] == pytest.approx(np.log(2), abs=0.03)
