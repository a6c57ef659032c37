"""Published data sets with truth: a tree as its authors ship it is read back to the step of its depth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon
from raising import refused

from lightdepth.calibration import write_camera
from lightdepth.camera import CameraModel
from lightdepth.cli import main
from lightdepth.datasets import (
    open_sequence,
    read_c3vd,
    read_hamlyn,
    read_simcol,
    write_c3vd,
    write_folder,
    write_hamlyn,
    write_simcol,
)
from lightdepth.datasets.c3vd import C3VD, C3VD_UNDISTORTED, C3VD_V2
from lightdepth.frame import Frame
from lightdepth.tube import lens, render_sequence

C3VD_LENSES = {"v1 sorted": C3VD.resized(100, 80), "v2": C3VD_V2.resized(100, 80)}


def check_against_truth(read, given, step_mm: float, pose_mm: float = 1e-6) -> None:
    """Frames, poses and camera are equal; depth along the axis is within `step_mm`, wherever the file can hold it."""
    assert len(read) == len(given)
    for found, frame in zip(read, given, strict=True):
        assert found.number == frame.number and found.camera == frame.camera
        assert np.abs(found.image - frame.image).max() < 1e-6
        np.testing.assert_allclose(found.true_world_from_cam, frame.true_world_from_cam, atol=pose_mm)
        check_depth(found, frame, step_mm)


def check_depth(found, frame, step_mm: float) -> None:
    known = (found.true_distance > 0) & (frame.true_distance > 0)
    assert known.sum() > 0.9 * frame.valid.sum() and found.true_distance.dtype == np.float32
    off = (frame.true_distance - found.true_distance) * frame.camera.rays()[0][..., 2]
    assert np.abs(off[known]).max() < step_mm * 1.1 + 1e-4


@pytest.mark.parametrize("tree", C3VD_LENSES)
def test_the_other_trees_of_c3vd_are_found_by_looking_and_read_with_their_own_camera(tree, tmp_path):
    given = colon(0, 3, 6.0, C3VD_LENSES[tree]).frames
    write_c3vd(given, tmp_path / "seq", tree)
    read = open_sequence(tmp_path / "seq")
    assert read.names[1] == ("0001" if tree == "v2" else "0001_color")
    check_against_truth(read, given, 100 / 65535)
    assert open_sequence(tmp_path / "seq", "c3vd")[0].light.assumed


def test_the_files_of_c3vd_s_second_edition_are_named_and_coded_as_they_are_shipped(tmp_path):
    (frame,) = colon(0, 1, 6.0, C3VD_LENSES["v2"]).frames
    far = np.where(frame.valid, 900, 0).astype(np.float32)
    write_c3vd([replace(frame, true_distance=far)], tmp_path / "seq", "v2")
    files = sorted(p.relative_to(tmp_path / "seq").as_posix() for p in (tmp_path / "seq").rglob("*.*"))
    assert files == ["depth/0000_depth.tiff", "pose.txt", "rgb/0000.png"]
    code = cv2.imread(str(tmp_path / "seq" / "depth" / "0000_depth.tiff"), cv2.IMREAD_UNCHANGED)
    assert code.dtype == np.uint16 and set(np.unique(code)) == {0, 65535}
    assert not open_sequence(tmp_path / "seq")[0].true_distance.any()  # no data, or clipped at 100 mm


def test_a_deformation_of_c3vd_has_poses_and_no_depth(tmp_path):
    frames = [replace(f, true_distance=None) for f in colon(0, 3, 6.0, C3VD_LENSES["v2"]).frames]
    write_c3vd(frames, tmp_path / "seq", "v2")
    read = open_sequence(tmp_path / "seq")
    assert all(f.true_distance is None and f.true_world_from_cam is not None for f in read)


def test_images_in_rgb_alone_are_not_taken_for_c3vd(tmp_path):
    (tmp_path / "rgb").mkdir()
    cv2.imwrite(str(tmp_path / "rgb" / "0000.png"), np.zeros((80, 100, 3), np.uint8))
    with refused(found="no images with a number"):
        open_sequence(tmp_path)
    with refused(found="no rgb/NNNN.png beside depth/ or pose.txt"):
        open_sequence(tmp_path, "c3vd")


def spoil_v2(folder: Path, how: str) -> None:
    if how == "eight bits":
        cv2.imwrite(str(folder / "depth" / "0001_depth.tiff"), np.zeros((80, 100), np.uint8))
    elif how == "depth of another size":
        cv2.imwrite(str(folder / "depth" / "0001_depth.tiff"), np.zeros((40, 50), np.uint16))
    elif how == "cropped":
        for file in (folder / "rgb").iterdir():
            cv2.imwrite(str(file), cv2.imread(str(file))[:, :80])
    elif how == "another size":
        cv2.imwrite(str(folder / "rgb" / "0001.png"), np.zeros((40, 50, 3), np.uint8))
    elif how == "number twice":
        (folder / "rgb" / "1.png").write_bytes((folder / "rgb" / "0001.png").read_bytes())
    elif how == "a pose too few":
        lines = (folder / "pose.txt").read_text().splitlines()
        (folder / "pose.txt").write_text("\n".join(lines[:2]) + "\n")


SPOILED_V2 = {
    "eight bits": "0001_depth.tiff … uint8 … one channel of 16 bits",
    "depth of another size": "0001_depth.tiff … depth is 50x40, the image 100x80",
    "cropped": "seq … images are 80x80 … C3VD's camera is for 1350x1080 … --camera FILE",
    "another size": "0001.png … is 50x40, but 0000.png is 100x80",
    "number twice": "rgb … 0001.png and 1.png have the same number",
    "a pose too few": "pose.txt … 2 poses, but there is a frame 2",
}


@pytest.mark.parametrize("how", SPOILED_V2)
def test_a_second_edition_with_something_wrong_is_refused_with_what_and_where(how, tmp_path):
    write_c3vd(colon(0, 3, 6.0, C3VD_LENSES["v2"]).frames, tmp_path / "seq", "v2")
    spoil_v2(tmp_path / "seq", how)
    with refused(SPOILED_V2[how]):
        list(read_c3vd(tmp_path / "seq"))


def undistorted_tree(root: Path, tree: str) -> tuple[list[Frame], CameraModel]:
    """A tree of frames as EndoGSLAM's scripts leave it: a pinhole that fills its image, and depth of 8 bits."""
    camera = C3VD_UNDISTORTED.resized(100, 80)
    frames = [replace(f, mask=None) for f in render_sequence(3, 3, camera, 6.0, mask=np.ones((80, 100), bool)).frames]
    write_c3vd(frames, root, tree)
    for file in root.rglob("*_depth.tiff"):
        code = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), (code / 65535 * 255).astype(np.uint8))
    return frames, camera


