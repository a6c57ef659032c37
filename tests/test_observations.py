"""Predicted distance sampled where map points were seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import refused
from scenes import C3VD, ENDOMAPPER, LENSES, PINHOLE, cylinder, slanted_plane, sphere
from test_sparse_map import pose

from lightdepth.observations import observed_distances, sample_distance
from lightdepth.sparse_map import Keyframe, Submap


def seen_by(scene, scale: float = 1.0, n: int = 300, margin: float = 2.0, jitter: float = 0.0):
    """The keyframe that observed points on the scene's surface, their submap at `scale` units to a millimetre, and the
    prediction that is right."""
    camera, rng = scene.camera, np.random.default_rng(0)
    pixels = rng.uniform(margin, (camera.width - margin, camera.height - margin), (n, 2))
    columns, rows = pixels.astype(int).T
    pixels = pixels[scene.valid[0, 0].numpy()[rows, columns]]
    rays, valid = camera.unproject(pixels)
    rays, pixels = rays[valid], pixels[valid]
    prediction = scene.prediction()
    distance = sample_distance(prediction, pixels)[0]
    cam_from_map = pose(3, shift=50.0)
    in_camera = rays * distance[:, None] * scale
    points = (in_camera - cam_from_map[:3, 3]) @ cam_from_map[:3, :3]
    ids = np.arange(len(points)) * 3 + 5
    keyframe = Keyframe("0000_color.png", camera, cam_from_map, pixels + rng.normal(0, 1, pixels.shape) * jitter, ids)
    return keyframe, Submap(0, (keyframe,), ids, points), prediction


@pytest.mark.parametrize("name", LENSES)
def test_mapped_is_scale_times_predicted_on_every_lens(name):
    keyframe, submap, prediction = seen_by(slanted_plane(LENSES[name].resized(135, 108)), scale=0.37)
    observed = observed_distances(keyframe, submap, prediction)
    assert len(observed) > 100
    np.testing.assert_allclose(observed.mapped, 0.37 * observed.predicted, rtol=1e-5)


@pytest.mark.parametrize("camera", [ENDOMAPPER, C3VD], ids=["endomapper", "c3vd"])
@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_the_3d_residual_is_exactly_the_difference_of_distances(camera, scale):
    """|X - s X_d| = |a - s b| for any s, for both points lie on one ray (MEASURED, 5.1)."""
    keyframe, submap, prediction = seen_by(cylinder(camera.resized(144, 108), farthest=40), scale=1.3, jitter=2.0)
    observed = observed_distances(keyframe, submap, prediction)
    rows = np.searchsorted(submap.point_ids, observed.point_ids)
    mapped_points = keyframe.in_camera(submap.points[rows])
    predicted_points = camera.resized(144, 108).unproject(observed.pixels)[0] * observed.predicted[:, None]
    residual = np.linalg.norm(mapped_points - scale * predicted_points, axis=1)
    np.testing.assert_allclose(residual, np.abs(observed.mapped - scale * observed.predicted), atol=1e-7)
    np.testing.assert_allclose(mapped_points, observed.rays * observed.mapped[:, None])


def test_distances_are_from_the_camera_not_from_the_origin_of_the_map():
    keyframe, submap, prediction = seen_by(sphere(ENDOMAPPER.resized(144, 108), radius=10), scale=2.0)
    observed = observed_distances(keyframe, submap, prediction)
    np.testing.assert_allclose(observed.mapped, 20, rtol=1e-6)
    assert np.linalg.norm(submap.points, axis=1).min() > 22  # the map's origin is far from the camera


def test_sampling_is_at_the_projection_not_at_the_keypoint():
    scene = slanted_plane(ENDOMAPPER.resized(144, 108))
    exact, noisy = (observed_distances(*seen_by(scene, jitter=j)) for j in (0.0, 5.0))
    np.testing.assert_allclose(noisy.predicted, exact.predicted)
    np.testing.assert_allclose(noisy.pixels, exact.pixels)


def test_only_points_that_the_keyframe_observed_take_part():
    keyframe, submap, prediction = seen_by(sphere(PINHOLE.resized(64, 48)))
    few = replace(keyframe, point_ids=keyframe.point_ids[10:20], pixels=keyframe.pixels[10:20])
    np.testing.assert_array_equal(observed_distances(few, submap, prediction).point_ids, keyframe.point_ids[10:20])


def test_points_behind_outside_or_without_prediction_take_no_part():
    camera = PINHOLE.resized(64, 48)
    scene = sphere(camera)
    in_camera = np.array([[0, 0, 5.0], [0, 0, -5], [50, 0, 5], [0, 0, 0], [-2, 0, 5]])
    keyframe = Keyframe("0000.png", camera, np.eye(4), np.zeros((5, 2)), np.arange(5))
    prediction = scene.prediction()
    valid = prediction.valid.copy()
    valid[:, :16] = False
    submap = Submap(0, (keyframe,), np.arange(5), in_camera)
    assert camera.project(in_camera[4])[0][0] < 15.5
    observed = observed_distances(keyframe, submap, replace(prediction, valid=valid))
    np.testing.assert_array_equal(observed.point_ids, [0])
    nothing = observed_distances(keyframe, submap, replace(prediction, valid=np.zeros_like(valid)))
    assert len(nothing) == 0 and nothing.rays.shape == (0, 3) and nothing.pixels.shape == (0, 2)


def test_a_subset_keeps_all_fields_together():
    observed = observed_distances(*seen_by(slanted_plane(PINHOLE.resized(64, 48))))
    chosen = observed.mapped > np.median(observed.mapped)
    part = observed.subset(chosen)
    assert len(part) == chosen.sum()
    for name in ("point_ids", "mapped", "predicted", "pixels", "rays"):
        np.testing.assert_array_equal(getattr(part, name), getattr(observed, name)[chosen])


def test_a_prediction_of_another_size_is_refused_with_the_ratio():
    keyframe, submap, _ = seen_by(sphere(PINHOLE.resized(64, 48)))
    with refused(found="ratio 0.5"):
        observed_distances(keyframe, submap, sphere(PINHOLE.resized(32, 24)).prediction())


def ramp():
    """Distance exp(a + b column + c row): what a bilinear sample of its logarithm finds exactly. (12, 16)"""
    prediction = sphere(PINHOLE.resized(16, 12)).prediction()
    rows, columns = np.mgrid[:12, :16]
    return replace(prediction, distance=np.exp(1 + 0.1 * columns - 0.05 * rows).astype(np.float32))


def test_samples_at_pixel_centres_are_the_pixels():
    prediction = ramp()
    rows, columns = np.mgrid[:12, :16]
    found, valid = sample_distance(prediction, np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], 1))
    assert valid.all()
    np.testing.assert_allclose(found, prediction.distance.ravel(), rtol=1e-6)


def test_samples_between_pixels_are_bilinear_in_log_distance():
    pixels = np.random.default_rng(0).uniform((0.5, 0.5), (15.5, 11.5), (500, 2))
    found, valid = sample_distance(ramp(), pixels)
    assert valid.all()
    np.testing.assert_allclose(np.log(found), 1 + 0.1 * (pixels[:, 0] - 0.5) - 0.05 * (pixels[:, 1] - 0.5), atol=1e-6)


def test_samples_in_the_outer_half_pixel_repeat_the_border():
    prediction = ramp()
    found, valid = sample_distance(prediction, np.array([[0.0, 0.0], [0.2, 0.5], [16.0, 12.0], [15.9, 11.5]]))
    assert valid.all()
    expected = prediction.distance[[0, 0, -1, -1], [0, 0, -1, -1]]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_near_invalid_pixels_only_the_valid_ones_count_and_need_half_of_the_weight():
    prediction = ramp()
    valid = prediction.valid.copy()
    valid[:, 8:] = False
    distance = np.where(valid, prediction.distance, np.nan)
    masked = replace(prediction, valid=valid, distance=distance)
    pixels = np.array([[7.5, 5.5], [7.9, 5.5], [8.1, 5.5], [12.0, 5.0]])
    found, ok = sample_distance(masked, pixels)
    np.testing.assert_array_equal(ok, [True, True, False, False])
    np.testing.assert_allclose(found[:2], prediction.distance[5, 7], rtol=1e-6)
    assert np.isfinite(found).all()
