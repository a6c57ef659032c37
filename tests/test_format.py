"""Data sets' records: each is told by its own files alone, and depth is what its code says."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon

from lightdepth.datasets import (
    FORMATS,
    open_sequence,
    write_c3vd,
    write_endomapper,
    write_endoslam,
    write_folder,
    write_hamlyn,
    write_scared,
    write_simcol,
)
from lightdepth.datasets.format import DepthCode, checked_images, frames_of
from lightdepth.datasets.reading import _BY_NAME, _DATA_SETS
from lightdepth.photometry import PhotometricCalibration

FRAMES = [replace(frame, name=f"{i:06d}") for i, frame in enumerate(colon(0).frames[:3])]
WRITERS = {
    "folder": write_folder,
    "c3vd": write_c3vd,
    "simcol": write_simcol,
    "hamlyn": write_hamlyn,
    "scared": write_scared,
    "endoslam": write_endoslam,
    "endomapper": lambda frames, path: write_endomapper([replace(f, name=f"{f.number + 1}") for f in frames], path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_files_of_a_data_set_are_those_of_no_other(name, tmp_path):
    WRITERS[name](FRAMES, tmp_path / "Frames_S1")
    told = [data_set.name for data_set in _DATA_SETS if data_set.fits(tmp_path / "Frames_S1")]
    assert told == ([] if name == "folder" else [name])


def test_every_format_but_video_has_a_record_and_a_writer():
    assert set(_BY_NAME) == set(WRITERS) == set(FORMATS) - {"video"}


@pytest.mark.parametrize("name", ["folder", "hamlyn", "simcol", "endoslam"])
def test_a_map_s_camera_serves_where_the_sequence_s_own_is_missing_and_there_alone(name, tmp_path):
    path = tmp_path / "tree" / "Frames_S1"
    WRITERS[name](FRAMES, path)
    other = replace(CAMERA, fx=2 * CAMERA.fx)
    assert open_sequence(path, name, map_camera=other)[0].camera != other
    for file in ("camera.json", "intrinsics.txt", "../cam.txt", "../Calibration/cam.txt"):
        (path / file).unlink(missing_ok=True)
    assert open_sequence(path, name, map_camera=other)[0].camera == other


def test_depth_is_along_the_axis_and_unknown_at_0_and_where_it_is_clipped(tmp_path):
    code = np.array([[0, 1, 500], [999, 1000, 65535]], np.uint16)
    cv2.imwrite(str(tmp_path / "1.png"), code)
    ray_z = np.full((2, 3), 0.5)
    found = DepthCode("X", full=1000, full_mm=20.0, clipped=1000).distance(tmp_path / "1.png", ray_z)
    np.testing.assert_allclose(found, [[0, 0.04, 20], [39.96, 0, 0]], rtol=1e-6)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(DepthCode("X").distance(tmp_path / "1.png", ray_z), 2 * code.astype(np.float32))


def test_frames_have_what_stands_at_their_image_s_place_and_gaps_in_depth_are_told(tmp_path):
    for number in (7, 12):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((80, 96, 3), number, np.uint8))
    images = [tmp_path / "7.png", tmp_path / "12.png"]
    with pytest.warns(UserWarning, match="no depth for 1 of 2 frames, the first is frame 12"):
        assert checked_images(tmp_path, images, {7}) == [7, 12]
    read = frames_of(tmp_path, images, CAMERA, PhotometricCalibration(), None, times=[1.5, None], names=["a7", "a12"])
    assert [(f.name, f.time, round(255 * float(f.image.max()))) for f in read] == [("a7", 1.5, 7), ("a12", None, 12)]
    assert read[0].true_distance is None and read[0].true_world_from_cam is None
