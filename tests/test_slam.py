"""The simulated SLAM whose errors are those of a real one; the independent kind is tested in test_tube.py."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from colons import colon, in_world, slam
from raising import refused

from lightdepth.sparse_map import Submap
from lightdepth.tube import lens, render_sequence
from lightdepth.tube.slam import SimulatedSlam, SlamConfig, check_enough_frames, least_frames, simulate_slam

TRACKED = SlamConfig()


@cache
def setting() -> tuple[list, SimulatedSlam]:
    """Ten keyframes as far apart as a real SLAM's, and their map."""
    frames = render_sequence(310, 10, lens("pinhole", 240, 192), 40.0).frames
    return frames, slam(frames, 3, TRACKED, points_per_keyframe=400)


def factors(frames, submap: Submap) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By keyframe: ids, pixels, and distance over true distance, with median 1 over all."""
    found, true = {}, {f.number: f for f in frames}
    for keyframe in submap.keyframes:
        ids, points, pixels = submap.observed_points(keyframe)
        frame = true[keyframe.number]
        column, row = pixels.astype(int).clip(0, [frame.camera.width - 1, frame.camera.height - 1]).T
        distance = frame.true_distance[row, column]
        ratio = np.linalg.norm(keyframe.in_camera(points), axis=1) / np.where(distance > 0, distance, np.inf)
        found[keyframe.number] = ids[ratio > 0], pixels[ratio > 0], ratio[ratio > 0]
    typical = np.median(np.concatenate([ratio for *_, ratio in found.values()]))
    return {number: (ids, pixels, ratio / typical) for number, (ids, pixels, ratio) in found.items()}


def test_distances_err_as_those_of_a_real_slam():
    frames, found = setting()
    error = np.abs(np.concatenate([ratio for *_, ratio in factors(frames, found.map.submaps[0]).values()]) - 1)
    assert 0.025 < np.median(error) < 0.046 and 0.1 < np.quantile(error, 0.9) < 0.2
    assert 0.02 < (error > 0.3).mean() < 0.05


def test_neighbouring_points_err_together_and_distant_ones_do_not():
    frames, found = setting()
    near, far = [], []
    for _, pixels, ratio in factors(frames, found.map.submaps[0]).values():
        log = np.log(ratio)
        usual = np.abs(log) < 0.25
        log, pixels = (log[usual] - log[usual].mean()) / log[usual].std(), pixels[usual]
        away = np.linalg.norm(pixels[:, None] - pixels, axis=-1) / 240
        product = log[:, None] * log
        near.append(product[(away > 0) & (away < 0.04)])
        far.append(product[away > 0.3])
    assert np.concatenate(near).mean() > 0.08 > 4 * abs(np.concatenate(far).mean())


def test_tracks_are_short():
    (submap,) = setting()[1].map.submaps
    times = np.unique(np.concatenate([k.point_ids for k in submap.keyframes]), return_counts=True)[1]
    assert len(times) == len(submap.points) and times.min() == 2 and 2.8 < times.mean() < 4.2


def test_a_keyframe_observes_as_many_points_as_asked_at_most():
    observed = [len(k.point_ids) for k in setting()[1].map.submaps[0].keyframes]
    assert max(observed) <= 400 and min(observed) > 150


def test_images_hardly_contradict_a_point_that_is_not_quite_right():
    (submap,) = setting()[1].map.submaps
    assert np.median(submap.reprojection_errors()) < 1.5


def test_scale_drifts_by_a_few_per_cent_and_map_from_world_has_that_of_the_middle():
    frames, found = setting()
    (submap,) = found.map.submaps
    typical = [np.median(ratio) for *_, ratio in factors(frames, submap).values()]
    assert 0.02 < abs(typical[-1] / typical[0] - 1) < 0.06
    steady = slam(frames, 3, TRACKED, points_per_keyframe=400, drift=0.0, point_noise=0.0, spurious=0.0)
    world = [in_world(s, s.map.submaps[0]) for s in (found, steady)]
    off = np.linalg.norm(world[0] - world[1], axis=1) / np.linalg.norm(world[1] - world[1].mean(0), axis=1)
    assert np.median(off) < 0.15


def test_wrong_points_are_known_and_as_many_as_asked():
    frames = setting()[0]
    found = slam(frames, 1, TRACKED, points_per_keyframe=400, spurious=0.2)
    assert len(found.spurious_ids[0]) / len(found.map.submaps[0].points) == pytest.approx(0.2, abs=0.04)


def test_a_seed_gives_the_same_map_and_another_one_another():
    frames = colon(0, 10, 40.0).frames
    first, again, other = (slam(frames, seed, TRACKED).map.submaps[0] for seed in (0, 0, 1))
    assert np.array_equal(first.points, again.points) and len(first.points) != len(other.points)


def test_keyframes_are_ten_to_twenty_frames_apart_unless_it_is_said():
    few = colon(0, 2, 1.0).frames
    frames = [replace(few[i % 2], name=f"{i:06d}") for i in range(100)]
    (submap,) = simulate_slam(frames, replace(TRACKED, maps=1), 0).map.submaps
    gaps = np.diff([k.number for k in submap.keyframes])
    assert gaps.min() >= 10 and gaps.max() <= 20 and len(set(gaps)) > 1


@pytest.mark.parametrize("config", [TRACKED, SlamConfig("independent"), replace(TRACKED, maps=3, keyframe_every=7)])
def test_too_few_frames_are_refused_with_the_least_number_that_does(config):
    (few,) = colon(0, 1, 1.0).frames
    for seed in range(5):
        least = least_frames(config, seed)
        with refused(where=f"{least - 1} frames", found=f"{config.maps} submaps", cure=f"--frames {least})"):
            simulate_slam([few] * (least - 1), config, seed)
        check_enough_frames(least, config, seed)
    assert least_frames(SlamConfig("independent"), 0) == 7


def test_a_wall_without_corners_has_no_map():
    black = [replace(f, image=np.zeros_like(f.image)) for f in colon(0).frames]
    with refused(found="no point is seen by enough keyframes"):
        slam(black, config=TRACKED)
