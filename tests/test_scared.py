"""SCARED: stereo video with poses and structured-light truth, as it is shipped, packed or extracted."""

from __future__ import annotations

import io
import json
import tarfile
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon
from raising import refused

from lightdepth.camera import Brown
from lightdepth.camera_conversion import without_k3
from lightdepth.datasets import open_sequence, read_scared, write_scared

BROWN = Brown(96, 80, 52.0, 52.0, 47.0, 41.0, -0.1, 0.02, 1e-3, -5e-4)


@pytest.fixture
def keyframe(tmp_path) -> Path:
    """Five frames of a pinhole as dataset_1/keyframe_2, packed."""
    write_scared(colon(0).frames[:5], tmp_path / "dataset_1" / "keyframe_2")
    return tmp_path / "dataset_1" / "keyframe_2"


@pytest.fixture
def extracted(tmp_path) -> Path:
    write_scared(colon(0).frames[:5], tmp_path / "dataset_1" / "keyframe_2", archives=False)
    return tmp_path / "dataset_1" / "keyframe_2"


def check_against_truth(read, given, camera=CAMERA) -> None:
    """Poses to 1e-6 mm, distances to float32, colours as far as the compressed video holds them."""
    assert len(read) == len(given)
    for i, (found, frame) in enumerate(zip(read, given, strict=True)):
        assert found.number == i and found.time == pytest.approx(i / 25)
        assert type(found.camera) is type(camera) and found.camera.params == pytest.approx(camera.params, abs=1e-9)
        assert np.abs(found.image - frame.image).mean() < 0.03
        np.testing.assert_allclose(found.true_world_from_cam, frame.true_world_from_cam, atol=1e-6)
        known = (found.true_distance > 0) & (frame.true_distance > 0)
        assert known.sum() > 0.95 * frame.valid.sum()
        np.testing.assert_allclose(found.true_distance[known], frame.true_distance[known], rtol=1e-5)


def test_a_keyframe_s_sequence_is_found_by_looking_and_read_back(keyframe):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = open_sequence(keyframe)
    assert read.names == ["000000", "000001", "000002", "000003", "000004"]
    check_against_truth(read, colon(0).frames[:5])
    assert read[0].light.source == "assumed"


def test_what_is_packed_and_what_is_extracted_are_the_same(keyframe, tmp_path):
    write_scared(colon(0).frames[:5], tmp_path / "other", archives=False)
    assert {p.name for p in (keyframe / "data").iterdir()} == {"frame_data.tar.gz", "rgb.mp4", "scene_points.tar.gz"}
    assert {p.name for p in (tmp_path / "other" / "data").iterdir()} == {"frame_data", "rgb.mp4", "scene_points"}
    packed, extracted = open_sequence(keyframe), open_sequence(tmp_path / "other")
    for i in (3, 0, 4, 1):  # in any order: the archive goes back to its start
        np.testing.assert_array_equal(packed[i].true_distance, extracted[i].true_distance)
        np.testing.assert_array_equal(packed[i].image, extracted[i].image)
        np.testing.assert_array_equal(packed[i].true_world_from_cam, extracted[i].true_world_from_cam)


def test_each_frame_of_the_video_is_the_one_asked_for(tmp_path):
    """Forwards, backwards and at random, within and across the groups of pictures, against the frames in order."""
    write_scared(colon(0).frames, tmp_path / "seq", archives=False)
    in_order = [f.image for f in read_scared(tmp_path / "seq")]
    read = read_scared(tmp_path / "seq")
    for i in (7, 2, 9, 0, 5, 5, 3, 8):
        np.testing.assert_array_equal(read[i].image, in_order[i])
    assert min(np.abs(a - b).mean() for a, b in pairwise(in_order)) > 0.005  # they differ: a wrong one would show


def test_files_are_coded_as_they_are_shipped(extracted):
    record = json.loads((extracted / "data" / "frame_data" / "frame_data000002.json").read_text())
    assert set(record["camera-calibration"]) == {"KL", "DL", "KR", "DR", "R", "T"}
    cam_from_world = np.linalg.inv(colon(0).frames[2].true_world_from_cam)
    np.testing.assert_allclose(record["camera-pose"], cam_from_world, atol=1e-9)
    assert record["camera-calibration"]["KL"][0][2] == 46.5  # the first pixel's centre at (0, 0)
    points = cv2.imread(str(extracted / "data" / "scene_points" / "scene_points000002.tiff"), cv2.IMREAD_UNCHANGED)
    assert points.dtype == np.float32 and points.shape == (160, 96, 3) and np.isnan(points[80:]).all()
    frame = colon(0).frames[2]
    depth = frame.true_distance * CAMERA.rays()[0][..., 2]
    np.testing.assert_allclose(points[:80, :, 0][frame.valid], depth[frame.valid], rtol=1e-6)  # cv2 reverses X Y Z


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_missing_points_are_unknown(extracted, missing):
    file = extracted / "data" / "scene_points" / "scene_points000001.tiff"
    points = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    points[30:40, 30:40] = missing
    cv2.imwrite(str(file), points)
    distance = read_scared(extracted)[1].true_distance
    assert not distance[30:40, 30:40].any() and (distance[40:50, 30:40] > 0).all() and np.isfinite(distance).all()


