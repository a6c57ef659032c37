"""One keyframe's scale, and when it is not to be trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import refused
from scenes import ENDOMAPPER, cylinder
from test_sparse_map import pose

from densify.alignment import Alignment, AlignmentConfig, align, bent, second_mode, spread_deg
from densify.bending import Bend, BendingConfig
from lightdepth.observations import ObservedDistances, observed_distances
from lightdepth.sparse_map import Keyframe, Submap


def observed(n: int = 400, scale: float = 0.3, wrong: float = 0.0, noise: float = 0.05, seed: int = 0):
    """Pairs with relative noise, and a share of points that are 1.3 times too far, or much more; wrong ids are last."""
    rng = np.random.default_rng(seed)
    predicted = rng.uniform(10, 60, n)
    mapped = scale * predicted + noise * scale * 30 * rng.standard_normal(n)
    bad = np.arange(n) >= round(n * (1 - wrong))
    mapped[bad] = scale * predicted[bad] * (1.3 + rng.exponential(4, bad.sum()))
    pixels = np.random.default_rng([seed, 1]).uniform(0, 100, (n, 2))
    rays = np.stack([pixels[:, 0] / 50 - 1, pixels[:, 1] / 50 - 1, np.ones(n)], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return ObservedDistances(np.arange(n) + 100, np.abs(mapped), predicted, pixels, rays)


@pytest.mark.parametrize("seed", range(4))
def test_scale_survives_45_percent_wrong_points_and_says_so_at_65(seed):
    found = align("1", observed(wrong=0.45, seed=seed), AlignmentConfig())
    assert found.ok, found.reason
    assert found.scale == pytest.approx(0.3, rel=0.02)
    assert (found.outlier_ids >= 320).mean() > 0.9
    lost = align("1", observed(wrong=0.65, seed=seed), AlignmentConfig())
    assert not lost.ok and "%" in lost.reason


def test_refinement_brings_the_scale_closer_over_many_draws():
    config = AlignmentConfig()
    errors = []
    for seed in range(30):
        pairs = observed(60, wrong=0.3, seed=seed)
        errors.append([abs(align("1", pairs, replace(config, refine=r)).scale / 0.3 - 1) for r in (False, True)])
    before, after = np.mean(errors, 0)
    assert after < 0.8 * before


def test_too_few_points_are_worth_no_scale():
    config = AlignmentConfig(min_points=8)
    found = align("000007.png", observed(7, noise=0.0), config)
    assert not found.ok and found.reason == "7 observed points with a prediction; at least 8"
    assert (found.keyframe, found.points, found.scale) == ("000007.png", 7, 0.0)
    assert align("000007.png", observed(8, noise=0.0), config).ok
    assert not align("1", observed(0), config).ok


def test_a_low_share_of_inliers_is_a_reason():
    config = AlignmentConfig(min_inlier_share=0.9)
    found = align("1", observed(wrong=0.3), config)
    assert not found.ok and found.points == 400
    assert found.reason.endswith("% of 400 points are inliers; at least 90%")
    assert found.inlier_share == pytest.approx(0.7, abs=0.05)


def test_a_prediction_that_has_nothing_to_do_with_the_map_is_not_trusted():
    rng = np.random.default_rng(0)
    pairs = replace(observed(300), mapped=rng.lognormal(0, 1.5, 300), predicted=rng.lognormal(0, 1.5, 300))
    found = align("1", pairs, AlignmentConfig(min_inlier_share=0.0))
    assert not found.ok and "of the median distance; at most 35%" in found.reason


def test_inliers_are_within_t_sigma_and_outliers_beyond():
    pairs = observed(wrong=0.2)
    config = AlignmentConfig(t=2.0, refine=False)
    found = align("1", pairs, config)
    residual = np.abs(pairs.mapped - found.scale * pairs.predicted)
    inlier = np.isin(pairs.point_ids, found.inlier_ids)
    assert (residual[inlier] <= 2.0 * found.sigma * (1 + 1e-6)).all()
    assert (residual[~inlier] > 2.0 * found.sigma).all()
    assert sorted([*found.inlier_ids, *found.outlier_ids]) == pairs.point_ids.tolist()
    # A point exactly at the threshold is an inlier (the paper prints >=).
    row = int(np.argsort(residual)[250])
    t = residual[row] / found.sigma
    assert pairs.point_ids[row] in align("1", pairs, replace(config, t=t * (1 + 1e-9))).inlier_ids
    assert pairs.point_ids[row] in align("1", pairs, replace(config, t=t * (1 - 1e-6))).outlier_ids


def test_data_without_noise_are_all_inliers():
    found = align("1", observed(noise=0.0, scale=0.1), AlignmentConfig())
    assert found.ok and len(found.inlier_ids) == 400 and not len(found.outlier_ids)
    assert found.scale == pytest.approx(0.1, rel=1e-12) and found.sigma < 1e-12
    assert found.range_90 == pytest.approx(0.1 * np.quantile(observed(noise=0.0).predicted, 0.9))


def test_the_finite_sample_factor_widens_sigma():
    pairs = observed(21)
    plain, widened = (align("1", pairs, AlignmentConfig(finite_sample=f)).sigma for f in (False, True))
    assert widened == pytest.approx(1.25 * plain)


@pytest.mark.parametrize("shift", [0.0, 1000.0])
def test_where_the_camera_is_in_the_map_does_not_matter(shift):
    """Norms are taken in the camera frame. In the map's frame they would pull the scale to 1 away from the origin."""
    scene = cylinder(ENDOMAPPER.resized(144, 108))
    rng = np.random.default_rng(0)
    rows, columns = scene.valid[0, 0].numpy().nonzero()
    chosen = rng.choice(len(rows), 200, replace=False)
    rays = scene.rays[0].permute(1, 2, 0).numpy()[rows[chosen], columns[chosen]]
    distance = scene.distance[0, 0].numpy()[rows[chosen], columns[chosen]]
    cam_from_map = pose(5, shift)
    points = (0.02 * rays * distance[:, None] - cam_from_map[:3, 3]) @ cam_from_map[:3, :3]
    ids = np.arange(200)
    keyframe = Keyframe("1", scene.camera, cam_from_map, np.stack([columns, rows], -1)[chosen] + 0.5, ids)
    pairs = observed_distances(keyframe, Submap(0, (keyframe,), ids, points), scene.prediction())
    found = align("1", pairs, AlignmentConfig())
    assert found.ok and found.scale == pytest.approx(0.02, rel=1e-3)