@pytest.mark.filterwarnings("ignore:.*cannot be read")
def test_endogslam_s_undistorted_tree_is_told_by_its_corners_and_gets_its_pinhole(tmp_path):
    given, camera = undistorted_tree(tmp_path / "seq", "v1 sorted")
    with pytest.warns(UserWarning, match="images look undistorted or cropped; sorted into .* fx 802.319"):
        read = open_sequence(tmp_path / "seq")
    assert read.without_truth()[0].camera == camera
    assert np.abs(read.without_truth()[0].image - given[0].image).max() < 1e-6
    own = tmp_path / "camera.json"
    write_camera(given[0].camera.resized(100, 80), own)
    assert open_sequence(tmp_path / "seq", camera=own).without_truth()[1].camera == camera


@pytest.mark.parametrize("tree", ["v1", "v2"])
def test_other_undistorted_trees_of_c3vd_are_refused_with_that_word(tmp_path, tree, capsys):
    undistorted_tree(tmp_path / "seq", tree)
    assert main(["predict", str(tmp_path / "seq"), "-o", str(tmp_path / "out"), "--checkpoint", "decline"]) == 3
    assert "undistorted" in capsys.readouterr().err


@pytest.mark.parametrize("how", ["eight bits", "eight bits in sixteen"])
def test_depth_of_eight_bits_stops_no_prediction_and_judges_none(tmp_path, how, capsys):
    write_c3vd(colon(0, 3, 6.0, C3VD_LENSES["v1 sorted"]).frames, tmp_path / "seq", "v1 sorted")
    for file in (tmp_path / "seq").rglob("*_depth.tiff"):
        code = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / 65535 * 255
        cv2.imwrite(str(file), code.astype(np.uint8 if how == "eight bits" else np.uint16))
    out = tmp_path / "out"
    assert main(["predict", str(tmp_path / "seq"), "-o", str(out), "--checkpoint", "decline"]) == 0
    assert len(list(out.glob("*.npz"))) == 3
    assert any("cannot be read" in said for said in json.loads((out / "run.json").read_text())["warnings"])
    capsys.readouterr()
    assert main(["evaluate", str(out), "--truth", str(tmp_path / "seq")]) == 3
    said = " ".join(capsys.readouterr().err.split())
    assert "depth" in said and ("16 bits" in said or "8 bits kept in 16" in said)


