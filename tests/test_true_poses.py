"""True poses meet the frames that they are of, and those that cannot be used stop nothing that needs no truth."""

from __future__ import annotations

import numpy as np
import pytest
from colons import colon
from raising import refused
from test_datasets import LENS

from lightdepth.datasets import open_sequence, write_c3vd, write_folder
from lightdepth.datasets.simcol import write_simcol
from lightdepth.files.tum import write_tum


def kept_frames(tmp_path, rows, stamps) -> list:
    """The true poses as they are read of a folder that keeps some of its frames, and all the poses, at `stamps`."""
    frames = colon(0).frames
    folder = tmp_path / "seq"
    write_folder([frames[r] for r in rows], folder)
    write_tum(folder / "truth" / "poses.tum", stamps, [f.true_world_from_cam for f in frames])
    return [frame.true_world_from_cam for frame in open_sequence(folder)]


@pytest.mark.parametrize("step", [1, 1 / 30], ids=["by number", "counted evenly"])
def test_of_more_poses_than_frames_each_frame_has_the_one_of_its_number(tmp_path, step):
    count, rows = len(colon(0).frames), (0, 2, 3)
    found = kept_frames(tmp_path, rows, [step * k for k in range(count)])
    np.testing.assert_allclose(found, [colon(0).frames[r].true_world_from_cam for r in rows], atol=1e-6)


def test_of_more_poses_than_frames_each_frame_has_the_one_of_its_time_and_none_where_there_is_none(tmp_path):
    frames, rows = colon(0).frames, (1, 4, 5)
    write_folder([frames[r] for r in rows], tmp_path / "seq")
    times = [100 + 0.04 * k for k in range(len(frames))]
    write_tum(tmp_path / "seq" / "truth" / "poses.tum", times, [f.true_world_from_cam for f in frames])
    lines = [f"{frames[r].name},{times[r] + 0.003}\n" for r in rows[:2]] + [f"{frames[5].name},200\n"]
    (tmp_path / "seq" / "times.csv").write_text("".join(["name,seconds\n", *lines]), encoding="utf-8")
    first, second, last = (frame.true_world_from_cam for frame in open_sequence(tmp_path / "seq"))
    np.testing.assert_allclose([first, second], [frames[r].true_world_from_cam for r in rows[:2]], atol=1e-6)
    assert last is None


def test_poses_of_nobody_knows_which_frames_are_refused_where_truth_is_asked_for_and_nowhere_else(tmp_path):
    write_folder(colon(0).frames[:3], tmp_path / "seq")
    poses = [frame.true_world_from_cam for frame in colon(0).frames[:5]]
    write_tum(tmp_path / "seq" / "truth" / "poses.tum", [0.0, 0.1, 0.5, 0.6, 1.7], poses)
    read = open_sequence(tmp_path / "seq")
    with refused(where="poses.tum", found="5 poses for 3 frames"):
        read.first()
    blind = list(read.without_truth())
    assert len(blind) == 3 and all(frame.true_world_from_cam is None for frame in blind)


@pytest.mark.parametrize(
    ("write", "file", "found"),
    [
        (write_c3vd, "pose.txt", "2 poses, but there is a frame 2"),
        (write_simcol, "SavedPosition_S1.txt", "2 lines, but SavedRotationQuaternion_S1.txt has 3"),
    ],
)
def test_poses_that_cannot_be_read_stop_nothing_that_needs_no_truth(tmp_path, write, file, found, capfd):
    folder = tmp_path / "Frames_S1"
    write(colon(0, 3, 6.0, LENS).frames if write is write_c3vd else colon(0).frames[:3], folder)
    (bad,) = tmp_path.rglob(file)
    bad.write_text("\n".join(bad.read_text(encoding="utf-8").splitlines()[:2]) + "\n", encoding="utf-8")
    read = open_sequence(folder)
    with refused(where=file, found=found):
        list(read)
    assert len(list(read.without_truth())) == 3
