"""EndoSLAM and EndoMapper's simulated sequences: what is surely known is read, and the rest is said or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon
from raising import refused

from lightdepth.datasets import open_sequence, write_endoslam


@pytest.fixture(params=["UnityCam", "simulated"])
def rendered(request, tmp_path) -> Path:
    """Three frames as a renderer's sequence, of either data set."""
    path = tmp_path / request.param / "Colon"
    write_endoslam(colon(0).frames[:3], path, simulated=request.param == "simulated")
    return path


def trajectory(path: Path) -> Path:
    return next(path.rglob("*.csv"))


def test_a_renderer_s_sequence_is_found_by_looking_and_read_back(rendered):
    with pytest.warns(UserWarning, match=r"poses are taken in Unity's axes .* and (metres|decimetres)"):
        read = open_sequence(rendered)
    assert read.names == ["image_0000", "image_0001", "image_0002"]
    for found, given in zip(read, colon(0).frames[:3], strict=True):
        assert np.abs(found.image - given.image).max() < 1e-6 and found.true_distance is None
        assert found.camera.params == pytest.approx(CAMERA.params) and found.light.source == "assumed"
        np.testing.assert_allclose(found.true_world_from_cam, given.true_world_from_cam, atol=1e-9)


def test_files_are_named_as_they_are_shipped(tmp_path):
    write_endoslam(colon(0).frames[:2], tmp_path / "UnityCam" / "Colon")
    write_endoslam(colon(0).frames[:2], tmp_path / "Seq_0", simulated=True)
    files = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.*") if p.is_file()}
    assert files == {
        "UnityCam/Calibration/cam.txt",
        "UnityCam/Colon/Frames/image_0000.png",
        "UnityCam/Colon/Frames/image_0001.png",
        "UnityCam/Colon/Poses/colon_position_rotation.csv",
        "Seq_0/calibration.txt",
        "Seq_0/image_0000.png",
        "Seq_0/image_0001.png",
        "Seq_0/info.txt",
        "Seq_0/trajectory.csv",
    }
    assert (tmp_path / "Seq_0" / "trajectory.csv").read_text().startswith("tX;tY;tZ;rX;rY;rZ;rW;time(s)\n")
    assert len((tmp_path / "UnityCam" / "Calibration" / "cam.txt").read_text().split(",")) == 9


@pytest.mark.filterwarnings("ignore:.*Unity's axes")
def test_depth_of_an_unknown_scale_is_no_truth(rendered):
    (rendered / "Pixelwise Depths").mkdir()
    for i in range(3):
        cv2.imwrite(str(rendered / "Pixelwise Depths" / f"aov_image_{i:04d}.png"), np.full((80, 96, 4), 9, np.uint8))
        (rendered / f"aov_image_{i:04d}.exr").write_bytes(b"v/1\x01")
    read = open_sequence(rendered)
    assert len(read) == 3 and all(f.true_distance is None for f in read)


@pytest.mark.filterwarnings("ignore:.*Unity's axes")
def test_columns_go_by_their_names_and_a_last_line_cut_off_leaves_its_frame_without_a_pose(rendered):
    expected = [f.true_world_from_cam for f in open_sequence(rendered)]
    file = trajectory(rendered)
    between = ";" if ";" in file.read_text() else ","
    rows = [line.split(between) for line in file.read_text().splitlines()]
    file.write_text("\n".join(between.join(row[::-1]) for row in rows) + "\n")
    for pose, frame in zip(expected, open_sequence(rendered), strict=True):
        np.testing.assert_array_equal(frame.true_world_from_cam, pose)
    text = "\n".join(between.join(row) for row in rows)
    file.write_text(text[: -len(between.join(rows[-1])) // 2])
    read = [f.true_world_from_cam for f in open_sequence(rendered)]
    assert read[2] is None and np.array_equal(read[1], expected[1])


def test_poses_whose_columns_nobody_named_are_refused_with_what_to_do(rendered):
    file = trajectory(rendered)
    file.write_text(file.read_text().split("\n", 1)[1])
    with refused(where=".csv", found="the first line is", cure="expected a header that names tX tY tZ"):
        list(open_sequence(rendered))
    file.unlink()
    assert open_sequence(rendered)[0].true_world_from_cam is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a,b,c,d,e,f,g,h", "line 3 … expected numbers"),
        ("1,2,3,0,0,0,0,0", "line 3 … a quaternion of length 0"),
        ("nan,2,3,0,0,0,1,0", "line 3 … NaN"),
    ],
)
def test_poses_that_are_none_are_refused_by_line(rendered, line, message):
    file = trajectory(rendered)
    lines = file.read_text().splitlines()
    lines[2] = line.replace(",", ";" if ";" in lines[0] else ",")
    file.write_text("\n".join(lines) + "\n")
    with refused(message):
        list(open_sequence(rendered))


def test_a_simulated_sequence_that_does_not_say_its_unit_or_camera_is_refused(tmp_path):
    write_endoslam(colon(0).frames[:2], tmp_path, simulated=True)
    (tmp_path / "info.txt").write_text("units: admiral\n")
    with refused(where="info.txt", found="does not say that lengths are in dm"):
        list(open_sequence(tmp_path))
    (tmp_path / "trajectory.csv").unlink()
    (tmp_path / "calibration.txt").write_text("fx: 52\nfy: 52\n")
    with refused(where="calibration.txt", found="cols, rows, cx, cy missing", cure="expected lines such as `fx: 400"):
        open_sequence(tmp_path)
    (tmp_path / "calibration.txt").write_text("fx: wide\n")
    with refused(where="calibration.txt", found="fx is 'wide'"):
        open_sequence(tmp_path)


def test_frames_of_a_real_camera_need_a_camera_given_and_their_robot_s_poses_are_left_alone(tmp_path):
    write_endoslam(colon(0).frames[:3], tmp_path / "Tumor")
    (tmp_path / "Calibration" / "cam.txt").unlink()
    for i, file in enumerate(sorted((tmp_path / "Tumor" / "Frames").iterdir())):
        file.rename(file.with_name(f"frame_{i + 7:06d}.png"))
    with refused(found="MATLAB files (.mat), which are not read", cure="camera.json"):
        open_sequence(tmp_path / "Tumor")
    read = open_sequence(tmp_path / "Tumor", map_camera=CAMERA)
    assert read.numbers == [7, 8, 9] and read[0].camera == CAMERA and read[0].true_world_from_cam is None
    with refused(found="no Frames/ with images in it"):
        open_sequence(tmp_path, "endoslam")


def test_what_endoslam_cannot_hold_is_not_written(tmp_path):
    with refused(found="not numbered 0, 1, 2"):
        write_endoslam(colon(0).frames[1:3], tmp_path)
    from lightdepth.tube import lens

    with refused(found="SCARAMUZZA camera"):
        write_endoslam([replace(colon(0, 3, 6.0, lens("c3vd", 100, 80)).frames[0], name="0")], tmp_path)
