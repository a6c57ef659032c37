"""What holds for any camera, any distances and any poses that are drawn: round trips, equivariance, known answers."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from densify.similarity import Similarity, fit_similarity
from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole
from lightdepth.files.rotations import pose_from_quaternion, quaternion_from_pose
from lightdepth.geometry import depth_from_distance, distance_from_depth
from lightdepth.metrics import NAMES, depth_errors
from lightdepth.robust import lmeds_scale, refine_scale

settings.register_profile("suite", derandomize=True, deadline=None, max_examples=25, database=None)
settings.load_profile("suite")


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, width=64)


SEEDS = st.integers(0, 2**32 - 1)
SCALES = between(-9, 9).map(lambda e: 10.0**e)


@st.composite
def cameras(draw: st.DrawFn) -> CameraModel:
    width, height = draw(st.integers(16, 2000)), draw(st.integers(16, 2000))
    focal = max(width, height) * draw(between(0.4, 3.0))
    numbers = focal, focal * draw(between(0.9, 1.1)), width * draw(between(0.3, 0.7)), height * draw(between(0.3, 0.7))
    kind = draw(st.sampled_from((Pinhole, Brown, KannalaBrandt)))
    if kind is Pinhole:
        return Pinhole(width, height, *numbers)
    k1, k2 = draw(between(-0.3, 0.3)), draw(between(-0.05, 0.05))
    if kind is Brown:
        return Brown(width, height, *numbers, k1, k2, draw(between(-2e-3, 2e-3)), draw(between(-2e-3, 2e-3)))
    return KannalaBrandt(width, height, *numbers, 0.3 * k1, 0.3 * k2, 0.0, 0.0)


@given(cameras(), SEEDS)
def test_what_is_seen_in_a_pixel_lies_on_that_pixel_s_ray(camera, seed):
    pixels = np.random.default_rng(seed).uniform(0, 1, (40, 2)) * (camera.width, camera.height)
    rays, invertible = camera.unproject(pixels)
    back, seen = camera.project(rays[invertible])
    np.testing.assert_allclose(np.linalg.norm(rays[invertible], axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(back[seen], pixels[invertible][seen], atol=1e-4)


@given(cameras(), SEEDS, SCALES)
def test_how_far_away_a_point_is_changes_nothing_about_its_pixel(camera, seed, far):
    points = np.random.default_rng(seed).normal(size=(30, 3)) + (0, 0, 2)
    near, seen = camera.project(points)
    there, seen_there = camera.project(points * far)
    np.testing.assert_array_equal(seen, seen_there)
    np.testing.assert_allclose(near[seen], there[seen], rtol=1e-9, atol=1e-6)


@given(cameras(), st.integers(2, 8))
def test_a_camera_at_several_times_the_size_sees_the_same_at_as_many_times_the_pixel(camera, times):
    points = np.array([[0.1, -0.05, 1.0], [0, 0, 2.0], [-0.2, 0.1, 3.0]])
    small, seen = camera.project(points)
    large, _ = camera.resized(camera.width * times, camera.height * times).project(points)
    np.testing.assert_allclose(times * small[seen], large[seen], rtol=1e-9, atol=1e-6)


@given(SEEDS, st.integers(2, 60), SCALES, SCALES)
def test_the_scale_with_the_least_median_follows_any_change_of_units(seed, count, of_map, of_model):
    rng = np.random.default_rng(seed)
    mapped, predicted = rng.uniform(1, 50, count), rng.uniform(1, 50, count)
    found = lmeds_scale(mapped, predicted)
    changed = lmeds_scale(mapped * of_map, predicted * of_model)
    ratio = of_map / of_model
    residuals = np.sort(np.abs(mapped - changed.scale / ratio * predicted))
    assert np.isclose(changed.median / of_map, found.median, rtol=1e-6, atol=1e-9), (residuals[:5], found)


@given(SEEDS, st.integers(2, 60))
def test_the_order_of_points_changes_nothing_about_the_least_median(seed, count):
    rng = np.random.default_rng(seed)
    mapped, predicted, order = rng.uniform(1, 50, count), rng.uniform(1, 50, count), rng.permutation(count)
    found, again = lmeds_scale(mapped, predicted), lmeds_scale(mapped[order], predicted[order])
    assert np.isclose(found.median, again.median, rtol=1e-12)


@given(SEEDS, st.integers(21, 200), between(0, 0.48), between(0.01, 100))
def test_less_than_half_of_wrong_points_leave_the_scale_where_it_is(seed, count, wrong, scale):
    rng = np.random.default_rng(seed)
    predicted = rng.uniform(5, 50, count)
    mapped = scale * predicted
    bad = rng.permutation(count)[: int(wrong * count)]
    mapped[bad] *= rng.uniform(1.5, 40, len(bad))
    found = lmeds_scale(mapped, predicted)
    assert np.isclose(found.scale, scale, rtol=1e-9)
    assert np.isclose(refine_scale(mapped, predicted, found.scale, 1e-3 * scale), scale, rtol=1e-6)


@st.composite
def similarities(draw: st.DrawFn) -> Similarity:
    rng = np.random.default_rng(draw(SEEDS))
    return Similarity(
        10.0 ** draw(between(-4, 4)), Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.normal(size=3)
    )


@given(similarities(), similarities(), SEEDS)
def test_similarities_compose_invert_and_are_found_again_from_points(first, second, seed):
    points = np.random.default_rng(seed).normal(size=(12, 3))
    there = (second @ first).apply(points)
    size = np.abs(there).max()
    np.testing.assert_allclose(there, second.apply(first.apply(points)), atol=1e-9 * size)
    back = (second @ first).inverse().apply(there)
    np.testing.assert_allclose(back, points, atol=1e-5)
    found = fit_similarity(points, first.apply(points))
    assert np.isclose(found.scale, first.scale, rtol=1e-9)
    np.testing.assert_allclose(found.rotation, first.rotation, atol=1e-8)


@given(SEEDS)
def test_poses_survive_their_quaternions_and_their_inverses(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    pose[:3, 3] = 100 * rng.normal(size=3)
    again = pose_from_quaternion(quaternion_from_pose(pose), pose[:3, 3], "drawn")
    np.testing.assert_allclose(again, pose, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(pose) @ pose, np.eye(4), atol=1e-11)


@given(SEEDS, SCALES)
def test_distance_and_depth_are_each_other_s_inverse_at_any_scale(seed, far):
    rng = np.random.default_rng(seed)
    distance, ray_z = far * rng.uniform(0.1, 10, (5, 6)), rng.uniform(0.05, 1, (5, 6))
    depth = depth_from_distance(distance, ray_z)
    assert (depth <= distance).all()
    np.testing.assert_allclose(distance_from_depth(depth, ray_z), distance, rtol=1e-12)


def _pair(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    truth = torch.from_numpy(rng.uniform(5, 80, (6, 7)))
    predicted = truth * torch.from_numpy(rng.uniform(0.7, 1.4, (6, 7)))
    return predicted, truth, torch.from_numpy(rng.random((6, 7)) < 0.8)


@given(SEEDS, SCALES, st.sampled_from(("median", "lmeds", "scale_shift")))
def test_aligned_errors_do_not_depend_on_the_scale_of_the_prediction(seed, scale, alignment):
    predicted, truth, valid = _pair(seed)
    one, other = (depth_errors(factor * predicted, truth, valid, alignment) for factor in (1.0, scale))
    assert one is not None and other is not None
    for name in NAMES:
        assert np.isclose(float(one[name]), float(other[name]), rtol=1e-5, atol=1e-9), name


@given(SEEDS, between(0.3, 3.0))
def test_a_prediction_that_is_a_factor_off_has_the_errors_that_follow_from_it(seed, factor):
    _, truth, valid = _pair(seed)
    errors = depth_errors(factor * truth, truth, valid, "none")
    assert errors is not None
    off = max(factor, 1 / factor)
    assert np.isclose(float(errors["abs_rel"]), abs(factor - 1), rtol=1e-9, atol=1e-12)
    assert np.isclose(float(errors["rmse_log"]), abs(np.log(factor)), rtol=1e-9, atol=1e-12)
    assert [float(errors[f"delta{k}"]) for k in (1, 2, 3)] == [float(off < 1.25**k) for k in (1, 2, 3)]
