"""EndoMapper's extracted frames: numbers from 1, the endoscope's calibration found by the data set's layout."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import SMALL
from raising import refused
from scenes import ENDOMAPPER

from lightdepth.calibration import read_camera, write_camera, write_light
from lightdepth.cli import main
from lightdepth.datasets import open_sequence, read_endomapper, write_endomapper
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import lens, octagon

LENS = lens("fisheye", 96, 72)
LIGHT = PhotometricCalibration(2.2, 1.5, (0.5, -1, 3), (0.1, 0, 0.9), source="measured")


def frames(count: int = 3) -> list[Frame]:
    rng = np.random.default_rng(0)
    images = rng.integers(60, 256, (count, 72, 96, 3)) / 255
    return [Frame(f"out{n}", i.astype(np.float32), LENS, LIGHT, octagon(LENS)) for n, i in enumerate(images, 9)]


@pytest.fixture
def folder(tmp_path) -> Path:
    """Frames 9, 10 and 11 with their calibration beside them."""
    write_endomapper(frames(), tmp_path / "seq")
    return tmp_path / "seq"


@pytest.fixture
def tree(tmp_path, folder) -> Path:
    """The data set's tree, with two endoscopes; the sequence was made with the second."""
    sequence = tmp_path / "Sequences" / "Seq_027" / "meta-data" / "33"
    shutil.copytree(folder / "img_train", sequence / "img_train")
    for number, scale in (("01", 1.1), ("02", 1.0)):
        place = tmp_path / "Calibrations" / f"Endoscope_{number}"
        place.mkdir(parents=True)
        camera = replace(LENS, fx=LENS.fx * scale)
        write_camera(camera, place / f"Endoscope_{number}_geometrical.xml")
        write_light(replace(LIGHT, mu=1.5 * scale), place / f"Endoscope_{number}_photometrical.xml")
    info = {"seq_number": 27, "endoscope_number": 2}
    (tmp_path / "Sequences" / "Seq_027" / "Seq_027_info.json").write_text(json.dumps(info))
    return sequence


def test_a_sequence_is_read_back_as_it_was_written(folder):
    read = open_sequence(folder)
    assert read.names == ["out9", "out10", "out11"] and read.numbers == [9, 10, 11]
    for found, given in zip(read, frames(), strict=True):
        assert np.abs(found.image - given.image).max() < 1e-6
        assert found.camera.params == pytest.approx(LENS.params) and found.time is None
        assert (found.light.gamma, found.light.mu, found.light.source) == (2.2, 1.5, "measured")
        assert found.light.position_mm == pytest.approx(LIGHT.position_mm)
        np.testing.assert_array_equal(found.mask, given.mask)


def test_the_first_frame_of_the_video_is_out1(folder):
    assert [f.time for f in read_endomapper(folder, fps=40)] == pytest.approx([8 / 40, 9 / 40, 10 / 40])
    shutil.copy(folder / "img_train" / "out9.png", folder / "img_train" / "out0.png")
    with refused(where="out0.png", found="number 0, but EndoMapper counts frames from 1"):
        open_sequence(folder)
    with refused(found="frame a0 has number 0", cure="EndoMapper counts from 1"):
        write_endomapper([replace(frames()[0], name="a0")], folder.parent / "other")


def test_the_endoscope_is_found_by_its_number_in_the_data_set_s_tree(tree):
    read = open_sequence(tree)
    assert read[0].camera.fx == pytest.approx(LENS.fx) and read[0].light.mu == 1.5


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (7, "Endoscope_01_geometrical.xml, Endoscope_02_geometrical.xml, but … with endoscope 7"),
        ("N/A", "made with endoscope N/A"),
        (None, "Seq_027_info.json … endoscope_number missing"),
    ],
)
def test_a_sequence_without_a_calibrated_endoscope_is_refused(tree, number, message):
    file = tree.parents[1] / "Seq_027_info.json"
    file.write_text(json.dumps({"endoscope_number": number}))
    with refused(message):
        open_sequence(tree)
    file.unlink()
    with refused("2 calibrations … and no Seq_NNN_info.json"):
        open_sequence(tree)


def test_without_any_calibration_the_camera_is_asked_for_and_the_light_assumed(tmp_path, folder):
    for file in folder.glob("*.xml"):
        file.rename(tmp_path / file.name.removeprefix("Endoscope_00_"))
    with refused(where="seq", found="no Endoscope_XX_geometrical.xml here", cure="--camera FILE"):
        open_sequence(folder)
    frame = open_sequence(folder, camera=tmp_path / "geometrical.xml")[0]
    assert frame.camera.params == pytest.approx(LENS.params) and frame.light == PhotometricCalibration()
    frame = open_sequence(folder, camera=tmp_path / "geometrical.xml", light=tmp_path / "photometrical.xml")[0]
    assert frame.light.mu == 1.5


def test_a_map_s_own_camera_wins_over_the_endoscope_s(folder):
    """EndoMapper's COLMAP runs refined the lens, at their own image size."""
    refined = replace(LENS, fx=LENS.fx + 1).resized(48, 36)
    assert open_sequence(folder, map_camera=refined)[0].camera.fx == pytest.approx(LENS.fx + 1)