def test_poses_in_metres_or_the_other_way_round_are_found_by_the_truth_and_said(tmp_path):
    write_scared(colon(0).frames, tmp_path / "metres", archives=False, metres=True)
    with pytest.warns(UserWarning, match=r"miss the true distances by 1\d.*read as camera-from-world in metres"):
        read = open_sequence(tmp_path / "metres")
    check_against_truth(read, colon(0).frames)
    write_scared(colon(0).frames, tmp_path / "c2w", archives=False)
    for file in (tmp_path / "c2w" / "data" / "frame_data").iterdir():
        record = json.loads(file.read_text())
        record["camera-pose"] = np.linalg.inv(record["camera-pose"]).tolist()
        file.write_text(json.dumps(record))
    with pytest.warns(UserWarning, match="read as world-from-camera in millimetres"):
        read = open_sequence(tmp_path / "c2w")
    check_against_truth(read, colon(0).frames)


def test_a_keyframe_alone_is_one_frame_with_its_depth_map(keyframe):
    for file in (keyframe / "data").iterdir():
        file.unlink()
    (frame,) = open_sequence(keyframe)
    given = colon(0).frames[0]
    assert frame.name == "keyframe_2" and frame.camera == CAMERA and frame.true_world_from_cam is None
    assert np.abs(frame.image - given.image).max() < 1e-6
    known = given.valid & (given.true_distance > 0)
    np.testing.assert_allclose(frame.true_distance[known], given.true_distance[known], rtol=1e-5)
    assert not frame.true_distance[~known].any()  # NaN in the file
    assert open_sequence(keyframe, "scared").names == ["keyframe_2"]


def test_the_right_view_has_its_own_pose_and_no_points_of_the_left(keyframe):
    """T moves points by -4.2 mm from the left camera to the right: the right camera is 4.2 mm to the right."""
    left, right = read_scared(keyframe), read_scared(keyframe, view="right")
    apart = np.linalg.inv(left[2].true_world_from_cam) @ right[2].true_world_from_cam
    np.testing.assert_allclose(apart[:3, 3], [4.2, 0, 0], atol=1e-9)
    assert not right[2].true_distance.any()
    with refused(where="view", found="'both'"):
        read_scared(keyframe, view="both")


def test_a_distorted_lens_is_kept_and_its_k3_folded_into_the_others_with_what_is_left(tmp_path):
    frames = colon(0, 3, 6.0, BROWN).frames
    write_scared(frames, tmp_path / "seq", archives=False)
    check_against_truth(open_sequence(tmp_path / "seq"), frames, BROWN)
    for k3, message in (
        (0.004, r"k3 = 0\.004 is folded into the other coefficients, off by 0\.\d+ pixels"),
        (2.0, None),
    ):
        for file in (tmp_path / "seq" / "data" / "frame_data").iterdir():
            record = json.loads(file.read_text())
            record["camera-calibration"]["DL"][4] = k3
            file.write_text(json.dumps(record))
        if message is None:
            with refused(found="k3 = 2 cannot be folded into k1, k2, p1, p2:"):
                read_scared(tmp_path / "seq")
        else:
            with pytest.warns(UserWarning, match=message):
                camera = read_scared(tmp_path / "seq")[0].camera
            assert camera.k2 != BROWN.k2 and camera.fx == BROWN.fx


def test_folding_k3_agrees_with_opencv_s_own_projection():
    camera = replace(BROWN, width=1280, height=1024, fx=1035.0, fy=1035.0, cx=640.5, cy=512.5)
    folded, off = without_k3(camera, 0.005)
    u, v = np.meshgrid(np.arange(0.0, 1281, 64), np.arange(0.0, 1025, 64))
    rays = camera.unproject(np.stack([u, v], -1).reshape(-1, 2))[0]
    coefficients = np.array([camera.k1, camera.k2, camera.p1, camera.p2, 0.005])
    expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, coefficients)[0].reshape(-1, 2)
    found, seen = folded.project(rays)
    error = np.linalg.norm(found - expected, axis=1)[seen]
    assert error.max() < 1.05 * off < 0.25  # off: 0.21 pixels, in a corner
    plain = np.linalg.norm(camera.project(rays)[0] - expected, axis=1)[seen]
    assert plain.max() > 5 * error.max()  # what leaving k3 out would cost
    assert without_k3(camera, 0.0)[1] < 1e-9


