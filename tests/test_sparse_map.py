"""What a monocular SLAM knows, and what is wrong with it when it is."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from raising import refused
from scenes import C3VD, ENDOMAPPER
from scipy.spatial.transform import Rotation

from lightdepth.datasets.counting import BY_NUMBER, Counting
from lightdepth.sparse_map import Keyframe, SparseMap, Submap, check_rigid, covisibility, typical_distance


def pose(seed: int = 0, shift: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.2).as_matrix()
    transform[:3, 3] = rng.normal(size=3) * shift
    return transform


def submap(n_points: int = 30, n_keyframes: int = 3, camera=ENDOMAPPER, id: int = 0) -> Submap:
    """Random points in view of random keyframes; keyframe k observes points k, k + 1, ... under ids 100, 99, ..."""
    rng = np.random.default_rng(7)
    points = rng.uniform((-5, -5, 10), (5, 5, 30), (n_points, 3))
    ids = 100 - np.arange(n_points)
    keyframes = []
    for k in range(n_keyframes):
        cam_from_map = pose(k)
        pixels = camera.project(points @ cam_from_map[:3, :3].T + cam_from_map[:3, 3])[0]
        keyframes.append(Keyframe(f"{k:04d}.png", camera, cam_from_map, pixels[k:], ids[k:]))
    return Submap(id, tuple(keyframes), ids, points)


def test_keyframe_and_camera_axes_agree():
    keyframe = submap().keyframes[1]
    np.testing.assert_allclose(keyframe.in_camera(keyframe.center[None]), 0, atol=1e-12)
    point = np.array([1.0, 2, 3])
    expected = keyframe.cam_from_map @ np.append(point, 1)
    np.testing.assert_allclose(keyframe.in_camera(point[None])[0], expected[:3])
    assert keyframe.number == 1


@pytest.mark.parametrize("camera", [ENDOMAPPER, C3VD], ids=["endomapper", "c3vd"])
def test_observed_points_are_where_they_were_seen(camera):
    found = submap(camera=camera)
    for k, keyframe in enumerate(found.keyframes):
        ids, points, pixels = found.observed_points(keyframe)
        np.testing.assert_array_equal(ids, 100 - np.arange(k, 30))
        np.testing.assert_array_equal(points, found.points[k:])
        np.testing.assert_allclose(camera.project(keyframe.in_camera(points))[0], pixels)
    assert found.reprojection_errors().max() < 1e-9


def test_reprojection_error_is_the_distance_in_pixels():
    exact = submap()
    moved = tuple(replace(k, pixels=k.pixels + np.array([3.0, 4.0])) for k in exact.keyframes)
    np.testing.assert_allclose(replace(exact, keyframes=moved).reprojection_errors(), 5.0)


def test_observations_of_lost_points_and_second_observations_are_left_out():
    whole = submap()
    keyframe = replace(
        whole.keyframes[0],
        point_ids=np.array([100, 555, 99, 100, -1]),
        pixels=np.arange(10.0).reshape(5, 2),
    )
    ids, points, pixels = whole.observed_points(keyframe)
    np.testing.assert_array_equal(ids, [100, 99])
    np.testing.assert_array_equal(points, whole.points[:2])
    np.testing.assert_array_equal(pixels, [[0, 1], [4, 5]])


def test_a_keyframe_that_observed_nothing_gives_empty_arrays():
    whole = submap()
    blind = replace(whole.keyframes[0], point_ids=np.zeros(0, int), pixels=np.zeros((0, 2)))
    ids, points, pixels = whole.observed_points(blind)
    assert (ids.shape, points.shape, pixels.shape) == ((0,), (0, 3), (0, 2))
    assert replace(whole, keyframes=(blind,)).reprojection_errors().shape == (0,)
    assert covisibility(replace(whole, keyframes=(blind, whole.keyframes[1]))).tolist() == [[0, 0], [0, 29]]


def test_covisibility_counts_the_points_that_two_keyframes_share():
    whole = submap(n_points=10, n_keyframes=3)
    assert covisibility(whole).tolist() == [[10, 9, 8], [9, 9, 8], [8, 8, 8]]
    sets = [set(whole.observed_points(k)[0].tolist()) for k in whole.keyframes]
    assert covisibility(whole).tolist() == [[len(a & b) for b in sets] for a in sets]


def test_covisibility_of_a_long_map_needs_no_table_of_every_keyframe_and_point():
    """Nor the time for one: a map of 2000 keyframes took more than a quarter of an hour."""
    rng, one = np.random.default_rng(0), submap(4, 1).keyframes[0]
    keyframes = [
        replace(one, name=f"{k:06d}", point_ids=np.arange(300 * k, 300 * k + 600), pixels=rng.uniform(0, 9, (600, 2)))
        for k in range(300)
    ]
    whole = Submap(0, tuple(keyframes), np.arange(100_000), rng.normal(size=(100_000, 3)))
    tracemalloc.start()
    shared = covisibility(whole)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 300 * 100_000
    np.testing.assert_array_equal(shared, 600 * np.eye(300) + 300 * (np.eye(300, k=1) + np.eye(300, k=-1)))


@pytest.mark.parametrize("seed", range(3))
def test_wrong_points_that_are_too_far_do_not_make_the_typical_distance_larger(seed):
    """With 30 % of them it is the median distance of the right ones."""
    rng = np.random.default_rng(seed)
    whole, distance = submap(1000, 1), rng.uniform(10, 40, 1000)
    keyframe, rays = whole.keyframes[0], rng.uniform(-0.3, 0.3, (1000, 3)) + (0, 0, 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = distance * np.where(np.arange(1000) < 300, rng.uniform(4, 9, 1000), 1)
    points = (rays * seen[:, None] - keyframe.cam_from_map[:3, 3]) @ keyframe.cam_from_map[:3, :3]
    found = typical_distance(replace(whole, points=points))
    assert found == pytest.approx(np.median(distance[300:]), rel=0.03)


def test_every_observation_counts_for_the_typical_distance_and_a_map_without_any_is_refused():
    whole = submap(30, 2)
    distances = [np.linalg.norm(whole.observed_points(k)[1] - k.center, axis=1) for k in whole.keyframes]
    assert typical_distance(whole) == pytest.approx(np.quantile(np.concatenate(distances), 0.35))
    blind = replace(whole.keyframes[0], point_ids=np.zeros(0, int), pixels=np.zeros((0, 2)))
    with refused(where="map 0", found="no keyframe observes any of its points"):
        typical_distance(replace(whole, keyframes=(blind,)))


def transposed() -> np.ndarray:
    return pose().T


BAD_POSES = {
    "NaN or infinite": np.full((4, 4), np.nan),
    "shape (3, 4) … expected (4, 4)": pose()[:3],
    "not a rotation": np.diag([2.0, 2, 2, 1]),
    "det -1": np.diag([1.0, 1, -1, 1]),
    "column by column": transposed(),
}


@pytest.mark.parametrize("message", BAD_POSES)
def test_a_keyframe_whose_pose_is_none_is_refused_by_name(message):
    with refused(message, where="keyframe 0000.png"):
        replace(submap().keyframes[0], cam_from_map=BAD_POSES[message])


def test_a_pose_of_six_digits_is_good_enough():
    check_rigid(np.round(pose(3), 6), "keyframe")


def test_keypoints_and_point_ids_must_pair_up():
    with refused(found="30 keypoints, 29 point ids"):
        replace(submap().keyframes[0], point_ids=np.arange(29))


def with_bad_point() -> np.ndarray:
    points = submap().points.copy()
    points[4, 1] = np.nan
    return points


BAD_SUBMAPS = {
    "map 0 … has no points": {"points": np.zeros((0, 3)), "point_ids": np.zeros(0, int)},
    "map 0 … has no keyframes": {"keyframes": ()},
    "map 0 … 1 points are not finite, the first is point 96": {"points": with_bad_point()},
    "frame 0 is in it twice": {
        "keyframes": (submap().keyframes[0], replace(submap().keyframes[1], name="0_color.png"))
    },
    "mask.png … no number": {"keyframes": (replace(submap().keyframes[0], name="mask.png"),)},
    "30 points, 29 point ids": {"point_ids": np.arange(29)},
    "point 7 is in it twice": {"point_ids": np.array([7, *range(100, 128), 7])},
}


@pytest.mark.parametrize("message", BAD_SUBMAPS)
def test_a_map_that_cannot_be_used_is_refused_by_name(message):
    with refused(message):
        replace(submap(), **BAD_SUBMAPS[message])


def test_a_sequence_without_maps_or_with_one_id_twice_is_refused_with_its_source():
    with refused(where="run/output", found="no map in it"):
        SparseMap((), "run/output")
    with refused(where="run/output", found="two maps have the id 3"):
        SparseMap((submap(id=3), submap(id=1), submap(id=3)), "run/output")
    assert len(SparseMap((submap(id=3), submap(id=1)), "run/output").submaps) == 2


@pytest.mark.parametrize("number", [1403636579829666666, 1403636579763000001])
def test_a_keyframe_named_in_nanoseconds_meets_the_frame_of_that_very_name(number):
    keyframe = Keyframe(f"{number}.png", ENDOMAPPER, np.eye(4), np.zeros((0, 2)), np.zeros(0, int))
    assert BY_NUMBER.number(keyframe) == number and Counting(offset=-1).number(keyframe) == number - 1
