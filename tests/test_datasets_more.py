"""Published data sets with truth: a tree as its authors ship it is read back to the step of its depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import colon

from lightdepth.datasets import open_sequence, read_c3vd, write_c3vd
from lightdepth.datasets.c3vd import C3VD, C3VD_V2
from lightdepth.errors import InputError

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
    assert open_sequence(tmp_path / "seq", "c3vd")[0].light.source == "published"


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
    with pytest.raises(InputError, match="no images with a number"):
        open_sequence(tmp_path)
    with pytest.raises(InputError, match=r"no rgb/NNNN\.png beside depth/ or pose\.txt"):
        open_sequence(tmp_path, "c3vd")


def spoil_v2(folder: Path, how: str) -> None:
    if how == "eight bits":
        cv2.imwrite(str(folder / "depth" / "0001_depth.tiff"), np.zeros((80, 100), np.uint8))
    elif how == "depth of another size":
        cv2.imwrite(str(folder / "depth" / "0001_depth.tiff"), np.zeros((40, 50), np.uint16))
    elif how == "cropped":
        for file in (folder / "rgb").iterdir():
            cv2.imwrite(str(file), cv2.imread(str(file))[:, :80])
    elif how == "number twice":
        (folder / "rgb" / "1.png").write_bytes((folder / "rgb" / "0001.png").read_bytes())
    elif how == "a pose too few":
        lines = (folder / "pose.txt").read_text().splitlines()
        (folder / "pose.txt").write_text("\n".join(lines[:2]) + "\n")


SPOILED_V2 = {
    "eight bits": r"0001_depth\.tiff: uint8.*one channel of 16 bits",
    "depth of another size": r"0001_depth\.tiff: depth is 50x40, the image 100x80",
    "cropped": "seq: images are 80x80; C3VD's camera is for 1350x1080.*--camera FILE",
    "number twice": r"rgb: 0001\.png and 1\.png have the same number",
    "a pose too few": r"pose\.txt: 2 poses, but there is a frame 2",
}


@pytest.mark.parametrize("how", SPOILED_V2)
def test_a_second_edition_with_something_wrong_is_refused_with_what_and_where(how, tmp_path):
    write_c3vd(colon(0, 3, 6.0, C3VD_LENSES["v2"]).frames, tmp_path / "seq", "v2")
    spoil_v2(tmp_path / "seq", how)
    with pytest.raises(InputError, match=SPOILED_V2[how]):
        list(read_c3vd(tmp_path / "seq"))
