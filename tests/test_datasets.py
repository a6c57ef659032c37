"""Sequences on disk: what is written is read back, and what cannot be used is refused with its name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon
from raising import refused
from scenes import cylinder

from lightdepth.camera import Pinhole
from lightdepth.datasets import FrameSequence, open_sequence, read_c3vd, read_folder, write_c3vd, write_folder
from lightdepth.datasets.sequence import border_mask, list_images, read_mask
from lightdepth.files.images import read_image
from lightdepth.files.tum import read_tum, write_tum
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import lens, octagon

LENS = lens("c3vd", 100, 80)


@pytest.fixture
def folder(tmp_path) -> Path:
    """Three frames with truth, as a folder."""
    write_folder(colon(0).frames[:3], tmp_path / "seq")
    return tmp_path / "seq"


@pytest.fixture
def c3vd(tmp_path) -> Path:
    """Three frames with truth, as a C3VD tree; the far end of the first is beyond 100 mm."""
    frames = colon(0, 3, 6.0, LENS).frames
    far = np.where(frames[0].true_distance > np.quantile(frames[0].true_distance, 0.9), 300, frames[0].true_distance)
    write_c3vd([replace(frames[0], true_distance=far.astype(np.float32)), *frames[1:]], tmp_path / "seq")
    return tmp_path / "seq"


def test_a_folder_is_read_back_as_it_was_written(folder):
    read = open_sequence(folder)
    assert len(read) == 3 and read.names == ["000000", "000001", "000002"] and read.numbers == [0, 1, 2]
    for found, given in zip(read, colon(0).frames[:3], strict=True):
        assert np.abs(found.image - given.image).max() < 1e-6  # a rendered image is 8 bits deep
        np.testing.assert_array_equal(found.true_distance, given.true_distance)
        np.testing.assert_allclose(found.true_world_from_cam, given.true_world_from_cam, atol=1e-7)
        np.testing.assert_array_equal(found.mask, given.mask)
        assert found.camera == given.camera and found.time == pytest.approx(given.time, abs=1e-5)
        assert found.light.gamma == given.light.gamma and found.light.position_mm == given.light.position_mm


def test_frames_are_read_when_they_are_asked_for(folder):
    read = open_sequence(folder)
    (folder / "frames" / "000001.png").unlink()
    assert read[0].number == 0 and read[-1].number == 2 and read[1:][1].number == 2
    with refused(where="000001.png", found="no such image"):
        read[1]
    assert read.by_number(2).name == "000002" and read.by_number(7) is None
    with pytest.raises(IndexError):
        read[3]


def test_images_may_lie_in_the_folder_itself_and_need_no_truth(tmp_path):
    frame = colon(0).frames[0]
    write_folder([replace(frame, true_distance=None, true_world_from_cam=None, mask=None)], tmp_path / "seq")
    (tmp_path / "seq" / "frames" / "000000.png").rename(tmp_path / "seq" / "000000.png")
    (tmp_path / "seq" / "frames").rmdir()
    (tmp_path / "seq" / "light.json").unlink()
    with pytest.warns(UserWarning, match="12% of the image is a black border, which is left out; give --mask"):
        (read,) = open_sequence(tmp_path / "seq")
    assert read.true_distance is None and read.true_world_from_cam is None and read.time is None
    assert not read.mask[~frame.mask].any() and read.mask[frame.mask].mean() > 0.95  # the border of the picture itself
    assert read.light == PhotometricCalibration() and not (tmp_path / "seq" / "truth").exists()


def test_what_is_given_wins_over_what_is_in_the_folder(folder, tmp_path):
    other = replace(CAMERA, fx=60.0)
    (tmp_path / "camera.json").write_text(
        '{"model": "PINHOLE", "width": 96, "height": 80, "params": [60.0, 52.0, 47.0, 41.0]}'
    )
    mask = np.full((80, 96), 255, np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    frame = open_sequence(folder, None, tmp_path / "camera.json", "gamma=2.2,mu=0", tmp_path / "mask.png")[0]
    assert frame.camera == other and frame.light.mu == 0 and frame.mask.all()


@pytest.mark.parametrize("inverted", [False, True])
def test_masks_are_read_in_both_polarities(tmp_path, inverted):
    mask = octagon(CAMERA)
    cv2.imwrite(str(tmp_path / "mask.png"), ((mask ^ inverted) * 255).astype(np.uint8))
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), mask)


def test_a_mask_that_masks_everything_or_is_none_is_refused_by_name(tmp_path):
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((20, 20), np.uint8))
    with refused(where="black.png", found="the mask is black everywhere"):
        read_mask(tmp_path / "black.png")
    (tmp_path / "text.png").write_text("no image")
    with refused(where="text.png", found="not a readable mask"):
        read_mask(tmp_path / "text.png")
    with refused(where="none.png", found="no such mask"):
        read_mask(tmp_path / "none.png")


def test_files_without_a_number_are_no_frames_and_frames_go_by_their_number(tmp_path):
    for name in ("mask.png", "thumbnail.jpg", "frame10.png", "frame9.PNG", "notes1.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in list_images(tmp_path)] == ["frame9.PNG", "frame10.png"]


def test_eight_and_sixteen_bits_are_read_alike_as_rgb(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), rgb[..., ::-1])
    cv2.imwrite(str(tmp_path / "b.png"), rgb[..., ::-1].astype(np.uint16) * 257)
    for name in "ab":
        np.testing.assert_allclose(read_image(tmp_path / f"{name}.png"), rgb / 255, atol=1e-6)
    cv2.imwrite(str(tmp_path / "grey.png"), rgb[..., 0])
    np.testing.assert_allclose(read_image(tmp_path / "grey.png")[..., 1], rgb[..., 0] / 255, atol=1e-6)


def spoil(folder: Path, how: str) -> None:
    """One thing wrong with a folder of frames."""
    image, poses = folder / "frames" / "000001.png", folder / "truth" / "poses.tum"
    if how == "truncated":
        image.write_bytes(image.read_bytes()[:200])
    elif how == "no camera":
        (folder / "camera.json").unlink()
    elif how in ("half size", "cropped", "one of another size"):
        for file in image.parent.iterdir() if how != "one of another size" else [image]:
            cv2.imwrite(str(file), np.zeros((80, 64, 3) if how == "cropped" else (40, 48, 3), np.uint8))
        (folder / "mask.png").unlink()
    elif how == "a pose too few":
        poses.write_text("\n".join(poses.read_text().splitlines()[:2]) + "\n")
    elif how == "NaN":
        lines = poses.read_text().splitlines()
        poses.write_text("\n".join([lines[0], lines[1].replace(lines[1].split()[2], "nan", 1), lines[2]]) + "\n")
    elif how == "seven columns":
        poses.write_text("\n".join(line.rsplit(" ", 1)[0] for line in poses.read_text().splitlines()) + "\n")
    elif how == "words":
        poses.write_text("time x y z\n")
    elif how == "zero quaternion":
        lines = poses.read_text().splitlines()
        poses.write_text("\n".join([lines[0], "0.1 1 2 3 0 0 0 0", lines[2]]) + "\n")
    elif how == "number twice":
        image.with_name("1.png").write_bytes(image.read_bytes())
        poses.unlink()
    elif how == "empty":
        for file in (folder / "frames").iterdir():
            file.unlink()
    elif how == "truth of another size":
        cv2.imwrite(str(folder / "truth" / "distance" / "000001.tiff"), np.ones((5, 5), np.float32))
    elif how == "truth truncated":
        file = folder / "truth" / "distance" / "000001.tiff"
        file.write_bytes(file.read_bytes()[:100])


SPOILED = {
    "truncated": "000001.png … not a readable image",
    "no camera": "seq … no camera.json … give --camera FILE",
    "one of another size": "000001.png … is 48x40, but 000000.png is 96x80 (1 of 3 images differ)",
    "half size": "00000 … 48x40 … 96x80 … ratio 0.5 … multiply fx, fy, cx, cy by 0.5 … width 48, height 40",
    "cropped": "00000 … 64x80 … 96x80 … cropped or padded",
    "a pose too few": "poses.tum … 2 poses for 3 frames",
    "NaN": "poses.tum … line 2 has NaN",
    "seven columns": "poses.tum … 7 columns",
    "words": "poses.tum … not a TUM trajectory",
    "zero quaternion": "poses.tum … line 2 … quaternion",
    "number twice": "seq … 1 and … 1 have the same number",
    "empty": "seq/frames … the folder is empty",
    "truth of another size": "000001 … true distance is 5x5, the image 96x80",
    "truth truncated": "000001.tiff … not a readable image",
}


@pytest.mark.parametrize("how", SPOILED)
def test_a_folder_with_something_wrong_is_refused_with_what_and_where(folder, how, capfd):
    spoil(folder, how)
    with refused(SPOILED[how]):
        list(open_sequence(folder))


@pytest.mark.parametrize("name", ["nowhere", "frames/000000.png"])
def test_a_path_that_is_no_folder_is_refused(folder, name):
    with refused(cure="expected a folder of frames"):
        open_sequence(folder / name)


def test_an_unknown_format_is_refused_with_those_there_are(folder):
    with refused(where="format", found="'bag'", cure="expected one of folder, c3vd"):
        open_sequence(folder, "bag")
    with refused(cure="is it a C3VD sequence"):
        open_sequence(folder, "c3vd")


def test_a_sequence_of_nothing_is_refused(tmp_path):
    with refused(where="here", found="no frames in it"):
        FrameSequence([], lambda i: None, "here")
    with refused(found="no frames to write"):
        write_folder([], tmp_path / "seq")


def test_a_trajectory_survives_its_file(tmp_path):
    poses = [f.true_world_from_cam for f in colon(0).frames]
    write_tum(tmp_path / "t.tum", range(len(poses)), poses)
    times, read = read_tum(tmp_path / "t.tum")
    assert times.tolist() == list(range(len(poses)))
    np.testing.assert_allclose(read, poses, atol=1e-7)


def test_a_c3vd_tree_is_found_by_looking_and_read_back_to_the_depth_s_step(c3vd):
    read = open_sequence(c3vd)
    given = colon(0, 3, 6.0, LENS).frames
    assert read.names == ["0000_color", "0001_color", "0002_color"] and read.numbers == [0, 1, 2]
    step = 100 / 65535
    for found, frame in list(zip(read, given, strict=True))[1:]:
        ray_z = LENS.rays()[0][..., 2]
        known = (found.true_distance > 0) & (frame.true_distance > 0)
        assert known.sum() > 0.95 * frame.valid.sum()
        off = (frame.true_distance - found.true_distance)[known] * ray_z[known]
        assert off.min() > -1e-4 and off.max() < step * 1.1
        np.testing.assert_allclose(found.true_world_from_cam, frame.true_world_from_cam, atol=1e-6)
        assert found.camera == LENS and found.light.assumed
        assert np.abs(found.image - frame.image).max() < 1e-6


def test_no_data_and_depth_beyond_100_mm_are_both_unknown(c3vd):
    frame = read_c3vd(c3vd)[0]
    code = cv2.imread(str(c3vd / "0000_depth.tiff"), cv2.IMREAD_UNCHANGED)
    assert (code == 0).any() and (code == 65535).sum() > 100
    assert not frame.true_distance[(code == 0) | (code == 65535)].any()
    assert (frame.true_distance[(code > 0) & (code < 65535) & frame.valid] > 0).all()
    assert (frame.true_distance * LENS.rays()[0][..., 2]).max() < 100


def test_poses_of_c3vd_are_the_same_in_either_order(c3vd):
    column_by_column = [f.true_world_from_cam for f in read_c3vd(c3vd)]
    rows = np.loadtxt(c3vd / "pose.txt", delimiter=",").reshape(-1, 4, 4).transpose(0, 2, 1).reshape(-1, 16)
    np.savetxt(c3vd / "pose.txt", rows, delimiter=",")
    np.testing.assert_allclose([f.true_world_from_cam for f in read_c3vd(c3vd)], column_by_column, atol=1e-9)
    np.testing.assert_allclose(
        column_by_column, [f.true_world_from_cam for f in colon(0, 3, 6.0, LENS).frames], atol=1e-6
    )


def test_c3vd_frames_are_paired_by_their_number_however_it_is_written(c3vd):
    padded = [(f.name, f.true_distance) for f in read_c3vd(c3vd)]
    for i in range(3):
        (c3vd / f"{i:04d}_color.png").rename(c3vd / f"{i}_color.png")
    for (name, distance), frame in zip(padded, read_c3vd(c3vd), strict=True):
        assert frame.name == name and np.array_equal(frame.true_distance, distance)


def test_c3vd_without_depth_and_poses_is_a_sequence_without_truth(c3vd):
    for file in (*c3vd.glob("*_depth.tiff"), c3vd / "pose.txt"):
        file.unlink()
    assert all(f.true_distance is None and f.true_world_from_cam is None for f in read_c3vd(c3vd))


def test_a_screening_of_c3vd_has_tracker_poses_in_either_order_and_no_depth(tmp_path):
    """`N_color.png` and pose.txt; the frames start anywhere, and their poses are found by number."""
    given = [replace(f, true_distance=None) for f in colon(0, 6, 6.0, LENS).frames]
    write_c3vd(given, tmp_path / "screening_t1")
    for i in range(6):
        (tmp_path / "screening_t1" / f"{i:04d}_color.png").rename(tmp_path / "screening_t1" / f"{i}_color.png")
    for i in (0, 1):
        (tmp_path / "screening_t1" / f"{i}_color.png").unlink()
    rows = np.loadtxt(tmp_path / "screening_t1" / "pose.txt", delimiter=",")
    for lines in (rows, rows.reshape(-1, 4, 4).transpose(0, 2, 1).reshape(-1, 16)):
        np.savetxt(tmp_path / "screening_t1" / "pose.txt", lines, delimiter=",")
        read = open_sequence(tmp_path / "screening_t1")
        assert read.names == ["0002_color", "0003_color", "0004_color", "0005_color"]
        for found, frame in zip(read, given[2:], strict=True):
            np.testing.assert_allclose(found.true_world_from_cam, frame.true_world_from_cam, atol=1e-6)
            assert found.true_distance is None and found.camera == LENS
            assert np.abs(found.image - frame.image).max() < 1e-6


def test_half_the_size_is_read_with_half_the_camera(tmp_path):
    write_c3vd(colon(0, 1, 6.0, lens("c3vd", 675, 540).resized(50, 40)).frames, tmp_path / "seq")
    (frame,) = read_c3vd(tmp_path / "seq")
    assert frame.camera == lens("c3vd", 50, 40)
    np.testing.assert_allclose(frame.camera.rays()[0][20, 25], LENS.rays()[0][39:41, 49:51].mean((0, 1)), atol=0.02)


def spoil_c3vd(folder: Path, how: str) -> None:
    if how == "eight bits":
        cv2.imwrite(str(folder / "0001_depth.tiff"), np.zeros((80, 100), np.uint8))
    elif how == "depth of another size":
        cv2.imwrite(str(folder / "0001_depth.tiff"), np.zeros((40, 50), np.uint16))
    elif how == "cropped":
        for file in folder.glob("*_color.png"):
            cv2.imwrite(str(file), cv2.imread(str(file))[:, :80])
    elif how == "truncated":
        file = folder / "0001_color.png"
        file.write_bytes(file.read_bytes()[:300])
    elif how == "number twice":
        (folder / "1_color.png").write_bytes((folder / "0001_color.png").read_bytes())
    else:
        lines = (folder / "pose.txt").read_text().splitlines()
        change = {
            "a pose too few": lines[:2],
            "twelve numbers": [",".join(line.split(",")[:12]) for line in lines],
            "no last row": [",".join(["2"] * 16)] * 3,
            "words": ["pose"],
            "scaled": [lines[0], ",".join([str(2 * float(v)) for v in lines[1].split(",")[:15]] + ["1"]), lines[2]],
        }[how]
        (folder / "pose.txt").write_text("\n".join(change) + "\n")


SPOILED_C3VD = {
    "eight bits": "0001_depth.tiff … uint8 … one channel of 16 bits",
    "depth of another size": "0001_depth.tiff … depth is 50x40, the image 100x80",
    "cropped": "seq … images are 80x80 … C3VD's camera is for 1350x1080 … --camera FILE",
    "truncated": "0001_color.png … not a readable image",
    "number twice": "seq … 0001_color.png and 1_color.png have the same number",
    "a pose too few": "pose.txt … 2 poses, but there is a frame 2",
    "twelve numbers": "pose.txt … 12 numbers a line … expected 16",
    "no last row": "pose.txt … neither the last row nor the last column",
    "words": "pose.txt … not a C3VD pose file",
    "scaled": "pose.txt: line 2 … the pose is not a rotation",
}


@pytest.mark.parametrize("how", SPOILED_C3VD)
def test_a_c3vd_tree_with_something_wrong_is_refused_with_what_and_where(c3vd, how, capfd):
    spoil_c3vd(c3vd, how)
    with refused(SPOILED_C3VD[how]):
        list(read_c3vd(c3vd))


@pytest.mark.parametrize("lumen", [False, True], ids=["bright", "dark lumen"])
def test_the_border_of_an_octagon_is_found_and_a_dark_lumen_is_tissue(lumen):
    camera = Pinhole(400, 320, 200.0, 200.0, 200.0, 160.0)
    mask = octagon(camera)
    image = np.where(mask[..., None], 0.6, 0.02).astype(np.float32).repeat(3, -1)
    if lumen:
        image[140:180, 180:220] = 0.0
    found = border_mask([image])
    assert not (found & ~mask).any()
    assert found.sum() > 0.97 * mask.sum() and found[160, 200]


def test_what_is_dark_in_one_image_may_be_bright_in_another():
    left, right = np.zeros((2, 60, 80, 3), np.float32)
    left[:, :45], right[:, 35:] = 0.5, 0.5
    assert border_mask([left]).mean() < 0.6 < 0.93 < border_mask([left, right]).mean()
    assert border_mask([np.zeros((60, 80, 3), np.float32)]).all()  # nothing to go by


def test_a_camera_of_the_map_at_half_size_is_rescaled_to_the_images(folder):
    (folder / "camera.json").unlink()
    assert open_sequence(folder, map_camera=CAMERA.resized(48, 40))[0].camera == CAMERA
    assert open_sequence(folder, map_camera=CAMERA)[0].camera == CAMERA
    with refused(found="cropped or padded"):
        open_sequence(folder, map_camera=CAMERA.resized(48, 30))


def test_the_folder_s_own_camera_wins_over_the_map_s(folder):
    assert open_sequence(folder, map_camera=replace(CAMERA, fx=1.0))[0].camera == CAMERA


def test_an_unknown_light_of_a_folder_is_the_default_and_truth_may_be_partly_there(tmp_path):
    frames = [cylinder(CAMERA).frame("1"), replace(cylinder(CAMERA).frame("2"), true_distance=None)]
    write_folder(frames, tmp_path / "seq")
    first, second = read_folder(tmp_path / "seq")
    assert isinstance(first, Frame) and first.true_distance is not None and second.true_distance is None
