"""Errors of trajectories against references written here and evo, their files, and what cannot be aligned."""

from __future__ import annotations

import json

import numpy as np
import pytest
from colons import colon, slam
from raising import refused
from scipy.spatial.transform import Rotation

from densify.evaluation.errors import rms_ate, sideways_agreement
from densify.evaluation.trajectory import (
    CLIMB_POSES,
    Trajectory,
    align_trajectory,
    in_order,
    read_trajectories,
    span,
    trajectory_files,
    trajectory_summary,
)
from densify.similarity import Similarity, fit_similarity
from lightdepth.files.tum import write_tum
from lightdepth.maps import write_multimap


def case(seed: int, n: int | None = None, noise: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Map centres (n, 3) in units of their own, and true ones [mm] that differ by a Sim(3) and noise."""
    rng = np.random.default_rng(seed)
    n = n or int(rng.integers(4, 60))
    true = np.cumsum(rng.normal(size=(n, 3)), 0) * rng.uniform(0.3, 3, 3)
    away = Similarity(float(np.exp(rng.normal())), Rotation.random(rng=rng).as_matrix(), 10 * rng.normal(size=3))
    return away.apply(true + noise * rng.normal(size=true.shape)), true


def horn(source: np.ndarray, target: np.ndarray, with_scale: bool) -> np.ndarray:
    """Horn's closed form by unit quaternions (1987): the moved source (n, 3). Another way than ours, by the SVD."""
    s, t = source - source.mean(0), target - target.mean(0)
    m = s.T @ t
    trace, symmetric = np.trace(m), m + m.T
    delta = np.array([m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]])
    n = np.block([[np.array([[trace]]), delta[None]], [delta[:, None], symmetric - trace * np.eye(3)]])
    w, x, y, z = np.linalg.eigh(n)[1][:, -1]
    rotated = Rotation.from_quat([x, y, z, w]).apply(s)
    scale = (rotated * t).sum() / (s**2).sum() if with_scale else 1.0
    return scale * rotated + target.mean(0)


@pytest.mark.parametrize("with_scale", [True, False], ids=["sim3", "se3"])
@pytest.mark.parametrize("seed", range(20))
def test_ate_agrees_with_horn_s_closed_form(seed, with_scale):
    source, target = case(seed)
    found = rms_ate(source, target, fit_similarity(source, target, with_scale))
    errors = horn(source, target, with_scale) - target
    assert found == pytest.approx(np.sqrt((errors**2).sum(1).mean()), rel=1e-9)