def test_an_alignment_without_points_has_an_inlier_share_of_zero():
    assert Alignment("1", reason="no frame").inlier_share == 0


def clustered(share: float, factor: float = 2.0, seed: int = 0) -> ObservedDistances:
    """A share of the points agrees on a scale `factor` times the right one."""
    pairs = observed(seed=seed)
    wrong = np.arange(400) >= round(400 * (1 - share))
    return replace(pairs, mapped=np.where(wrong, factor * pairs.mapped, pairs.mapped))


@pytest.mark.parametrize("share", [0.45, 0.55])
@pytest.mark.parametrize("factor", [0.6, 2.0])
def test_a_second_scale_that_nearly_as_many_points_agree_on_is_said(share, factor):
    """At 55 % LMedS takes the wrong scale, and its own figures look sound."""
    found = align("1", clustered(share, factor), AlignmentConfig())
    assert found.inlier_share > 0.5 and found.scale == pytest.approx(0.3 * (factor if share > 0.5 else 1), rel=0.05)
    assert not found.ok and "two scales: " in found.reason
    other = 1 / factor if share > 0.5 else factor
    assert float(found.reason.split("agree on ")[1].split(" times")[0]) == pytest.approx(other, rel=0.1)


def test_few_points_on_another_scale_and_scattered_wrong_points_are_no_second_mode():
    assert align("1", clustered(0.25), AlignmentConfig()).ok
    assert align("1", observed(wrong=0.4), AlignmentConfig()).ok
    assert align("1", clustered(0.45), AlignmentConfig(max_second_mode=1.0)).ok


def test_points_in_one_corner_of_the_view_are_worth_no_scale():
    pairs = observed()
    together = replace(pairs, rays=np.tile([0.0, 0, 1], (400, 1)) + 0.01 * pairs.rays)
    found = align("1", together, AlignmentConfig())
    assert not found.ok and "degrees of the view; at least 3" in found.reason
    assert align("1", together, AlignmentConfig(min_spread_deg=0)).ok


def test_points_at_one_distance_say_nothing_of_others():
    pairs = observed(noise=0.0)
    flat = replace(pairs, mapped=np.full(400, 3.0), predicted=np.full(400, 10.0))
    found = align("1", flat, AlignmentConfig())
    assert not found.ok and found.reason.startswith("the inliers' distances deviate by 0.0%")
    assert align("1", flat, AlignmentConfig(min_distance_spread=0)).scale == pytest.approx(0.3)


def test_few_inliers_are_a_reason():
    found = align("1", observed(10, noise=0.0), AlignmentConfig(min_inliers=11))
    assert found.reason == "10 inliers of 10 points; at least 11"


@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey"])
def test_every_loss_finds_the_scale(loss):
    assert align("1", observed(wrong=0.3), AlignmentConfig(loss=loss)).scale == pytest.approx(0.3, rel=0.01)


def test_a_threshold_that_is_none_is_refused():
    with refused(where="AlignmentConfig.t", found="0", cure="above 0"):
        AlignmentConfig(t=0)


