"""One keyframe's scale, and when it is not to be trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import ENDOMAPPER, cylinder
from test_sparse_map import pose

from densify.alignment import Alignment, AlignmentConfig, align
from lightdepth.observations import ObservedDistances, observed_distances
from lightdepth.sparse_map import Keyframe, Submap


def observed(n: int = 400, scale: float = 0.3, wrong: float = 0.0, noise: float = 0.05, seed: int = 0):
    """Pairs with relative noise, and a share of points that are 1.3 times too far, or much more; wrong ids are last."""
    rng = np.random.default_rng(seed)
    predicted = rng.uniform(10, 60, n)
    mapped = scale * predicted + noise * scale * 30 * rng.standard_normal(n)
    bad = np.arange(n) >= round(n * (1 - wrong))
    mapped[bad] = scale * predicted[bad] * (1.3 + rng.exponential(4, bad.sum()))
    rays = np.tile([0.0, 0, 1], (n, 1))
    return ObservedDistances(np.arange(n) + 100, np.abs(mapped), predicted, np.zeros((n, 2)), rays)


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