@pytest.mark.parametrize("with_scale", [True, False], ids=["sim3", "se3"])
def test_ate_agrees_with_evo_on_twenty_random_trajectories(with_scale):
    pytest.importorskip("evo")
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    for seed in range(20):
        source, target = case(seed)
        turns = np.tile([1.0, 0, 0, 0], (len(source), 1))
        estimate, truth = (PosePath3D(positions_xyz=p.copy(), orientations_quat_wxyz=turns) for p in (source, target))
        estimate.align(truth, correct_scale=with_scale)
        error = metrics.APE(metrics.PoseRelation.translation_part)
        error.process_data((truth, estimate))
        theirs = error.get_statistic(metrics.StatisticsType.rmse)
        assert rms_ate(source, target, fit_similarity(source, target, with_scale)) == pytest.approx(theirs, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_ate_does_not_hang_on_the_map_s_frame_of_reference_scale_or_order(seed):
    source, target = case(seed)
    expected = rms_ate(source, target, fit_similarity(source, target))
    rng = np.random.default_rng(seed)
    away = Similarity(float(np.exp(3 * rng.normal())), Rotation.random(rng=rng).as_matrix(), 1e3 * rng.normal(size=3))
    order = rng.permutation(len(source))
    moved = away.apply(source)[order]
    assert rms_ate(moved, target[order], fit_similarity(moved, target[order])) == pytest.approx(expected, rel=1e-9)
    metres = rms_ate(source, target / 1000, fit_similarity(source, target / 1000))
    assert 1000 * metres == pytest.approx(expected, rel=1e-9)


def poses(centers: np.ndarray, first: int = 0) -> dict[int, np.ndarray]:
    found = np.tile(np.eye(4), (len(centers), 1, 1))
    found[:, :3, 3] = centers
    return {first + i: pose for i, pose in enumerate(found)}


def trajectory(centers: np.ndarray, first: int = 0, map_id: int = 0, whole: bool = True):
    """Every fifth pose is a keyframe's."""
    return in_order(map_id, list(range(first, first + len(centers))), centers, np.arange(len(centers)) % 5 == 0, whole)


def test_se3_keeps_the_map_s_scale_and_is_left_out_where_that_is_not_known():
    source, target = case(3, 30)
    scale = fit_similarity(source, target).scale
    found = align_trajectory(trajectory(source), poses(target), 1.2 * scale)
    by_hand = np.linalg.norm(horn(1.2 * scale * source, target, False) - target, axis=1)
    np.testing.assert_allclose(found.ate_se3, by_hand, atol=1e-9)
    assert found.summary().rms_ate_se3_mm > found.summary().rms_ate_mm
    assert align_trajectory(trajectory(source), poses(target)).summary().rms_ate_se3_mm is None


def test_a_single_jump_is_one_wrong_step_and_noise_of_every_pose_is_every_step_s():
    target = case(3, 30)[1]
    shaken = target + np.where(np.arange(30)[:, None] % 2, (0.0, 0.0, 0.2), 0.0)
    jumped = target + np.where(np.arange(30)[:, None] >= 15, (0.0, 0.0, 0.2), 0.0)
    sums = []
    for source in (shaken, jumped):
        found = align_trajectory(trajectory(source), poses(target))
        moved = found.true_from_map.apply(source)
        by_hand = [np.linalg.norm((moved[i + 1] - moved[i]) - (target[i + 1] - target[i])) for i in range(29)]
        np.testing.assert_allclose(found.rpe, by_hand, atol=1e-12)
        sums.append(trajectory_summary([found], [trajectory(source)], list(range(30))).rms_rpe_mm)
    assert sums[0] == pytest.approx(0.2, rel=0.1) and sums[1] < 0.5 * sums[0]


def test_submaps_are_averaged_as_climb_does_and_pooled_over_their_poses():
    parts = [case(seed, n) for seed, n in ((0, 120), (1, 300), (2, 40))]
    true, trajectories, first = {}, [], 0
    for i, (source, target) in enumerate(parts):
        true |= poses(target, first)
        trajectories.append(trajectory(source, first, i))
        first += len(source)
    aligned = [align_trajectory(t, true) for t in trajectories]
    found = trajectory_summary(aligned, trajectories, range(600))
    squares = [((horn(s, t, True) - t) ** 2).sum(1) for s, t in parts]
    a, b = (np.sqrt(s.mean()) for s in squares[:2])
    assert CLIMB_POSES == 100 and found.climb_submaps == 2
    assert found.climb_ate_mm == pytest.approx((120 * a + 300 * b) / 420, rel=1e-9)
    assert found.rms_ate_mm == pytest.approx(np.sqrt(np.concatenate(squares).mean()), rel=1e-9)
    assert (found.frames_localised, found.localised_share) == (460, 460 / 600)
    assert found.keyframes == 24 + 60 + 8 and found.submaps == 3
    few = trajectory_summary(aligned[2:], trajectories[2:], range(600))
    assert few.climb_ate_mm is None and few.climb_submaps == 0


def test_climb_counts_a_submap_from_a_hundred_poses_on():
    source, target = case(0, 100)
    for poses_of_it, counted in ((100, 1), (99, 0)):
        whole = trajectory(source[:poses_of_it])
        found = trajectory_summary([align_trajectory(whole, poses(target))], [whole], range(100))
        assert found.climb_submaps == counted
        assert found.climb_ate_mm == (pytest.approx(found.rms_ate_mm) if counted else None)


def test_a_frame_in_two_submaps_is_localised_once_and_keyframes_alone_tell_no_share():
    source, target = case(0, 20)
    twice = [trajectory(source, map_id=0), trajectory(source, map_id=1)]
    aligned = [align_trajectory(t, poses(target)) for t in twice]
    assert trajectory_summary(aligned, twice, range(40)).localised_share == 0.5
    alone = [trajectory(source, whole=False)]
    found = trajectory_summary(aligned[:1], alone, range(40))
    assert found.localised_share is None and found.localised_of == ("not known: the trajectory holds keyframes alone")


def test_what_cannot_be_aligned_is_refused_by_name():
    source, target = case(0, 10)
    line = np.outer(np.arange(10), (1.0, 2, 3))
    wrong = {
        "poses … 2 in common … at least 3": (source[:2], target),
        "map camera centres … lie on a line": (line, target),
        "true camera centres … lie on a line": (source, line),
        "or in one place": (np.ones((10, 3)), target),
    }
    for message, (centers, true) in wrong.items():
        with refused(message):
            align_trajectory(trajectory(centers), poses(true))
    with refused(found="truth has frames 50 to 59, the map frames 0 to 9"):
        align_trajectory(trajectory(source), poses(target, 50))
    with refused(where="map 3", found="frame 7 is in its trajectory twice"):
        in_order(3, [5, 7, 7, 9], np.zeros((4, 3)))


def test_across_a_straight_line_only_noise_is_left_and_the_agreement_says_so():
    rng = np.random.default_rng(0)
    line = np.linspace(0, 60, 30)[:, None] * (1, 0, 0)
    true, found = (line + 0.1 * rng.normal(size=(30, 3)) for _ in range(2))
    similarity = fit_similarity(found, true)
    assert rms_ate(found, true, similarity) < 0.3  # looks splendid
    assert sideways_agreement(found, true, similarity) < 0.5
    bent = line + np.sin(np.linspace(0, 3, 30))[:, None] * (0, 2, 0)
    true, found = (bent + 0.1 * rng.normal(size=(30, 3)) for _ in range(2))
    assert sideways_agreement(found, true, fit_similarity(found, true)) > 0.95


def test_a_tum_file_is_read_by_frame_number_or_by_the_rate_beside_it(tmp_path):
    source, _ = case(0, 6)
    file = tmp_path / "CameraTrajectory.txt"
    write_tum(file, [float(n) for n in (4, 2, 0, 6, 8, 10)], poses(source).values())
    (found,) = read_trajectories(file)
    assert found.numbers.tolist() == [0, 2, 4, 6, 8, 10] and found.whole and found.keyframe.all()
    np.testing.assert_allclose(found.centers[2], source[0], atol=1e-8)
    write_tum(file, np.arange(6) / 30, poses(source).values())
    with refused(found="is not a frame number"):
        read_trajectories(file)
    (tmp_path / "densify_map.json").write_text(json.dumps({"fps": 30, "frame_offset": 100}))
    assert read_trajectories(file)[0].numbers.tolist() == [100, 101, 102, 103, 104, 105]
    keyframes = file.rename(tmp_path / "KeyFrameTrajectory.txt")
    assert not read_trajectories(keyframes)[0].whole


def test_a_multi_map_tree_brings_every_localised_frame(tmp_path):
    frames = colon(0).frames
    export = slam(frames, maps=2, keyframe_every=2)
    by_map = {
        s.id: {f.name: np.linalg.inv(f.true_world_from_cam) for f in part}
        for s, part in zip(export.map.submaps, (frames[:6], frames[4:9]), strict=True)
    }
    write_multimap(export.map, tmp_path, by_map)
    assert len(trajectory_files(tmp_path)) == 2
    found = read_trajectories(tmp_path)
    (tmp_path / "3D_maps" / "1" / "densify_map.json").write_text(json.dumps({"frame_offset": -1}))
    assert read_trajectories(tmp_path)[1].numbers.tolist() == (found[1].numbers - 1).tolist()
    # The map's own keyframes are among them, with the map's poses; frames in between have the poses given.
    assert [t.id for t in found] == [0, 1] and all(t.whole for t in found)
    assert found[0].keyframe.sum() == len(export.map.submaps[0].keyframes) < len(found[0].numbers)
    true = {f.number: f.true_world_from_cam[:3, 3] for f in frames}
    between = ~found[0].keyframe
    np.testing.assert_allclose(
        found[0].centers[between], [true[n] for n in found[0].numbers[between].tolist()], atol=1e-6
    )
    summary = trajectory_summary(
        [align_trajectory(t, {f.number: f.true_world_from_cam for f in frames}) for t in found], found, range(10)
    )
    assert summary.frames_localised == len({*found[0].numbers.tolist(), *found[1].numbers.tolist()})


def test_a_file_that_is_no_trajectory_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("hello\n")
    for path in (tmp_path, tmp_path / "notes.txt", tmp_path / "nowhere"):
        with refused(found="no trajectory"):
            read_trajectories(path)
    empty = tmp_path / "cam_traj_map_002.txt"
    empty.write_text("# timestamp, name_image\n")
    with refused(where="cam_traj_map_002.txt", found="no pose in it"):
        read_trajectories(empty)


def test_trajectories_are_born_valid():
    with pytest.raises(AssertionError, match="ascend"):
        Trajectory(0, np.array([3, 1]), np.zeros((2, 3)), np.ones(2, bool), True)


@pytest.mark.parametrize(
    ("numbers", "said"), [([], "none"), ([4], "frame 4"), ([5, 4], "frames 4 to 5"), ([9, 3, 4], "frames 3 to 9")]
)
def test_numbers_are_said_as_people_say_them(numbers, said):
    assert span(numbers) == span(np.array(numbers, int)) == said
