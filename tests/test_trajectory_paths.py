"""Where trajectories are looked for, what their poses are counted by, and what is said of them together."""

from __future__ import annotations

import msgpack
import numpy as np
from raising import refused
from test_trajectory import case, poses, trajectory

from densify.evaluation.trajectory import (
    align_trajectory,
    in_order,
    keyframe_trajectory,
    read_trajectories,
    trajectory_files,
    trajectory_summary,
)
from lightdepth.camera import Pinhole
from lightdepth.files.tum import write_tum
from lightdepth.sparse_map import Keyframe, Submap


def test_a_trajectory_is_a_file_or_lies_in_a_folder_or_in_one_below(tmp_path):
    source, _ = case(0, 4)
    assert trajectory_files(tmp_path / "nowhere") == [] and trajectory_files(tmp_path) == []
    notes = tmp_path / "notes.txt"
    notes.write_text("hello\n")
    assert trajectory_files(notes) == []
    file = tmp_path / "any.txt"
    write_tum(file, [0.0, 1.0, 2.0, 3.0], poses(source).values())
    assert trajectory_files(file) == [file] and trajectory_files(tmp_path) == []
    below = tmp_path / "trajectories"
    names = [below / f"cam_traj_map_{i:03d}.txt" for i in (1, 0)]
    below.mkdir()
    for name in (*names, below / "other.txt"):
        name.write_text("")
    assert trajectory_files(below) == sorted(names)
    assert trajectory_files(tmp_path) in ([], sorted(names))
    assert trajectory_files(names[0]) == [names[0]]


def test_a_tum_file_is_one_map_whose_name_says_whether_it_is_keyframes_alone(tmp_path):
    source, _ = case(1, 5)
    for name, whole in (("frames.txt", True), ("MyKeyFrames.txt", False)):
        write_tum(tmp_path / name, [3.0, 1.0, 7.0, 5.0, 9.0], poses(source).values())
        (found,) = read_trajectories(tmp_path / name)
        assert (found.id, found.whole, found.keyframe.tolist()) == (0, whole, [True] * 5)
        assert found.numbers.tolist() == [1, 3, 5, 7, 9]
        np.testing.assert_allclose(found.centers, source[[1, 0, 3, 2, 4]], atol=1e-6)


def test_seconds_are_counted_by_the_rate_of_the_one_stella_map_beside_the_trajectory(tmp_path):
    source, _ = case(1, 5)
    write_tum(tmp_path / "frames.txt", np.array([3.0, 1.0, 7.0, 5.0, 9.0]) / 25, poses(source).values())
    (tmp_path / "map.msg").write_bytes(msgpack.packb({"cameras": {"a": {"fps": 25.0}}}))
    assert read_trajectories(tmp_path / "frames.txt")[0].numbers.tolist() == [1, 3, 5, 7, 9]
    (tmp_path / "map_2.msg").write_bytes(msgpack.packb({"cameras": {"a": {"fps": 30.0}}}))
    with refused(where="frames.txt", found="is not a frame number"):
        read_trajectories(tmp_path / "frames.txt")


def test_poses_are_put_in_order_with_their_centres_and_marks():
    centers = np.arange(9.0).reshape(3, 3)
    found = in_order(4, [8, 2, 5], centers, [True, False, True], whole=True)
    assert (found.id, found.numbers.tolist(), found.keyframe.tolist()) == (4, [2, 5, 8], [False, True, True])
    assert found.centers.tolist() == centers[[1, 2, 0]].tolist() and found.whole
    plain = in_order(0, [1], centers[:1])
    assert plain.keyframe.tolist() == [True] and not plain.whole


def test_keyframes_of_a_map_were_where_their_poses_say():
    camera, keyframes = Pinhole(10, 10, 5.0, 5.0, 5.0, 5.0), []
    for number, center in ((7, (1.0, 2.0, 3.0)), (3, (4.0, 5.0, 6.0))):
        pose = np.eye(4)
        pose[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
        pose[:3, 3] = -pose[:3, :3] @ center
        keyframes.append(Keyframe(f"{number:06d}.png", camera, pose, np.zeros((1, 2)), np.zeros(1, int)))
    found = keyframe_trajectory(Submap(2, tuple(keyframes), np.zeros(1, int), np.ones((1, 3))))
    assert (found.id, found.numbers.tolist(), found.whole) == (2, [3, 7], False)
    np.testing.assert_allclose(found.centers, [(4, 5, 6), (1, 2, 3)], atol=1e-12)


def test_a_summary_counts_frames_keyframes_submaps_and_poses():
    source, target = case(2, 12)
    first, second = trajectory(source[:8], map_id=0), in_order(1, range(4, 12), source[4:], [True, False] * 4, True)
    aligned = [align_trajectory(first, poses(target), 1.0), align_trajectory(second, poses(target))]
    found = trajectory_summary(aligned, [first, second], range(2, 22))
    assert (found.frames, found.frames_localised, found.localised_share) == (20, 10, 0.5)
    assert (found.submaps, found.submaps_aligned, found.poses, found.localised_of) == (2, 2, 16, "all frames")
    every = np.concatenate([a.ate_sim3 for a in aligned])
    assert np.isclose(found.rms_ate_mm, np.sqrt((every**2).mean()))
    assert np.isclose(found.rms_ate_se3_mm, np.sqrt((aligned[0].ate_se3 ** 2).mean())) and aligned[1].ate_se3 is None
    assert found.climb_submaps == 0 and found.climb_ate_mm is None and "100 poses" in found.climb_rule
    alone = trajectory_summary(aligned[:1], [first], range(12))
    one = aligned[0].summary()
    assert (one.poses, one.sideways_agreement) == (8, aligned[0].sideways) and one.mm_per_unit > 0
    assert one.rms_ate_mm == alone.rms_ate_mm and one.rms_ate_se3_mm == alone.rms_ate_se3_mm
    assert aligned[1].summary().rms_ate_se3_mm is None
