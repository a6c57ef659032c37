"""A camera found from the motion of its own frames: how near it comes, and what is said of it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import refused
from sfm_videos import video
from test_sfm import pose, render, texture

from lightdepth.calibration import read_camera
from lightdepth.camera import CameraModel, KannalaBrandt, Pinhole
from lightdepth.camera.provenance import TOLERATED
from lightdepth.cli import main
from lightdepth.datasets import SequenceSource, write_folder
from lightdepth.files.images import to_bgr8
from lightdepth.frame import Frame
from lightdepth.sfm.self_calibration import SelfCalibration, across, self_calibrated
from lightdepth.tube import lens
from lightdepth.uncalibrated import FRAMES, stretch


def written(folder: Path, frames: list[Frame]) -> Path:
    """Images alone, without a camera."""
    folder.mkdir()
    for frame in frames:
        cv2.imwrite(str(folder / f"{frame.number:06d}.png"), to_bgr8(frame.image))
    return folder


def box_film(camera: CameraModel, count: int) -> list[Frame]:
    sheets = texture()
    return [Frame(f"{k}_color", render(camera, pose(k), sheets), camera) for k in range(count)]


def blind(frames: list[Frame]) -> list[Frame]:
    """The frames under a camera that is only a guess."""
    guess = across(frames[0].camera.width, frames[0].camera.height, 70)
    return [Frame(f.name, f.image, guess, mask=f.mask) for f in frames]


def test_a_folder_without_calibration_is_mapped_under_a_camera_found_from_its_motion(tmp_path):
    true = across(240, 200, 95)
    data, out = written(tmp_path / "data", box_film(true, 8)), tmp_path / "sparse"
    assert main(["sparse", str(data), "--fov", "70", "--sfm.max_features", "500", "-o", str(out)]) == 0
    told = json.loads((out / "camera.json").read_text())
    assert told["source"] == "self-calibrated" and told["model"] == "PINHOLE"
    assert told["focal_deviation"] < TOLERATED and "self-calibrated from 8 of 8 frames" in told["note"]
    assert read_camera(out / "camera.json").focal_length == pytest.approx(true.focal_length, rel=0.01)
    record = json.loads((out / "run.json").read_text())
    assert record["self_calibration"]["told_by_the_motion"] == (record["warnings"] == [])
    assert "self-calibrated" in (out / "log.txt").read_text()


def test_frames_that_do_not_connect_need_a_field_of_view_which_is_then_assumed(tmp_path, capsys):
    noise = np.random.default_rng(0).uniform(0.3, 0.6, (3, 40, 50, 1)).repeat(3, -1).astype(np.float32)
    blurred = [cv2.GaussianBlur(image, (0, 0), 6) for image in noise]
    data = written(tmp_path / "data", [Frame(f"{i}", image, across(50, 40, 70)) for i, image in enumerate(blurred)])
    command = ["predict", str(data), "--checkpoint", "decline", "-o"]
    assert main([*command, str(tmp_path / "a"), "--camera", "auto"]) == 3
    assert "no camera could be found from their motion" in " ".join(capsys.readouterr().err.split())
    assert main([*command, str(tmp_path / "b"), "--fov", "60"]) == 0
    told = json.loads((tmp_path / "b" / "camera.json").read_text())
    assert told["source"] == "assumed" and told["params"][0] == pytest.approx(25 / np.tan(np.radians(30)))
    assert any(
        "assumed: a pinhole 60 degrees" in w for w in json.loads((tmp_path / "b" / "run.json").read_text())["warnings"]
    )


def test_without_a_camera_the_way_out_is_named_by_every_verb(tmp_path, capsys):
    data = written(tmp_path / "data", box_film(across(60, 50, 90), 2))
    assert main(["predict", str(data), "-o", str(tmp_path / "a"), "--checkpoint", "decline"]) == 3
    assert "--camera auto" in capsys.readouterr().err
    for verb in ("predict", "sparse"):
        assert main([verb, str(data), "-o", str(tmp_path / "c"), "--camera", "auto"]) == 3
        said = " ".join(capsys.readouterr().err.split())
        assert "--camera auto: 2 frames, of 3 that their motion needs; give --camera FILE, or --fov DEGREES" in said
        assert "_" not in said.split("--camera auto")[1]  # no name of the program's inside
    assert main(["adapt", str(data), "-o", str(tmp_path / "b"), "--camera", "auto"]) == 3
    assert "lightdepth import" in capsys.readouterr().err


def test_a_field_of_view_beside_a_calibration_or_an_impossible_one_is_refused(tmp_path):
    with refused(where="--fov", found="with the calibration camera.json"):
        SequenceSource(tmp_path, camera=Path("camera.json"), fov=70.0).open()
    with refused(where="--fov", found="200 degrees"):
        self_calibrated(box_film(across(60, 50, 90), 2), fov=200.0)


def test_an_uncertain_focal_length_is_said_with_what_to_do():
    camera = Pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
    sure = SelfCalibration(camera, 0.01, 0.6, 24, 24, 900, (499.0, 501.0))
    unsure = SelfCalibration(camera, 0.08, 0.6, 24, 24, 900, (499.0, 540.0))
    assert sure.told and "+- 1.0 % (65 degrees across)" in str(sure) and "--fov" not in str(sure)
    assert not unsure.told and "does not tell it within 3 %" in str(unsure) and "--fov" in str(unsure)


@pytest.mark.parametrize("count", [1, 5, 24, 25, 100, 5000])
@pytest.mark.parametrize("rate", [None, 5.0, 30.0])
def test_a_stretch_of_frames_lies_in_the_sequence_and_is_some_seconds_long(count, rate):
    times = [None, None] if rate is None else [0.0, 1 / rate]
    for place in (0.25, 0.5, 0.75):
        rows = stretch(count, times, place)
        assert rows[0] >= 0 and rows[-1] < count and len(rows) == min(count, FRAMES)
        apart = np.diff(rows)
        assert (apart == apart[:1]).all()
        if count == 5000:
            assert apart[0] == (1 if rate == 5.0 else 6)


@pytest.mark.slow
@pytest.mark.parametrize(("field", "seed"), [(60, 31), (75, 32), (95, 33)])
def test_the_focal_length_of_a_colon_s_clip_is_within_3_percent_or_said_not_to_be_told(field, seed):
    camera = across(320, 256, field)
    found = self_calibrated(blind(video(seed, camera, "")))
    print(f"{field} degrees, seed {seed}: {found}")
    error = abs(found.camera.focal_length / camera.focal_length - 1)
    assert error < 0.03 or not found.told


@pytest.mark.slow
def test_a_fisheye_is_found_where_the_data_hold_its_distortion():
    camera = lens("c3vd", 320, 256)
    found = self_calibrated(blind(video(1, camera, "")))
    print(found)
    assert isinstance(found.camera, KannalaBrandt)
    assert abs(found.camera.focal_length / camera.focal_length - 1) < 0.03


@pytest.mark.slow
def test_a_video_without_calibration_becomes_a_surface_in_one_command(tmp_path):
    camera = across(320, 256, 75)
    data, out = tmp_path / "data", tmp_path / "dense"
    write_folder(video(32, camera, "", config=None), data)
    (data / "camera.json").unlink()
    command = ["densify", str(data), "--camera", "auto", "--checkpoint", "decline", "-o", str(out)]
    assert main(command) in (0, 4)
    assert (out / "map_000" / "mesh.ply").is_file()
    assert json.loads((out / "camera.json").read_text())["source"] == "self-calibrated"


@pytest.mark.slow
def test_an_import_without_calibration_writes_one_that_says_how_it_was_found_also_when_cut(tmp_path):
    true = across(240, 200, 95)
    frames = box_film(true, 8)
    for frame in frames:  # a black border
        frame.image[:, :20] = frame.image[:, -20:] = 0
    data, out = written(tmp_path / "data", frames), tmp_path / "imported"
    command = ["import", str(data), "-o", str(out), "--fov", "80", "--crop", "auto", "--no-find-text"]
    assert main(command) == 0
    told = json.loads((out / "camera.json").read_text())
    assert told["source"] == "self-calibrated" and told["width"] < 240
    assert read_camera(out / "camera.json").focal_length == pytest.approx(true.focal_length, rel=0.02)
    assert main(["predict", str(out), "-o", str(tmp_path / "depth"), "--checkpoint", "decline"]) == 0
