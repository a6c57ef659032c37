"""One camera model in place of another."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from raising import refused
from scenes import C3VD, ENDOMAPPER

from lightdepth.calibration import read_camera, write_camera
from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.camera_conversion import convert_camera
from lightdepth.cli import main
from lightdepth.tube import octagon

SMALL = {
    "PINHOLE": Pinhole(96, 80, 70.0, 71.0, 47.0, 41.0),
    "OPENCV": Brown(96, 80, 70.0, 71.0, 47.0, 41.0, -0.1, 0.02, 1e-3, -7e-4),
    "OPENCV_FISHEYE": KannalaBrandt(96, 80, 52.0, 52.5, 47.0, 41.0, -0.13, -0.006, 0.0017, -8e-5),
    "SCARAMUZZA": C3VD.resized(96, 80),
}


@pytest.mark.parametrize("name", SMALL)
def test_a_camera_becomes_its_own_model_without_loss(name):
    camera = SMALL[name]
    found = convert_camera(camera, name, octagon(camera))
    assert type(found.camera) is type(camera) and found.max_px < 1e-4 and found.seen_share == 1
    assert np.array_equal(found.rotation, np.eye(3))


@pytest.mark.parametrize("name", ["OPENCV", "OPENCV_FISHEYE", "SCARAMUZZA"])
def test_a_pinhole_is_a_special_case_or_nearly_one_of_every_other_model(name):
    camera = SMALL["PINHOLE"]
    found = convert_camera(camera, name)
    assert found.camera.name == name and found.seen_share > 0.99 and found.max_px < 0.05


@pytest.mark.parametrize("roll", [False, True])
def test_c3vd_s_lens_as_kannala_brandt_is_as_close_as_was_measured(roll):
    """Independent fit: median 1.36, largest 2.2 px; most of it is a turn of 0.17 degrees that the skew hides."""
    found = convert_camera(C3VD, "OPENCV_FISHEYE", octagon(C3VD), roll)
    angle = np.degrees(np.arctan2(found.rotation[1, 0], found.rotation[0, 0]))
    if roll:
        assert found.median_px < 0.1 and found.max_px < 1 and abs(angle) == pytest.approx(0.17, abs=0.01)
    else:
        assert found.median_px == pytest.approx(1.36, abs=0.1) and found.max_px < 3 and angle == 0
        assert np.allclose(found.camera.params[:2], 767.2, atol=1)


def test_the_residual_is_what_the_two_cameras_disagree_by():
    """The slow reference: every valid pixel's ray, projected one by one."""
    camera = SMALL["SCARAMUZZA"]
    valid = octagon(camera)
    found = convert_camera(camera, "OPENCV_FISHEYE", valid, roll=True)
    errors = []
    for row, column in zip(*np.nonzero(valid), strict=True):
        pixel = np.array([column, row]) + 0.5
        ray, seen = camera.unproject(pixel)
        there, inside = found.camera.project(found.rotation @ ray)
        if seen and inside:
            errors.append(np.linalg.norm(there - pixel))
    assert found.median_px == pytest.approx(np.median(errors)) and found.max_px == pytest.approx(np.max(errors))
    assert found.seen_share == pytest.approx(len(errors) / valid.sum(), abs=1e-3)


def test_a_fisheye_does_not_fit_a_pinhole_and_the_residual_says_so():
    found = convert_camera(ENDOMAPPER.resized(96, 72), "PINHOLE")
    assert found.max_px > 5 and found.seen_share < 0.95


def test_pixels_outside_the_mask_do_not_count():
    """A narrow mask is fitted better than the whole field."""
    camera: CameraModel = SMALL["OPENCV_FISHEYE"]
    narrow = np.zeros((80, 96), bool)
    narrow[33:49, 39:55] = True
    assert convert_camera(camera, "PINHOLE", narrow).max_px < 0.1 < convert_camera(camera, "PINHOLE").max_px
    assert isinstance(convert_camera(camera, "SCARAMUZZA", narrow).camera, Scaramuzza)


def test_an_unknown_model_and_an_empty_mask_are_refused():
    camera = SMALL["PINHOLE"]
    with refused(where="camera model", found="'FOV'"):
        convert_camera(camera, "FOV")
    with refused(where="the mask", found="no valid pixel in"):
        convert_camera(camera, "OPENCV", np.zeros((80, 96), bool))


