"""A smooth field over a depth map: what it is made of, and that an image and single pixels are bent alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from colons import CAMERA
from raising import refused

from densify.bending import Bend, BendingConfig
from lightdepth.prediction import DepthPrediction

SIZE = (CAMERA.width, CAMERA.height)


def some_bend(config: BendingConfig, seed: int = 0) -> Bend:
    weights = np.random.default_rng(seed).normal(0, 0.2, len(config.precision))
    return Bend(config, np.log(30.0), weights, SIZE)


def prediction(seed: int = 0) -> DepthPrediction:
    distance = np.random.default_rng(seed).uniform(10, 60, SIZE[::-1]).astype(np.float32)
    return DepthPrediction("1", distance, np.ones(SIZE[::-1], bool), CAMERA, "test")


@pytest.mark.parametrize("grids", [(), (5,), (2, 4)])
@pytest.mark.parametrize("slope", [0.0, 0.3])
@pytest.mark.parametrize(("layers", "columns"), [(0, 0), (3, 0), (4, 2)])
def test_an_image_is_bent_as_its_pixels_are(grids, slope, layers, columns):
    config = BendingConfig(grids=grids, slope_deviation=slope, layers=layers, columns=columns)
    bend, flat = some_bend(config), prediction()
    columns, rows = np.array([0, 3, 95]), np.array([0, 41, 79])
    predicted = flat.distance[rows, columns].astype(float)
    factor = np.exp(bend.at(np.stack([columns, rows], -1) + 0.5, predicted))
    assert bend.applied(flat).distance[rows, columns] == pytest.approx(predicted * factor, rel=1e-5)
    assert bend.applied(flat).unit == "map units"
    x, log = np.random.default_rng(1).uniform(0, 1, (40, 2)), np.random.default_rng(2).uniform(2, 5, 40)
    assert bend.along(x, log) == pytest.approx(bend.basis(x, log) @ bend.weights, rel=1e-12)


def test_without_slope_the_first_weight_is_the_mean_of_the_field():
    bend = some_bend(BendingConfig(slope_deviation=0.0, layers=0))
    log = np.log(prediction().distance)
    assert bend.field(log).mean() == pytest.approx(bend.weights[0], abs=1e-3)
    assert np.ptp(bend.field(log)) > 0.1 and bend.scale == np.exp(bend.weights[0])


def test_a_slope_stretches_distances_about_the_middle():
    bend = Bend(BendingConfig(grids=(), layers=0), np.log(30.0), np.array([0.0, 0.1]), SIZE)
    assert np.exp(bend.at(np.zeros((2, 2)), np.array([30.0, 60.0]))) == pytest.approx([1, 2**0.1])


def test_off_it_is_one_scale():
    config = BendingConfig(on=False)
    bend = Bend(config, 0.0, np.array([np.log(0.5)]), SIZE)
    assert config.precision.tolist() == [0]
    np.testing.assert_allclose(bend.applied(prediction()).distance, 0.5 * prediction().distance, rtol=1e-6)
    assert bend.at(np.zeros((3, 2)), np.ones(3)) == pytest.approx(np.log([0.5] * 3))
    assert bend.scale == pytest.approx(0.5)
    finer = bend.with_finer()
    assert finer.scale == pytest.approx(0.5) and finer.weights.tolist() == bend.weights.tolist()


def test_invalid_pixels_do_not_matter():
    flat = prediction()
    broken = replace(flat, distance=flat.distance.copy(), valid=flat.valid.copy())
    broken.distance[:10], broken.valid[:10] = np.nan, False
    one, other = (some_bend(BendingConfig()).applied(p).distance for p in (flat, broken))
    np.testing.assert_array_equal(one[10:], other[10:])
    assert np.isfinite(other).all()


@pytest.mark.parametrize(
    ("changes", "what"), [({"grids": (1,)}, "from 2 to 64"), ({"bump_deviation": 0.0}, "at least 1e-06")]
)
def test_bendings_that_are_none_are_refused(changes, what):
    with refused(what):
        BendingConfig(**changes)


@pytest.mark.parametrize("n", [2, 5])
def test_no_bump_moves_the_mean_of_the_field(n):
    config = BendingConfig(grids=(n,), slope_deviation=0.0, layers=0)
    flat = np.zeros((320, 400))
    for weights in np.eye(1 + n * n)[1:]:
        field = Bend(config, 0.0, weights, (400, 320)).field(flat)
        assert abs(field.mean()) < 1e-4 and 0.4 < np.ptp(field) < 1.1


def test_the_prior_holds_bumps_and_slope_by_their_deviations_and_the_scale_not_at_all():
    found = BendingConfig(grids=(2, 3), slope_deviation=0.5, layers=2, columns=2, layer_deviation=0.2).precision
    np.testing.assert_allclose(found, [0, 4, *[100] * 13, *[25] * (2 + 2 * 4)])
    assert BendingConfig(grids=(2,), slope_deviation=0.0, layers=0).precision.tolist() == pytest.approx([0, *[100] * 4])
    with refused(where="BendingConfig.slope_deviation"):
        BendingConfig(slope_deviation=-0.1)


def test_a_slope_goes_no_farther_than_points_speak():
    bend = replace(
        Bend(BendingConfig(grids=(), layers=0), np.log(30.0), np.array([0.1, 0.5]), SIZE), log_range=(3.0, 3.5)
    )
    log = np.array([[2.0, 3.0, 3.2, 3.5, 4.0]])
    expected = 0.1 + 0.5 * (np.array([3.0, 3.0, 3.2, 3.5, 3.5]) - np.log(30.0))
    np.testing.assert_allclose(bend.field(log.astype(np.float32))[0], expected, atol=1e-6)
    np.testing.assert_allclose(bend.at(np.zeros((5, 2)), np.exp(log[0])), expected)


def test_a_layer_bends_what_lies_at_its_distance_and_far_from_all_layers_the_scale_is_the_keyframe_s():
    config = BendingConfig(grids=(), slope_deviation=0.0, layers=3, columns=0, reach=0.5)
    bend = Bend(config, np.log(30.0), np.array([0.7, 0.0, 0.0, 0.2]), SIZE)  # the farthest layer, at 30 e^.5
    predicted = 30 * np.exp([0.5, 1.0, -1.5, 4.0])
    expected = 0.7 + 0.2 * np.exp([0.0, -0.5, -8.0, -24.5])
    np.testing.assert_allclose(bend.at(np.zeros((4, 2)), predicted), expected)


def test_near_and_far_wall_in_one_part_of_the_image_bend_apart():
    config = BendingConfig(grids=(), slope_deviation=0.0, layers=2, columns=2, reach=1.0)
    weights = np.zeros(len(config.precision))
    weights[3:7] = [0.3, 0, 0, 0]  # of the near layer, at the upper left
    near, far = 30 * np.exp([-0.5, 3.5])
    corner, other = np.zeros((1, 2)), np.array([SIZE], float)
    bend = Bend(config, np.log(30.0), weights, SIZE)
    assert bend.at(corner, np.array([near]))[0] > 0.05 > 0.0 > bend.at(other, np.array([near]))[0]
    assert abs(bend.at(corner, np.array([far]))[0]) < 1e-3


@pytest.mark.parametrize("layers", [0, 3])
def test_a_finer_grid_adds_nothing_before_it_is_fitted(layers):
    bend = some_bend(BendingConfig(layers=layers, finer=7))
    finer, log = bend.with_finer(), np.log(prediction().distance)
    assert finer.config.grids == (5, 7) and len(finer.weights) == len(finer.config.precision)
    np.testing.assert_allclose(finer.field(log), bend.field(log), rtol=1e-12)
    assert finer.scale == bend.scale


def test_one_bump_is_no_finer_grid_and_the_smallest_deviations_are_numbers():
    with refused(found="1 bump", cure="0, for none, or 2 and more"):
        BendingConfig(finer=1)
    with refused(found="1e-200"):
        BendingConfig(bump_deviation=1e-200)
    assert np.isfinite(BendingConfig(slope_deviation=1e-200, bump_deviation=1e-6, layer_deviation=1e-6).precision).all()
