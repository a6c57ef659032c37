from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from colons import EXACT, colon, slam
from raising import refused

from lightdepth.sparse_map import Keyframe, SparseMap, Submap, typical_distance
from lightdepth.tube.map_errors import (
    MapErrors,
    pose_drift,
    scale_drift,
    side_moved,
    with_errors,
    wrong_fold,
    wrong_loop,
)

ALL = MapErrors(drift=1.3, side_share=0.3, fold_share=0.1, loop_share=0.4, pose_drift=0.1, pose_drift_deg=3.0)


@cache
def exact() -> Submap:
    """A map without any error of a colon that is looked along."""
    (submap,) = slam(colon(0).frames, config=EXACT).map.submaps
    return submap


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def distances(submap: Submap) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Ids and distances of what each keyframe observed, by its number."""
    found = {k.number: (k, *submap.observed_points(k)[:2]) for k in submap.keyframes}
    return {n: (ids, np.linalg.norm(k.in_camera(points), axis=1)) for n, (k, ids, points) in found.items()}


def grown(after: Submap, before: Submap | None = None) -> dict[int, np.ndarray]:
    """By which factor the distance of each observed point grew, by the number of the keyframe."""
    old = distances(before or exact())
    return {n: new / old[n][1] for n, (_, new) in distances(after).items()}


def moved(after: Submap) -> np.ndarray:
    return np.linalg.norm(after.points - exact().points, axis=1) > 1e-9


def same_poses(after: Submap) -> bool:
    pairs = zip(exact().keyframes, after.keyframes, strict=True)
    return all(np.array_equal(a.cam_from_map, b.cam_from_map) for a, b in pairs)


@cache
def short_tracks() -> Submap:
    """The exact map as a SLAM has it: no point is seen by more than three keyframes in a row."""
    (submap,) = slam(colon(0, 10, 40.0).frames, config=EXACT).map.submaps
    first = rng().integers(-2, 10, len(submap.points))  # ids count from 0
    seen = [(first[k.point_ids] <= n) & (n < first[k.point_ids] + 3) for n, k in enumerate(submap.keyframes)]
    pairs = zip(submap.keyframes, seen, strict=True)
    kept = tuple(replace(k, pixels=k.pixels[row], point_ids=k.point_ids[row]) for k, row in pairs)
    return replace(submap, keyframes=kept)


def test_scale_drifts_from_the_start_to_one_for_points_and_path_alike():
    before = short_tracks()
    after = scale_drift(before, 1.3)
    typical = [float(np.median(f)) for f in grown(after, before).values()]
    assert typical == pytest.approx(list(1.3 ** np.linspace(1, 0, 10)), abs=0.03)
    steps = [np.linalg.norm(np.diff([k.center for k in s.keyframes], axis=0), axis=1) for s in (after, before)]
    ratio = steps[0] / steps[1]
    assert ratio[0] == pytest.approx(1.3, abs=0.03) and ratio[-1] == pytest.approx(1.0, abs=0.03)
    assert np.median(after.reprojection_errors()) < 0.5  # what the images show hardly changes


def test_scale_without_drift_is_the_same_map():
    after = scale_drift(exact(), 1.0)
    np.testing.assert_allclose(after.points, exact().points, atol=1e-9)
    np.testing.assert_allclose(after.keyframes[-1].cam_from_map, exact().keyframes[-1].cam_from_map, atol=1e-9)


@pytest.mark.parametrize(("share", "factor"), [(0.1, 1.5), (0.45, 1.3), (0.3, 1.05)])
def test_one_side_is_as_much_further_from_all_keyframes_as_asked(share, factor):
    after = side_moved(exact(), share, factor, rng())
    assert moved(after).mean() == pytest.approx(share, abs=0.001) and same_poses(after)
    away = moved(after)[np.concatenate([after.rows_of(ids)[0] for ids, _ in distances(after).values()])]
    factors = np.concatenate(list(grown(after).values()))
    assert np.median(factors[away]) == pytest.approx(factor, rel=0.02)
    assert np.quantile(factors[away], 0.9) < 1.1 * factor and (factors[~away] == 1).all()


def test_the_moved_points_are_one_side_of_the_wall():
    after = side_moved(exact(), 0.3, 1.3, rng())
    middle = exact().keyframes[4]
    x, y = middle.in_camera(exact().points)[:, :2].T
    angle = np.exp(1j * np.arctan2(y, x))[moved(after)]
    assert abs(angle.mean()) > 0.75  # all around, it would be 0


def test_a_patch_of_wall_is_shifted_ahead_to_the_next_fold():
    after = wrong_fold(exact(), 0.15, 0.6, rng())
    away = moved(after)
    assert away.mean() == pytest.approx(0.15, abs=0.001) and same_poses(after)
    shift = (after.points - exact().points)[away]
    np.testing.assert_allclose(np.linalg.norm(shift, axis=1), 0.6 * typical_distance(exact()))
    ahead = exact().keyframes[4].cam_from_map[2, :3]
    assert (shift @ ahead / np.linalg.norm(shift, axis=1)).min() > 0.9
    spread = [np.linalg.norm(p - p.mean(0), axis=1).mean() for p in (exact().points[away], exact().points)]
    assert spread[0] < 0.75 * spread[1]


def test_a_wrong_loop_puts_one_place_nearer_another_and_bends_what_lies_between():
    before = short_tracks()
    after = wrong_loop(before, 4 / 9, 0.5, 0.6)  # of 10 keyframes: from the fourth to the eighth
    old, new = (np.stack([k.center for k in s.keyframes]) for s in (before, after))
    np.testing.assert_allclose(new[:4], old[:4], atol=1e-9)
    np.testing.assert_allclose(new[7], (old[3] + old[7]) / 2, atol=1e-9)
    steps = [np.linalg.norm(np.diff(centers, axis=0), axis=1) for centers in (new, old)]
    assert steps[0] / steps[1] == pytest.approx([1] * 3 + [0.5] * 4 + [1] * 2, abs=0.03)
    first, last = (seen_by(before, keyframes) for keyframes in (before.keyframes[:4], before.keyframes[7:]))
    shift = after.points - before.points
    assert (shift[first & ~seen_by(before, before.keyframes[4:])] == 0).all()
    own = last & ~seen_by(before, before.keyframes[:7])
    there = [s.keyframes[-1].in_camera(s.points[own]) for s in (before, after)]
    assert np.median(np.abs(there[1] - there[0])) < 1e-9  # what is seen after the loop alone is carried rigidly


def seen_by(submap: Submap, keyframes: tuple[Keyframe, ...]) -> np.ndarray:
    return np.isin(submap.point_ids, np.concatenate([k.point_ids for k in keyframes]))


def test_a_loop_closed_onto_one_place_looks_from_there_as_it_did_from_the_other():
    first, *_, last = wrong_loop(exact(), 1.0, 1.0, 0.0).keyframes
    np.testing.assert_allclose(last.cam_from_map, first.cam_from_map, atol=1e-9)


def test_points_of_both_places_of_a_wrong_loop_are_fused_where_they_meet():
    after = wrong_loop(short_tracks(), 4 / 9, 0.5, 0.6)
    twice = len(after.points) - len(np.unique(after.points, axis=0))
    assert len(np.unique(short_tracks().points, axis=0)) == len(after.points) and 10 < twice < 0.2 * len(after.points)


def test_poses_drift_as_far_as_asked_and_the_points_stay():
    after = pose_drift(exact(), 0.2, 5.0, False, rng())
    pairs = list(zip(exact().keyframes, after.keyframes, strict=True))
    length = sum(np.linalg.norm(b.center - a.center) for a, b in pairwise(exact().keyframes))
    off = np.array([np.linalg.norm(b.center - a.center) for a, b in pairs])
    assert off[0] < 1e-9 and off[-1] == pytest.approx(0.2 * length)
    turns = [b.cam_from_map[:3, :3] @ a.cam_from_map[:3, :3].T for a, b in pairs]
    assert np.degrees(np.arccos((np.trace(turns[-1]) - 1) / 2)) == pytest.approx(5.0)
    assert not moved(after).any()
    assert np.median(after.reprojection_errors()) > 1


def test_points_that_follow_the_poses_stay_where_the_images_show_them():
    left, followed = (pose_drift(exact(), 0.1, 5.0, follow, rng()) for follow in (False, True))
    assert same_poses(replace(left, keyframes=exact().keyframes)) and moved(followed).all()
    errors = [np.median(s.reprojection_errors()) for s in (left, followed)]
    assert errors[1] < 0.5 * errors[0]


def test_what_was_observed_stays_as_it_was_recorded():
    after = with_errors(exact(), ALL, 0)
    assert np.array_equal(after.point_ids, exact().point_ids)
    for a, b in zip(exact().keyframes, after.keyframes, strict=True):
        assert a.name == b.name and np.array_equal(a.pixels, b.pixels) and np.array_equal(a.point_ids, b.point_ids)


def test_a_seed_gives_the_same_errors_and_another_one_others():
    first, again, other = (with_errors(exact(), ALL, seed).points for seed in (0, 0, 1))
    assert np.array_equal(first, again) and not np.allclose(first, other)


def test_of_one_seed_an_error_is_the_same_whatever_the_others():
    side = MapErrors(side_share=0.3)
    alone, among = moved(with_errors(exact(), side, 5)), with_errors(exact(), replace(side, fold_share=0.1), 5)
    assert (moved(among) | ~alone).all() and moved(among).sum() > alone.sum()


def test_without_a_size_there_is_no_error():
    assert with_errors(exact(), MapErrors(), 0) is exact()


def test_every_submap_of_a_map_errs_in_its_own_way():
    whole = SparseMap((exact(), replace(exact(), id=1)), "two")
    first, second = with_errors(whole, MapErrors(side_share=0.3), 0).submaps
    assert (moved(first) != moved(second)).any() and first.id == 0 and second.id == 1


def test_points_that_no_keyframe_observed_move_with_the_nearest_one():
    blind = tuple(replace(k, pixels=k.pixels[:0], point_ids=k.point_ids[:0]) for k in exact().keyframes)
    after = scale_drift(replace(exact(), keyframes=blind), 2.0)
    assert np.isfinite(after.points).all() and moved(after).mean() > 0.5


def test_a_map_of_one_keyframe_can_err():
    one = replace(exact(), keyframes=exact().keyframes[:1])
    after = with_errors(one, replace(ALL, points_follow=True), 0)
    assert np.isfinite(after.points).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"drift": 0.0},
        {"side_factor": 100.0},
        {"side_share": 1.5},
        {"fold_share": -0.1},
        {"pose_drift": float("nan")},
        {"pose_drift_deg": -1.0},
        {"fold_shift": float("inf")},
        {"loop_share": 2.0},
        {"loop_shift": -0.5},
        {"loop_at": 1.5},
    ],
)
def test_sizes_that_mean_nothing_are_refused(changes):
    with refused(where=next(iter(changes)), found=str(next(iter(changes.values())))):
        MapErrors(**changes)