def test_the_verb_converts_a_file_and_says_by_how_much_it_differs(tmp_path, capsys):
    camera, mask = SMALL["SCARAMUZZA"], octagon(SMALL["SCARAMUZZA"])
    write_camera(camera, tmp_path / "calib_results.txt")
    cv2.imwrite(str(tmp_path / "mask.png"), mask.astype(np.uint8) * 255)
    argv = ["convert-camera", str(tmp_path / "calib_results.txt"), "-o", str(tmp_path / "new" / "cameras.txt")]
    argv += ["--model", "OPENCV_FISHEYE", "--mask", str(tmp_path / "mask.png")]
    assert main(argv) == 0
    expected = convert_camera(read_camera(tmp_path / "calib_results.txt"), "OPENCV_FISHEYE", mask)
    assert read_camera(tmp_path / "new" / "cameras.txt").params == pytest.approx(expected.camera.params)
    said = capsys.readouterr().out
    assert f"residual {expected.median_px:.2g} px (median), {expected.max_px:.2g} px (largest)" in said
    assert f"{100 * expected.seen_share:.1f} % of the field" in said
    assert main(argv) == 3 and "already there; choose another -o" in capsys.readouterr().err
    assert main([*argv, "--overwrite"]) == 0


def test_the_verb_writes_the_same_model_in_another_format_as_it_is(tmp_path, capsys):
    camera = SMALL["OPENCV_FISHEYE"]
    write_camera(camera, tmp_path / "camera.json")
    assert main(["convert-camera", str(tmp_path / "camera.json"), "-o", str(tmp_path / "camera.xml")]) == 0
    assert "OPENCV_FISHEYE, as it was read" in capsys.readouterr().out
    assert read_camera(tmp_path / "camera.xml").params == pytest.approx(camera.params)


def test_the_verb_gives_a_file_its_size_and_refuses_another_aspect(tmp_path, capsys):
    write_camera(SMALL["PINHOLE"], tmp_path / "intrinsics.txt", "intrinsics4x4")
    argv = ["convert-camera", str(tmp_path / "intrinsics.txt"), "-o", str(tmp_path / "camera.json")]
    assert main(argv) == 3 and "holds no image size" in capsys.readouterr().err
    assert main([*argv, "--size", "[96, 80]"]) == 0
    assert read_camera(tmp_path / "camera.json") == SMALL["PINHOLE"]
    argv = ["convert-camera", str(tmp_path / "camera.json"), "-o", str(tmp_path / "small.yaml"), "--size"]
    assert main([*argv, "[48, 48]"]) == 3 and "is for 96x80; expected the same aspect" in capsys.readouterr().err
    assert main([*argv, "[0, 0]"]) == 3 and "--size: [0, 0]; expected each number" in capsys.readouterr().err
    assert main([*argv, "[48, 40]"]) == 0
    assert read_camera(tmp_path / "small.yaml").params == pytest.approx(SMALL["PINHOLE"].resized(48, 40).params)


def test_the_verb_says_to_which_model_a_camera_has_to_be_converted(tmp_path, capsys):
    write_camera(SMALL["SCARAMUZZA"], tmp_path / "camera.json")
    assert main(["convert-camera", str(tmp_path / "camera.json"), "-o", str(tmp_path / "out.txt")]) == 3
    said = capsys.readouterr().err
    assert "COLMAP has no SCARAMUZZA camera; it can be converted to OPENCV_FISHEYE or OPENCV or PINHOLE" in said
    assert not (tmp_path / "out.txt").exists()


def test_the_verb_refuses_a_fit_that_is_far_off_with_its_residual(tmp_path, capsys):
    write_camera(ENDOMAPPER.resized(96, 72), tmp_path / "camera.json")
    argv = ["convert-camera", str(tmp_path / "camera.json"), "-o", str(tmp_path / "out.json"), "--model", "PINHOLE"]
    assert main(argv) == 3
    said = " ".join(capsys.readouterr().err.split())
    assert "the nearest PINHOLE is off by" in said and "(largest); expected 0.48 at most" in said
    assert not (tmp_path / "out.json").exists()
    assert main([*argv, "--most-px", "-1"]) == 3 and "expected a number above 0" in capsys.readouterr().err
    assert main([*argv, "--most-px", "100"]) == 0 and (tmp_path / "out.json").exists()


def test_an_ocamcalib_file_made_by_a_fit_is_within_the_stated_residual_or_is_not_made(tmp_path, capsys):
    for name, model, code in (("a", "OPENCV", 0), ("b", "OPENCV_FISHEYE", 3)):
        write_camera(SMALL[model], tmp_path / f"{name}.json")
        argv = ["convert-camera", str(tmp_path / f"{name}.json"), "-o", str(tmp_path / name / "calib_results.txt")]
        assert main([*argv, "--model", "SCARAMUZZA"]) == code
    assert "the nearest SCARAMUZZA is off by" in " ".join(capsys.readouterr().err.split())
    found = read_camera(tmp_path / "a" / "calib_results.txt")
    rays, seen = SMALL["OPENCV"].rays()
    pixels = found.project(rays[seen])[0]
    rows, columns = np.nonzero(seen)
    assert np.abs(pixels - np.stack([columns, rows], -1) - 0.5).max() < 0.48