@pytest.fixture
def simcol(tmp_path) -> Path:
    """Three frames of a pinhole, as a trajectory of SimCol3D."""
    write_simcol(colon(0).frames[:3], tmp_path / "SyntheticColon_I" / "Frames_S1")
    return tmp_path / "SyntheticColon_I" / "Frames_S1"


def test_a_trajectory_of_simcol_is_found_by_looking_and_read_back_to_the_depth_s_step(simcol):
    read = open_sequence(simcol)
    assert read.names == ["FrameBuffer_0000", "FrameBuffer_0001", "FrameBuffer_0002"]
    check_against_truth(read, colon(0).frames[:3], 200 / 255 / 2, pose_mm=1e-9)
    assert read[0].light.source == "assumed"
    assert read_simcol(simcol).names == read.names


def test_the_files_of_simcol_are_named_and_coded_as_they_are_shipped(simcol):
    above = sorted(p.name for p in simcol.parent.iterdir() if p.is_file())
    assert above == ["SavedPosition_S1.txt", "SavedRotationQuaternion_S1.txt", "cam.txt"]
    image = cv2.imread(str(simcol / "FrameBuffer_0000.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16 and image.shape == (80, 96, 4) and (image[..., 3] == 65535).all()
    code = cv2.imread(str(simcol / "Depth_0000.png"), cv2.IMREAD_UNCHANGED)
    assert code.dtype == np.uint16 and not (code % 256).any() and code.max() <= 65280
    matrix = np.array((simcol.parent / "cam.txt").read_text().split(), float).reshape(3, 3)
    np.testing.assert_array_equal(matrix, CAMERA.matrix)


def test_unity_s_left_handed_poses_are_turned_into_ours(simcol):
    """Unity has y up, ours points down: a turn to the right stays one, up is against our y, centimetres become mm."""
    half = np.sqrt(0.5)
    (simcol.parent / "SavedPosition_S1.txt").write_text("0 0 0\n1 2 3\n0 0 0\n")
    (simcol.parent / "SavedRotationQuaternion_S1.txt").write_text(f"0 0 0 1\n0 {half} 0 {half}\n{half} 0 0 {half}\n")
    still, turned, nodding = (f.true_world_from_cam for f in read_simcol(simcol))
    np.testing.assert_array_equal(still, np.eye(4))
    np.testing.assert_allclose(turned[:3, 3], [10, -20, 30])
    np.testing.assert_allclose(turned[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-9)  # Unity: forward turns to the right
    np.testing.assert_allclose(nodding[:3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-9)  # Unity: and then down
    assert np.linalg.det(turned[:3, :3]) == pytest.approx(1)


def test_depth_of_nothing_and_depth_beyond_200_mm_are_both_unknown(simcol):
    code = np.zeros((80, 96), np.uint16)
    code[:, 40:], code[:, 80:] = 128 * 256, 255 * 256
    cv2.imwrite(str(simcol / "Depth_0001.png"), code)
    distance = open_sequence(simcol)[1].true_distance
    assert not distance[:, :40].any() and not distance[:, 80:].any()
    np.testing.assert_allclose((distance * CAMERA.rays()[0][..., 2])[:, 40:80], 128 / 255 * 200, rtol=1e-6)


def test_simcol_frames_without_truth_or_camera_are_read_with_the_map_s(simcol):
    for file in (*simcol.glob("Depth_*"), *simcol.parent.glob("*.txt")):
        file.unlink()
    (first, *_) = open_sequence(simcol, map_camera=CAMERA.resized(48, 40))
    assert first.camera == CAMERA and first.true_distance is None and first.true_world_from_cam is None
    with refused(where="Frames_S1", found="no cam.txt here or in the folder above", cure="--camera FILE"):
        open_sequence(simcol)


def test_what_simcol_cannot_hold_is_not_written(tmp_path):
    with refused(found="not numbered 0, 1, 2"):
        write_simcol(colon(0).frames[1:3], tmp_path / "Frames_S1")
    with refused(found="SCARAMUZZA camera"):
        write_simcol(colon(0, 3, 6.0, lens("c3vd", 100, 80)).frames, tmp_path / "Frames_S1")


def spoil_simcol(folder: Path, how: str) -> None:
    position = folder.parent / "SavedPosition_S1.txt"
    rotation = folder.parent / "SavedRotationQuaternion_S1.txt"
    if how == "eight bits":
        cv2.imwrite(str(folder / "Depth_0001.png"), np.zeros((80, 96), np.uint8))
    elif how == "depth of another size":
        cv2.imwrite(str(folder / "Depth_0001.png"), np.zeros((40, 48), np.uint16))
    elif how == "truncated":
        file = folder / "FrameBuffer_0001.png"
        file.write_bytes(file.read_bytes()[:200])
    elif how == "no rotations":
        rotation.unlink()
    elif how == "a pose too few":
        for file in (position, rotation):
            file.write_text("\n".join(file.read_text().splitlines()[:2]) + "\n")
    elif how == "a rotation too few":
        rotation.write_text("\n".join(rotation.read_text().splitlines()[:2]) + "\n")
    elif how == "exchanged":
        text = position.read_text()
        position.write_text(rotation.read_text())
        rotation.write_text(text)
    elif how == "words":
        position.write_text("x y z\n")
    elif how == "zero quaternion":
        rotation.write_text("0 0 0 1\n0 0 0 0\n0 0 0 1\n")
    elif how == "NaN":
        position.write_text("0 0 0\n0 nan 0\n0 0 0\n")
    elif how == "camera of words":
        (folder.parent / "cam.txt").write_text("227.6 0 a b 237.5 0 0 0 1\n")


SPOILED_SIMCOL = {
    "eight bits": "Depth_0001.png … uint8 … one channel of 16 bits",
    "depth of another size": "Depth_0001.png … depth is 48x40, the image 96x80",
    "truncated": "FrameBuffer_0001.png … not a readable image",
    "no rotations": "SavedPosition_S1.txt … there is no SavedRotationQuaternion_S1.txt beside it",
    "a pose too few": "SavedPosition_S1.txt … 2 poses, but there is a frame 2",
    "a rotation too few": "SavedPosition_S1.txt … 3 lines, but SavedRotationQuaternion_S1.txt has 2",
    "exchanged": "SavedPosition_S1.txt … 4 numbers a line … expected `x y z`",
    "words": "SavedPosition_S1.txt … not lines of … `x y z`",
    "zero quaternion": "SavedRotationQuaternion_S1.txt … line 2: the quaternion's length is 0 … expected 1",
    "NaN": "SavedPosition_S1.txt … line 2 has NaN",
    "camera of words": "cam.txt … 'a', which is not a number",
}


@pytest.mark.parametrize("how", SPOILED_SIMCOL)
def test_a_trajectory_of_simcol_with_something_wrong_is_refused_with_what_and_where(simcol, how, capfd):
    spoil_simcol(simcol, how)
    with refused(SPOILED_SIMCOL[how]):
        list(open_sequence(simcol))


@pytest.fixture
def hamlyn(tmp_path) -> Path:
    """Three frames of a pinhole, as a rectified sequence of Hamlyn."""
    write_hamlyn(colon(0).frames[:3], tmp_path / "rectified01")
    return tmp_path / "rectified01"


def test_a_rectified_sequence_of_hamlyn_is_found_by_looking_and_read_back_to_the_millimetre(hamlyn):
    read = open_sequence(hamlyn)
    assert read.names == ["0000000000", "0000000001", "0000000002"]
    for found, frame in zip(read, colon(0).frames[:3], strict=True):
        assert found.camera == frame.camera and found.true_world_from_cam is None
        assert np.abs(found.image - frame.image).mean() < 0.02  # JPEG
        check_depth(found, frame, 0.5)
    code = cv2.imread(str(hamlyn / "depth01" / "0000000000.png"), cv2.IMREAD_UNCHANGED)
    assert code.dtype == np.uint16
    depth = read[0].true_distance * CAMERA.rays()[0][..., 2]
    np.testing.assert_allclose(depth, code, rtol=1e-5)  # 0 stays 0: nothing was matched there


def test_what_a_network_predicted_for_hamlyn_s_tracking_set_is_no_truth(tmp_path):
    write_hamlyn(colon(0).frames[:2], tmp_path / "seq", "tracking")
    assert sorted(p.name for p in (tmp_path / "seq").iterdir()) == ["color", "depth", "intrinsics.txt"]
    read = open_sequence(tmp_path / "seq")
    assert read[1].camera == CAMERA and read[1].true_distance is None


def test_hamlyn_frames_are_paired_by_their_number_however_it_is_written(hamlyn):
    before = [f.true_distance for f in read_hamlyn(hamlyn)]
    for i in range(3):
        (hamlyn / "image01" / f"{i:010d}.jpg").rename(hamlyn / "image01" / f"{i}.jpg")
    for distance, frame in zip(before, read_hamlyn(hamlyn), strict=True):
        np.testing.assert_array_equal(frame.true_distance, distance)


def test_hamlyn_without_intrinsics_takes_the_map_s_camera_or_a_matrix_of_four_rows(hamlyn):
    matrix = np.eye(4)
    matrix[:3, :3] = np.loadtxt(hamlyn / "intrinsics.txt")
    np.savetxt(hamlyn / "intrinsics.txt", matrix)
    assert open_sequence(hamlyn)[0].camera == CAMERA
    (hamlyn / "intrinsics.txt").rename(hamlyn / "other.txt")
    assert open_sequence(hamlyn, map_camera=CAMERA.resized(48, 40))[0].camera == CAMERA
    assert open_sequence(hamlyn, camera=hamlyn / "other.txt")[0].camera == CAMERA


def spoil_hamlyn(folder: Path, how: str) -> None:
    if how == "eight bits":
        cv2.imwrite(str(folder / "depth01" / "0000000001.png"), np.zeros((80, 96), np.uint8))
    elif how == "depth of another size":
        cv2.imwrite(str(folder / "depth01" / "0000000001.png"), np.zeros((40, 48), np.uint16))
    elif how == "no intrinsics":
        (folder / "intrinsics.txt").unlink()
    elif how == "number twice":
        (folder / "image01" / "1.jpg").write_bytes((folder / "image01" / "0000000001.jpg").read_bytes())
    elif how == "another size":
        cv2.imwrite(str(folder / "image01" / "0000000001.jpg"), np.zeros((40, 48, 3), np.uint8))


SPOILED_HAMLYN = {
    "eight bits": "0000000001.png … uint8 … Hamlyn's depth is one channel of 16 bits",
    "depth of another size": "0000000001.png … depth is 48x40, the image 96x80",
    "no intrinsics": "rectified01 … no intrinsics.txt … --camera FILE",
    "number twice": "image01 … 0000000001.jpg and 1.jpg have the same number",
    "another size": "0000000001.jpg … is 48x40, but 0000000000.jpg is 96x80",
}


@pytest.mark.parametrize("how", SPOILED_HAMLYN)
def test_a_sequence_of_hamlyn_with_something_wrong_is_refused_with_what_and_where(hamlyn, how):
    spoil_hamlyn(hamlyn, how)
    with refused(SPOILED_HAMLYN[how]):
        list(open_sequence(hamlyn))


def test_a_folder_that_is_no_data_set_is_refused_by_what_was_asked_for(tmp_path):
    with refused(found="neither image01/ and depth01/ nor color/ and depth/"):
        open_sequence(tmp_path, "hamlyn")
    with refused(found="no FrameBuffer_NNNN.png in it"):
        open_sequence(tmp_path, "simcol")


def test_what_all_frames_have_in_common_is_told_by_the_first_that_can_be_read(tmp_path):
    write_folder(colon(0, 4).frames, tmp_path)
    images = sorted((tmp_path / "frames").iterdir())
    images[0].write_bytes(images[0].read_bytes()[:200])
    frames = open_sequence(tmp_path)
    assert frames.first().name == frames.names[1] and frames.image_size() == (CAMERA.width, CAMERA.height)
    with refused("not a readable image"):
        frames[0]
    assert main(["import", str(tmp_path), "-o", str(tmp_path / "imported")]) == 0
    for image in images[1:]:
        image.write_bytes(b"")
    with refused("not a readable image", where=images[0].name):
        open_sequence(tmp_path).first()
