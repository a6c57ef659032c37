"""Submaps that meet: on colons whose Sim(3) is known, and on the real sinus map cut in two."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from colons import EXACT, colon, sequence, truth
from raising import refused
from scipy.spatial.transform import Rotation

from densify.alignment import Alignment
from densify.config import DensifyConfig
from densify.dense_map import DenseMap
from densify.inputs import fitted_to_frames
from densify.joining import MergeConfig, join_maps, joined_submap, merge, moved_keyframe
from densify.judging.config import JudgeConfig
from densify.pipeline import SubmapResult, densify, densify_submap
from densify.similarity import Similarity, robust_similarity, umeyama
from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.models import DeclineModel
from lightdepth.sparse_map import Keyframe, Submap
from lightdepth.tube.slam import SlamConfig, simulate_slam

POINTS = MergeConfig(by=("points",))
QUICK = DensifyConfig(judge=JudgeConfig(on=False), recipe="paper")


def random_similarity(rng: np.random.Generator) -> Similarity:
    return Similarity(float(np.exp(rng.uniform(-2, 2))), Rotation.random(rng=rng).as_matrix(), 5 * rng.normal(size=3))


def difference(found: Similarity, true: Similarity) -> tuple[float, float]:
    """Relative error of the scale, and of the rotation in degrees."""
    turn = Rotation.from_matrix(found.rotation @ true.rotation.T).magnitude()
    return abs(found.scale / true.scale - 1), float(np.rad2deg(turn))


def bare(submap: Submap) -> DenseMap:
    """A submap without a surface."""
    none = np.zeros((0, 3))
    return DenseMap(submap, none, none.astype(int), none, (Alignment("x"),) * len(submap.keyframes), 1.0)


@cache
def halves(seed: int, shared: int, config: SlamConfig = EXACT, maps: int = 2):
    """Submaps of one colon with surfaces of exact depth, and the true Sim(3) from each to the first."""
    frames = colon(seed).frames
    slam = simulate_slam(frames, replace(config, keyframe_every=1, maps=maps, shared_keyframes=shared), seed)
    from_world = [Similarity(*slam.map_from_world[s.id]) for s in slam.map.submaps]
    results = densify(sequence(frames), slam.map, truth, QUICK)
    return [r.dense for r in results], [from_world[0] @ f.inverse() for f in from_world]


def meeting(maps, config: MergeConfig = MergeConfig(), frames=None):
    return join_maps(maps, frames, config, np.random.default_rng(0))


def test_a_similarity_is_found_among_sixty_percent_of_wrong_correspondences():
    rng = np.random.default_rng(0)
    true, source = random_similarity(rng), rng.normal(size=(200, 3))
    target = true.apply(source)
    target[:120] = true.apply(rng.normal(size=(120, 3)))
    tolerance = np.full(200, 0.02 * true.scale)
    found, agrees = robust_similarity(source, target, tolerance, rng)
    assert difference(found, true) == pytest.approx((0, 0), abs=1e-4)
    assert agrees[120:].all() and agrees[:120].sum() < 5


def test_no_similarity_is_made_of_points_on_a_line_or_of_too_few():
    rng = np.random.default_rng(0)
    line = np.outer(np.arange(30.0), (1, 2, 3))
    assert robust_similarity(line[:2], line[:2], np.full(2, 0.1), rng) is None
    noise = rng.normal(size=(30, 3))
    found = robust_similarity(noise, rng.normal(size=(30, 3)), np.full(30, 1e-3), rng)
    assert found is None or found[1].sum() <= 4


def test_many_similarities_at_once_are_each_the_one_of_their_points_and_weights():
    rng = np.random.default_rng(1)
    trues = [random_similarity(rng) for _ in range(4)]
    source = rng.normal(size=(4, 6, 3))
    target = np.stack([t.apply(s) for t, s in zip(trues, source, strict=True)])
    target[:, 0] += 9
    scale, rotation, translation = umeyama(source, target, np.array([0, 1, 1, 1, 2, 1.0]) * np.ones((4, 1)))
    for i, true in enumerate(trues):
        found = Similarity(scale[i], rotation[i], translation[i])
        assert difference(found, true) == pytest.approx((0, 0), abs=1e-5)
        back = (found.inverse() @ found).apply(source[i])
        np.testing.assert_allclose(back, source[i], atol=1e-9)


def test_a_moved_keyframe_sees_the_moved_points_where_it_saw_them():
    rng = np.random.default_rng(2)
    submap = halves(0, 3)[0][0].submap
    similarity = random_similarity(rng)
    for keyframe in submap.keyframes:
        before = keyframe.camera.project(keyframe.in_camera(submap.points))[0]
        moved = moved_keyframe(keyframe, similarity)
        after = moved.camera.project(moved.in_camera(similarity.apply(submap.points)))[0]
        np.testing.assert_allclose(after, before, atol=1e-6)


def test_maps_that_share_frames_meet_by_the_points_seen_in_them_whatever_their_ids_and_wrong_points():
    maps, true = halves(0, 3, SlamConfig("independent", spurious=0.3))
    found = meeting([bare(m.submap) for m in maps], POINTS)
    assert [set(g) for g in found.groups] == [{0, 1}] and [j.by for j in found.joins] == ["points"]
    (group,) = found.groups
    first = next(iter(group))
    scale, degrees = difference(group[1 - first], true[1] if first == 0 else true[1].inverse())
    assert scale < 0.02 and degrees < 1


def test_maps_with_the_same_ids_and_no_common_frame_meet_only_if_the_points_agree():
    maps, _ = halves(0, 3)
    whole = maps[0].submap
    other = random_similarity(np.random.default_rng(3))
    first, last = whole.keyframes[:3], whole.keyframes[-3:]
    early = replace(whole, keyframes=first)
    late = replace(
        whole, id=1, keyframes=tuple(moved_keyframe(k, other) for k in last), points=other.apply(whole.points)
    )
    found = meeting([bare(early), bare(late)], POINTS)
    assert difference(found.groups[0][1], other.inverse()) == pytest.approx((0, 0), abs=1e-3)
    shuffled = replace(late, points=np.random.default_rng(0).permutation(late.points))
    assert len(meeting([bare(early), bare(shuffled)], POINTS).groups) == 2


def test_maps_that_share_frames_but_no_point_meet_by_what_the_frames_see_of_both_surfaces():
    maps, true = halves(1, 3)
    found = meeting(maps, MergeConfig(by=("frames",)))
    (group,) = found.groups
    first = next(iter(group))
    scale, degrees = difference(group[1 - first], true[1] if first == 0 else true[1].inverse())
    assert scale < 0.02 and degrees < 1 and found.joins[0].surfaces.gap < 0.02


def test_maps_without_common_frames_meet_by_the_shape_of_their_surfaces():
    maps, true = halves(1, 0)
    assert len(meeting(maps).groups) == 2  # unless asked for, shape alone joins nothing
    found = meeting(maps, MergeConfig(by=("surface",)))
    (group,) = found.groups
    assert [j.by for j in found.joins] == ["surface"]
    first = next(iter(group))
    scale, degrees = difference(group[1 - first], true[1] if first == 0 else true[1].inverse())
    assert scale < 0.02 and degrees < 1


def test_two_colons_are_not_joined_and_it_is_said_why():
    ours, theirs = halves(0, 0)[0][0], halves(1, 0)[0][1]
    apart = replace(theirs, submap=replace(theirs.submap, id=1))
    found = meeting([ours, apart])
    assert len(found.groups) == 2 and not found.joins
    alone = found.alone()
    assert set(alone) == {0, 1} and "nothing that could be compared" in alone[0]


def test_frames_numbered_alike_by_two_videos_do_not_join_their_maps():
    ours, theirs = halves(0, 3)[0][0], halves(1, 3)[0][0]
    apart = replace(theirs, submap=replace(theirs.submap, id=1))
    found = meeting([ours, apart], MergeConfig(by=("points", "frames")))
    assert len(found.groups) == 2
    reasons = found.alone()[0]
    assert "by points: " in reasons and "by frames: " in reasons


def test_poses_of_shared_frames_that_contradict_the_points_refuse_the_join():
    maps, _ = halves(0, 3)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    second = maps[1].submap
    turned = replace(second, keyframes=tuple(replace(k, cam_from_map=turn @ k.cam_from_map) for k in second.keyframes))
    found = meeting([bare(maps[0].submap), bare(turned)], POINTS)
    assert len(found.groups) == 2 and "poses differ by 17.2 degrees; at most 5" in found.alone()[0]


def test_a_chain_of_maps_becomes_one_group_in_the_unit_of_the_largest():
    frames = colon(0).frames
    slam = simulate_slam(frames, replace(EXACT, keyframe_every=1, maps=3, shared_keyframes=2), 0)
    found = meeting([bare(s) for s in slam.map.submaps], POINTS)
    (group,) = found.groups
    largest = max(slam.map.submaps, key=lambda s: len(s.keyframes)).id
    assert next(iter(group)) == largest and len(found.joins) == 2 and not found.alone()
    for i, similarity in group.items():
        true = Similarity(*slam.map_from_world[largest]) @ Similarity(*slam.map_from_world[i]).inverse()
        assert difference(similarity, true) == pytest.approx((0, 0), abs=0.1)


def test_the_joined_submap_has_every_frame_once_and_the_points_of_both_with_those_they_share_once():
    maps, true = halves(0, 3)
    submaps = [m.submap for m in maps]
    joined = joined_submap(submaps, dict(enumerate(true)), 7, MergeConfig())
    assert joined.id == 7 and [k.number for k in joined.keyframes] == list(range(10))
    assert np.median(joined.reprojection_errors()) < 0.01
    total = sum(len(s.points) for s in submaps)
    assert total - 200 > len(joined.points) > max(len(s.points) for s in submaps)
    for keyframe in joined.keyframes:
        assert len(set(keyframe.point_ids.tolist())) == len(keyframe.point_ids)


def test_merging_gives_one_surface_of_all_keyframes_that_lies_on_the_single_ones():
    frames = colon(0).frames
    maps, _ = halves(0, 3)
    results = [SubmapResult(m, None, 0.0, {}) for m in maps]
    merged = merge(results, sequence(frames), truth, QUICK, MergeConfig())
    (result,) = merged.results
    assert len(result.dense.aligned) == 10 and result.seen_share > 0.9
    units = {i: 2.0 + i for i in merged.groups[0]}
    record = merged.record(units.__getitem__)
    assert record["joined"][0]["folder"] == "joined_000" and record["joined"][0]["maps"] == list(merged.groups[0])
    (transform,) = record["joined"][0]["transforms"]
    similarity = merged.groups[0][transform["first"]]
    place = np.array([1.0, 2.0, 3.0])  # in the first map's own unit; each map is written in another multiple of its own
    came = transform["scale"] * np.array(transform["rotation"]) @ (units[transform["first"]] * place)
    expected = units[transform["second"]] * similarity.apply(place[None])[0]
    np.testing.assert_allclose(came + transform["translation"], expected)
    assert meeting(maps).groups[0].keys() == merged.groups[0].keys()


def test_a_map_that_observed_nothing_is_left_alone_with_the_reason_and_the_others_meet():
    maps, _ = halves(0, 3)
    submaps = [m.submap for m in maps]
    nothing = {"pixels": np.zeros((0, 2)), "point_ids": np.zeros(0, int)}
    blind = replace(submaps[1], id=2, keyframes=tuple(replace(k, **nothing) for k in submaps[1].keyframes))
    found = meeting(
        [bare(s) for s in (*submaps, blind)], MergeConfig(by=("points", "looks")), sequence(colon(0).frames)
    )
    assert sorted(map(sorted, found.groups)) == [[0, 1], [2]]
    assert found.alone() == {2: "it has nothing that could be compared with another map"}


def test_an_unknown_way_to_join_is_refused():
    with refused(where="merging.by", found="magic"):
        MergeConfig(by=("points", "magic"))


# ---- real


SINUS = "sinus/example_training_data_root/bag_1/_start_004259_end_004629_stride_25_segment_13"


@cache
def sinus(realdata) -> tuple[FrameSequence, Submap]:
    """The frames at 480x270, kept in memory, and the whole COLMAP map of them."""
    folder, sparse = realdata / SINUS, read_map(realdata / "sinus" / "derived_colmap" / "sparse_txt" / "0")
    camera = sparse.submaps[0].keyframes[0].camera
    on_disk = open_sequence(folder, light="gamma=2.2,mu=0", mask=folder / "undistorted_mask.bmp", map_camera=camera)
    small = []
    for frame in on_disk:
        image = cv2.resize(frame.image, (480, 270), interpolation=cv2.INTER_AREA)
        mask = cv2.resize(frame.valid.astype(np.uint8), (480, 270), interpolation=cv2.INTER_NEAREST) > 0
        small.append(Frame(frame.name, image, camera.resized(480, 270), frame.light, mask))
    (whole,) = fitted_to_frames(sparse, 480, 270).submaps
    return sequence(small), whole


def disturbed_part(
    whole: Submap, map_id: int, rows: range, rng: np.random.Generator, noise: float = 0.01
) -> tuple[Submap, Similarity]:
    """Some keyframes and the points that two of them saw, under new ids, with points and centres disturbed by a share
    of the depth, in a frame and unit of its own; and the Sim(3) that leads there."""
    keyframes = [whole.keyframes[i] for i in rows]
    seen = [whole.observed_points(k) for k in keyframes]
    ids, count = np.unique(np.concatenate([i for i, _, _ in seen]), return_counts=True)
    ids = ids[count >= 2]
    points = whole.points[whole.rows_of(ids)[0]]
    depth = np.median(np.concatenate([k.in_camera(p)[:, 2] for k, (_, p, _) in zip(keyframes, seen, strict=True)]))
    points = points + noise * depth * rng.normal(size=points.shape)
    new = rng.permutation(3 * len(ids))[: len(ids)]
    similarity = random_similarity(rng)
    moved = []
    for keyframe, (own, _, pixels) in zip(keyframes, seen, strict=True):
        kept = np.isin(own, ids)
        pose = keyframe.cam_from_map.copy()
        pose[:3, 3] = -pose[:3, :3] @ (keyframe.center + noise * depth * rng.normal(size=3))
        renumbered = new[np.searchsorted(ids, own[kept])]
        changed = Keyframe(keyframe.name, keyframe.camera, pose, pixels[kept], renumbered)
        moved.append(moved_keyframe(changed, similarity))
    return Submap(map_id, tuple(moved), new, similarity.apply(points)), similarity


def joined_error(
    realdata, rows: tuple[range, range], seed: int, config: MergeConfig = MergeConfig()
) -> tuple[float, float, str]:
    """Errors of scale and rotation [degrees] between two parts of the sinus map, and what they were joined by."""
    frames, whole = sinus(realdata)
    rng = np.random.default_rng(seed)
    parts = [disturbed_part(whole, i, r, rng) for i, r in enumerate(rows)]
    model = DeclineModel(details=False)
    maps = [densify_submap(p, frames, model, DensifyConfig(judge=JudgeConfig(on=False))).dense for p, _ in parts]
    found = meeting(maps, config, frames)
    assert len(found.groups) == 1, found.alone()
    (group,) = found.groups
    first = next(iter(group))
    true = parts[first][1] @ parts[1 - first][1].inverse()
    scale, degrees = difference(group[1 - first], true)
    print(f"seed {seed}: scale {scale:.2%}, rotation {degrees:.2f} degrees, by {found.joins[0].by}")
    return scale, degrees, found.joins[0].by


@pytest.mark.parametrize("seed", [400, pytest.param(401, marks=pytest.mark.slow)])
def test_two_overlapping_halves_of_the_sinus_are_joined(realdata, seed):
    scale, degrees, by = joined_error(realdata, (range(20), range(15, 35)), seed)
    assert scale < 0.02 and degrees < 1 and by == "points"


@pytest.mark.slow
@pytest.mark.parametrize("by", ["looks", "surface"])
@pytest.mark.parametrize("seed", [400, 401])
def test_two_halves_of_the_sinus_without_a_common_frame_are_joined_by_the_surface_that_both_see(realdata, seed, by):
    """By the points on it that look alike, which is tried first, and by its shape alone."""
    scale, degrees, found = joined_error(realdata, (range(17), range(17, 35)), seed, MergeConfig(by=(by,)))
    assert scale < 0.05 and degrees < 3 and found == by