def test_a_bend_that_deserves_no_trust_is_left_out_and_the_scale_stays():
    pairs = observed(wrong=0.3, noise=0.01)
    config = BendingConfig(grids=(2,), layers=0)
    flat = Bend(config, 3.0, np.array([np.log(0.3), 0, 0, 0, 0, 0]), (100, 100))
    before = align("1", pairs, AlignmentConfig())
    same = bent(before, flat, pairs, AlignmentConfig())
    assert same.ok and same.scale == pytest.approx(0.3) and same.bend is flat
    assert np.isin(same.outlier_ids, pairs.point_ids[280:]).mean() > 0.8
    tilted = replace(flat, weights=np.array([np.log(0.3), 1.5, 0, 0, 0, 0]))
    assert bent(before, tilted, pairs, AlignmentConfig()) is before


def test_the_median_of_the_ratios_is_taken_as_it_is_and_wrong_points_pull_it():
    pairs = observed(wrong=0.45, seed=3)
    found = align("1", pairs, AlignmentConfig(estimator="median"))
    lmeds = align("1", pairs, AlignmentConfig())
    assert found.scale == np.median(pairs.mapped / pairs.predicted)
    assert found.scale > lmeds.scale * 1.005 and found.sigma > lmeds.sigma
    residual = np.abs(pairs.mapped - found.scale * pairs.predicted)
    assert found.sigma == pytest.approx(1.4826 * np.median(residual))
    with refused(where="alignment.estimator", found="'mean'"):
        AlignmentConfig(estimator="mean")


def test_the_90th_percentile_of_distance_is_the_inliers_and_wrong_points_do_not_reach_farther():
    pairs = observed(wrong=0.3)
    found = align("1", pairs, AlignmentConfig())
    inlier = np.isin(pairs.point_ids, found.inlier_ids)
    assert found.range_90 == pytest.approx(np.quantile(pairs.mapped[inlier], 0.9))
    assert found.range_90 < 0.8 * np.quantile(pairs.mapped, 0.9)


def test_a_bend_s_inliers_are_within_t_sigma_of_the_logarithm_and_its_sigma_is_a_length():
    pairs = observed(wrong=0.2, noise=0.01)
    flat = Bend(BendingConfig(grids=(2,), layers=0), 3.0, np.array([np.log(0.3), 0, 0, 0, 0, 0]), (100, 100))
    found = bent(align("1", pairs, AlignmentConfig()), flat, pairs, AlignmentConfig())
    residual = np.abs(np.log(pairs.mapped / pairs.predicted / 0.3))
    sigma = 1.4826 * np.median(residual)
    assert found.sigma == pytest.approx(sigma * np.median(pairs.mapped))
    np.testing.assert_array_equal(found.inlier_ids, pairs.point_ids[residual <= 2.5 * sigma])


def test_exactly_as_many_inliers_as_wanted_are_enough():
    assert align("1", observed(10, noise=0.0), AlignmentConfig(min_inliers=10)).ok


def test_two_bundles_of_rays_spread_by_their_angle_to_the_middle():
    angle = np.radians([0.0, 0.0, 10.0, -10.0])
    assert spread_deg(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)) == pytest.approx(np.sqrt(50))


def test_rays_that_cancel_out_spread_by_a_right_angle():
    assert spread_deg(np.array([[0, 0, 1.0], [0, 0, -1.0]])) == pytest.approx(90)


def test_a_keyframe_exactly_at_a_limit_is_trusted_and_beyond_it_is_not():
    pairs = observed(100, wrong=0.2, noise=0.02)
    found = align("1", pairs, AlignmentConfig())
    inlier = np.isin(pairs.point_ids, found.inlier_ids)
    factor, share, own = second_mode(pairs, found.scale, 2.5 * found.sigma)
    assert found.ok and 0 < share < own and factor != 1
    for name, value, beyond in (
        ("min_points", 100, 101),
        ("min_inliers", int(inlier.sum()), int(inlier.sum()) + 1),
        ("min_inlier_share", float(inlier.mean()), float(inlier.mean()) + 1e-6),
        ("max_relative_sigma", found.sigma / float(np.median(pairs.mapped)), found.sigma / 60),
        ("min_spread_deg", spread_deg(pairs.rays[inlier]), spread_deg(pairs.rays[inlier]) + 1e-6),
        ("min_distance_spread", float(np.log(pairs.mapped[inlier]).std()), 2.0),
        ("max_second_mode", share / own * (1 + 1e-12), share / own * (1 - 1e-9)),
    ):
        assert align("1", pairs, AlignmentConfig(**{name: value})).ok, name
        assert not align("1", pairs, AlignmentConfig(**{name: beyond})).ok, name


def test_where_all_points_agree_there_is_no_rival_scale():
    assert second_mode(observed(noise=0.0), 0.3, 0.1) == (1.0, 0.0, 1.0)