def test_frames_at_half_size_have_the_calibration_and_mask_resized_and_cropped_ones_are_refused(folder):
    for image in (folder / "img_train").iterdir():
        cv2.imwrite(str(image), cv2.imread(str(image))[::2, ::2])
    frame = open_sequence(folder)[0]
    assert (frame.camera.width, frame.camera.height) == (48, 36) and frame.mask.shape == (36, 48)
    assert frame.camera.params[:4] == pytest.approx(np.array(LENS.params[:4]) / 2)
    for image in (folder / "img_train").iterdir():
        cv2.imwrite(str(image), cv2.imread(str(image))[:, 8:])
    with refused(where="out9.png", found="the image is 40x36, the camera 96x72: ratios"):
        open_sequence(folder)


@pytest.mark.parametrize("place", ["images", "frames", "."])
def test_frames_may_lie_where_they_were_extracted_to(folder, place):
    if place == ".":
        for image in (folder / "img_train").iterdir():
            image.rename(folder / image.name)
        (folder / "img_train").rmdir()
    else:
        (folder / "img_train").rename(folder / place)
    assert open_sequence(folder).numbers == [9, 10, 11]


def test_without_a_mask_the_black_border_is_found(folder):
    (folder / "mask.png").unlink()
    for image in (folder / "img_train").iterdir():
        cv2.imwrite(str(image), cv2.imread(str(image)) * octagon(LENS)[..., None].astype(np.uint8))
    mask = open_sequence(folder)[0].mask
    assert not mask[0, 0] and mask[36, 48] and (mask & ~octagon(LENS)).mean() < 0.01


def test_our_own_folder_is_not_taken_for_endomapper_s(folder):
    write_camera(LENS, folder / "camera.json")
    (folder / "img_train").rename(folder / "frames")
    assert open_sequence(folder)[0].light == PhotometricCalibration()  # light.json is what a folder would have
    assert open_sequence(folder, "endomapper")[0].light.mu == 1.5


def test_bare_intrinsics_are_for_the_size_of_the_images(folder, tmp_path):
    (tmp_path / "intrinsics.txt").write_text("60 0 47.5\n0 61 35.5\n0 0 1\n")
    camera = open_sequence(folder, camera=tmp_path / "intrinsics.txt")[0].camera
    assert (camera.width, camera.height, camera.params) == (96, 72, (60, 61, 48, 36))


def test_synth_makes_a_sequence_whose_frames_map_and_truth_go_by_the_same_numbers(tmp_path):
    shape, texture = SMALL.shape, SMALL.texture
    argv = ["--layout", "endomapper", "--lens", "fisheye", "--frames", "5", "--size", "[96, 72]", "--travel-mm", "6"]
    argv += ["--slam.kind", "independent", "--slam.maps", "1"]
    argv += ["--scene.shape.length", str(shape.length), "--scene.shape.step", str(shape.step)]
    argv += ["--scene.texture.resolution", str(texture.resolution)]
    assert main(["synth", "-o", str(tmp_path / "out"), *argv]) == 0
    read, truth = open_sequence(tmp_path / "out" / "sequence"), open_sequence(tmp_path / "out" / "truth" / "sequence")
    assert read.numbers == truth.numbers == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(read[2].image, truth[2].image)
    assert truth[2].true_distance is not None and read[2].true_distance is None
    (submap,) = read_map(tmp_path / "out" / "slam").submaps
    assert {k.number for k in submap.keyframes} <= set(read.numbers)
    assert submap.keyframes[0].camera.params == pytest.approx(read[0].camera.params, abs=1e-6)


def test_synth_refuses_a_lens_that_the_layout_cannot_hold(tmp_path, capsys):
    assert main(["synth", "-o", str(tmp_path / "out"), "--layout", "endomapper"]) == 3
    assert "--lens fisheye" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_real_frame_with_the_sample_calibration_is_read(realdata, tmp_path):
    assets = realdata / "endomapper_assets"
    (tmp_path / "images").mkdir()
    shutil.copyfile(assets / "sample_frame.png", tmp_path / "images" / "out1.png")
    for name in ("Endoscope_sample_geometrical.xml", "Endoscope_sample_photometrical.xml", "mask.png"):
        shutil.copyfile(assets / name, tmp_path / name)
    (frame,) = open_sequence(tmp_path)
    assert (
        frame.camera == ENDOMAPPER.with_pixel_center(0.0) == read_camera(tmp_path / "Endoscope_sample_geometrical.xml")
    )
    assert frame.light.mu == 2.767302 and frame.mask.mean() == pytest.approx(0.871, abs=1e-3)
    assert frame.valid[frame.mask].all()  # the lens can be inverted everywhere in the octagon
    shutil.copyfile(assets / "mask_endomapper_gluefactory.png", tmp_path / "mask.png")  # the other polarity
    assert (open_sequence(tmp_path)[0].mask & frame.mask).sum() > 0.95 * frame.mask.sum()