def test_the_sets_of_known_bad_calibration_and_a_baseline_of_another_unit_are_said(tmp_path):
    write_scared(colon(0).frames[:2], tmp_path / "dataset_4" / "keyframe_1", archives=False)
    with pytest.warns(UserWarning, match="calibration of dataset_4 and dataset_5 is known to be wrong"):
        open_sequence(tmp_path / "dataset_4" / "keyframe_1")
    write_scared(colon(0).frames[:2], tmp_path / "seq", archives=False)
    for baseline, message in (
        (0.0042, "taken as metres"),
        (420.0, r"\|T\| is 420; a stereo endoscope's is about 4 mm"),
    ):
        for file in (tmp_path / "seq" / "data" / "frame_data").iterdir():
            record = json.loads(file.read_text())
            record["camera-calibration"]["T"] = [-baseline, 0, 0]
            file.write_text(json.dumps(record))
        with pytest.warns(UserWarning, match=message):
            read_scared(tmp_path / "seq")


def archive(path: Path, members: dict[str, bytes]) -> None:
    with tarfile.open(path, "w:gz") as tar:
        for name, blob in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(blob)
            tar.addfile(entry, io.BytesIO(blob))


def test_no_name_in_an_archive_leads_anywhere(keyframe, tmp_path):
    """Members are read in memory and by the last part of their names; links and devices are passed over."""
    data = keyframe / "data"
    with tarfile.open(data / "frame_data.tar.gz") as tar:
        blobs = {m.name: tar.extractfile(m).read() for m in tar.getmembers()}
    archive(data / "frame_data.tar.gz", {f"../../{name}": blob for name, blob in blobs.items()})
    before = {p for p in tmp_path.rglob("*")}
    assert len(open_sequence(keyframe)) == 5
    assert {p for p in tmp_path.rglob("*")} == before
    with tarfile.open(data / "scene_points.tar.gz", "w:gz") as tar:
        link = tarfile.TarInfo("scene_points000000.tiff")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(link)
    assert read_scared(keyframe)[0].true_distance is None


def spoil(folder: Path, how: str) -> None:
    data = folder / "data"
    file = data / "frame_data" / "frame_data000001.json"
    record = json.loads(file.read_text())
    if how == "words":
        file.write_text("pose")
    elif how == "no calibration":
        for other in file.parent.iterdir():
            other.write_text(json.dumps({"camera-pose": np.eye(4).tolist()}))
    elif how == "no pose":
        del record["camera-pose"]
        file.write_text(json.dumps(record))
    elif how == "scaled":
        record["camera-pose"] = (2 * np.eye(4)).tolist()
        file.write_text(json.dumps(record))
    elif how == "NaN":
        record["camera-pose"][0][3] = float("nan")
        file.write_text(json.dumps(record))
    elif how == "video cut":
        video = data / "rgb.mp4"
        video.write_bytes(video.read_bytes()[:400])
    elif how == "a frame too few":
        (data / "frame_data" / "frame_data000009.json").write_text(json.dumps(record))
    elif how == "points of another size":
        cv2.imwrite(str(data / "scene_points" / "scene_points000001.tiff"), np.ones((40, 48, 3), np.float32))
    elif how == "points in 8 bits":
        cv2.imwrite(str(data / "scene_points" / "scene_points000001.tiff"), np.ones((160, 96, 3), np.uint8))
    elif how == "points cut":
        points = data / "scene_points" / "scene_points000001.tiff"
        points.write_bytes(points.read_bytes()[:100])
    elif how == "no frame data":
        for other in file.parent.iterdir():
            other.unlink()
    elif how == "archive cut":
        blob = b"".join(other.read_bytes() for other in file.parent.iterdir())
        for other in file.parent.iterdir():
            other.unlink()
        archive(data / "frame_data.tar.gz", {"frame_data000000.json": blob})
        whole = (data / "frame_data.tar.gz").read_bytes()
        (data / "frame_data.tar.gz").write_bytes(whole[: len(whole) // 2])


SPOILED = {
    "words": "frame_data000001.json … not valid JSON",
    "no calibration": "frame_data000000.json … camera-calibration missing",
    "no pose": "frame_data000001.json: camera-pose … missing",
    "scaled": "frame_data000001.json: camera-pose … the pose is not a rotation",
    "NaN": "frame_data000001.json: camera-pose … NaN",
    "video cut": "rgb.mp4 … not a video that can be read",
    "a frame too few": "keyframe_2 … there is frame data 9, but data/rgb.mp4 has 5 frames",
    "points of another size": "scene_points000001.tiff … float32 of shape (40, 48, 3) … expected float32 X Y Z",
    "points in 8 bits": "scene_points000001.tiff … uint8",
    "points cut": "scene_points000001.tiff … not a readable image",
    "no frame data": "neither data/frame_data.tar.gz nor data/frame_data/",
    "archive cut": "frame_data.tar.gz … cannot be read",
}


@pytest.mark.parametrize("how", SPOILED)
def test_a_keyframe_with_something_wrong_is_refused_with_what_and_where(extracted, how, capfd):
    spoil(extracted, how)
    with refused(SPOILED[how]):
        list(open_sequence(extracted))


def test_what_scared_cannot_hold_is_not_written(tmp_path):
    with refused(found="no frames to write"):
        write_scared([], tmp_path / "seq")
    from lightdepth.tube import lens

    with refused(found="SCARAMUZZA 100x80"):
        write_scared(colon(0, 3, 6.0, lens("c3vd", 100, 80)).frames, tmp_path / "seq")
