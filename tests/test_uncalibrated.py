"""A camera that nobody calibrated is said by every verb that works with it, and by the files that it goes into."""

from __future__ import annotations

import json
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon, slam
from raising import refused
from test_self_calibration import box_film, written

from densify.dense_map import read_dense_map
from lightdepth.calibration import read_camera, write_camera
from lightdepth.camera import CameraModel, Pinhole, Provenance
from lightdepth.cli import main
from lightdepth.datasets import SequenceSource, open_sequence
from lightdepth.datasets.no_camera import NoCamera
from lightdepth.errors import InputError
from lightdepth.files.depths import white_of
from lightdepth.files.images import to_bgr8
from lightdepth.files.packed import read_packed, write_packed
from lightdepth.maps import read_map
from lightdepth.maps.colmap import write_text_model
from lightdepth.option_names import option, options_below
from lightdepth.reporting.run import run_folder
from lightdepth.sfm.self_calibration import SelfCalibration, across
from lightdepth.uncalibrated import found_camera, with_camera

NOTE = "self-calibrated from 24 of 24 frames. The motion does not tell it within 3 %: give a calibration"
UNSURE = Provenance("self-calibrated", 0.156, NOTE)
SURE = Provenance("self-calibrated", 0.01, "self-calibrated from 24 of 24 frames")
ASSUMED = Provenance("assumed", None, "the camera is assumed: a pinhole 90 degrees across; lengths may be wrong")


def known(provenance: Provenance | None) -> CameraModel:
    return replace(CAMERA, provenance=provenance)


def lightdepth(*argv: object) -> int:
    return main([str(each) for each in argv])


def said(folder: Path) -> list[str]:
    found: list[str] = json.loads((folder / "run.json").read_text())["warnings"]
    return [each for each in found if "black border" not in each]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Frames without a camera; maps of them as `sparse` leaves them, by how well their camera is known."""
    root = tmp_path_factory.mktemp("uncalibrated")
    frames = colon(52, 12, 9.0).frames
    (root / "frames").mkdir()
    for frame in frames:
        cv2.imwrite(str(root / "frames" / f"{frame.number:06d}.png"), to_bgr8(frame.image))
    (submap,) = slam(frames, keyframe_every=2).map.submaps
    for name, provenance in (("unsure", UNSURE), ("sure", SURE), ("assumed", ASSUMED)):
        write_text_model(submap, root / name / "sparse" / "0")
        write_camera(known(provenance), root / name / "camera.json")
    return root


@pytest.fixture(scope="module")
def dense(made, tmp_path_factory) -> Path:
    """The surface of a map whose camera hardly anybody knows."""
    run = tmp_path_factory.mktemp("dense") / "run"
    assert densified(made, "unsure", run) == 0
    return run


def densified(made: Path, name: str, run: Path, *more: object) -> int:
    argv = ["densify", made / "frames", "--map", made / name, "--checkpoint", "decline", "--fit-light=false"]
    return lightdepth(*argv, "--fusion.voxel", 0.3, "-o", run, *more)


def test_a_camera_says_where_it_is_from_after_it_was_cut_resized_written_and_read(tmp_path):
    camera = known(UNSURE)
    write_camera(camera.cropped(4, 4, 80, 60).resized(40, 30), tmp_path / "camera.json")
    write_packed(tmp_path / "kept.npz", camera)
    for again in (read_camera(tmp_path / "camera.json"), read_packed(tmp_path / "kept.npz", CameraModel)):
        assert again.provenance == UNSURE
    assert camera == CAMERA and camera.params == CAMERA.params and len(camera.params) == 4


@pytest.mark.parametrize("place", ["unsure", "unsure/sparse", "unsure/sparse/0"])
def test_a_map_s_camera_is_known_as_uncertain_from_the_file_that_sparse_left(made, place):
    assert read_map(made / place).submaps[0].keyframes[0].camera.provenance == UNSURE


def test_the_file_of_another_camera_beside_a_map_says_nothing_of_the_map_s_own(made, tmp_path):
    write_text_model(read_map(made / "unsure").submaps[0], tmp_path / "sparse" / "0")
    write_camera(replace(known(UNSURE), fx=60.0), tmp_path / "camera.json")
    assert read_map(tmp_path).submaps[0].keyframes[0].camera.provenance is None
    (tmp_path / "camera.json").write_text("{", encoding="utf-8")
    assert read_map(tmp_path).submaps[0].keyframes[0].camera.provenance is None


def test_a_surface_of_a_map_whose_camera_is_uncertain_says_so_and_is_not_green(dense):
    verdict = json.loads((dense / "run.json").read_text())["verdict"]
    assert said(dense).count(NOTE) == 1 and NOTE in (dense / "report.html").read_text()
    assert verdict["colour"] == "amber" and "focal length known to 15.6 % only" in verdict["sentence"]
    assert read_camera(dense / "map_000" / "camera.json").provenance == UNSURE


def test_an_assumed_camera_is_said_and_a_well_known_one_is_not(made, tmp_path):
    assert densified(made, "assumed", tmp_path / "assumed") == 0
    verdict = json.loads((tmp_path / "assumed" / "run.json").read_text())["verdict"]
    assert said(tmp_path / "assumed") == [ASSUMED.note] and "the camera is assumed" in verdict["sentence"]
    assert densified(made, "sure", tmp_path / "sure") == 0
    assert not said(tmp_path / "sure")
    assert json.loads((tmp_path / "sure" / "run.json").read_text())["verdict"]["colour"] == "green"


@pytest.mark.parametrize("verb", ["predict", "densify", "live"])
def test_a_calibration_file_that_is_uncertain_is_said_once_by_every_verb(verb, made, tmp_path, capsys, recwarn):
    more = [] if verb == "predict" else ["--map", made / "sure", "--fit-light=false"]
    argv = [verb, made / "frames", "--camera", made / "unsure" / "camera.json", "--checkpoint", "decline"]
    assert lightdepth(*argv, *more, "-o", tmp_path / "run") == 0
    assert said(tmp_path / "run") == [NOTE]
    assert capsys.readouterr().out.count(NOTE) + sum(str(w.message) == NOTE for w in recwarn) == 1


def test_lengths_and_exports_of_such_a_surface_say_it_too(dense, tmp_path):
    places = read_dense_map(dense / "map_000").vertices[:1].round(4).tolist()
    argv = ["measure", dense, "--points", places, "--radius", 1, "--output", tmp_path / "length.json"]
    with pytest.warns(UserWarning, match="does not tell it within 3 %"):
        assert lightdepth(*argv) == 0
    assert json.loads((tmp_path / "length.json").read_text())["warnings"] == [NOTE]
    assert lightdepth("export", dense, "--to", "ply", "-o", tmp_path / "ply") == 0
    assert said(tmp_path / "ply") == [NOTE]


def test_frames_with_an_uncertain_camera_say_it_when_they_are_opened(made):
    with pytest.warns(UserWarning, match="does not tell it within 3 %"):
        open_sequence(made / "frames", camera=made / "unsure" / "camera.json")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="self-calibrated")
        open_sequence(made / "frames", camera=made / "sure" / "camera.json")


def test_a_map_that_sparse_makes_with_an_uncertain_calibration_keeps_the_doubt(tmp_path):
    camera, out = across(240, 200, 95), tmp_path / "sparse"
    data = written(tmp_path / "data", box_film(camera, 6))
    write_camera(replace(camera, provenance=UNSURE), tmp_path / "camera.json")
    argv = ["sparse", data, "--camera", tmp_path / "camera.json", "--sfm.max_features", 500, "-o", out]
    assert lightdepth(*argv) == 0
    assert said(out) == [NOTE] and read_map(out).submaps[0].keyframes[0].camera.provenance == UNSURE


def test_a_calibration_that_is_converted_says_what_the_new_file_cannot_hold(tmp_path, capsys):
    write_camera(known(UNSURE), tmp_path / "camera.json")
    assert lightdepth("convert-camera", tmp_path / "camera.json", "-o", tmp_path / "camera.yaml") == 0
    assert f"warning: {NOTE}" in capsys.readouterr().out
    argv = ["convert-camera", tmp_path / "camera.json", "--model", "OPENCV", "-o", tmp_path / "other.json"]
    assert lightdepth(*argv) == 0
    assert read_camera(tmp_path / "other.json").provenance == UNSURE


@pytest.mark.parametrize("verb", ["predict", "densify", "live", "sparse", "train", "adapt", "select"])
def test_frames_without_a_calibration_are_refused_with_what_this_verb_takes(verb, made, tmp_path, capsys):
    data = (
        ["--preset", "tube_smoke", "--data.sequences", f"[{made / 'frames'}]"] if verb == "train" else [made / "frames"]
    )
    assert lightdepth(verb, *data, "-o", tmp_path / "out") == 3
    told = " ".join(capsys.readouterr().err.split())
    first = f"make a sequence with one first: lightdepth import {made / 'frames'} --camera auto -o DATA"
    option = "--data.camera" if verb == "train" else "--camera"
    finds = verb in ("predict", "densify", "live", "sparse")
    assert f"no camera.json; give {option} FILE" in told
    assert (first in told) != finds and ("--camera auto to find it from the motion" in told) == finds
    assert "--map" not in told or verb != "train"


def test_train_names_its_own_options_for_what_is_wrong_with_its_frames(tmp_path, capsys):
    for part, dtype in (("color", np.uint8), ("depth", np.uint16)):  # Hamlyn's, without its intrinsics.txt
        (tmp_path / "seq" / part).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "seq" / part / "0000000000.png"), np.full((40, 50), 90, dtype))
    data = ["--data.sequences", f"[{tmp_path / 'seq'}]"]
    assert lightdepth("train", "--preset", "tube_smoke", *data, "-o", tmp_path / "out") == 3
    assert "give --data.camera FILE" in " ".join(capsys.readouterr().err.split())


def test_readers_call_options_as_the_verb_at_work_does(tmp_path):
    (tmp_path / "color").mkdir()
    with options_below("data"), refused(cure="give --data.camera FILE"):
        raise NoCamera.at(tmp_path, "no camera.json")
    with refused("expected the bits", where="--bit-depth"):
        white_of([], 99)
    with suppress(InputError), options_below("data"):
        raise InputError("it", "is wrong", "mend it")
    assert option("light") == "--light"


def guessed(deviation: float, fov: float | None, field: float = 136.0) -> SelfCalibration:
    """What a motion came to that says `field` degrees."""
    return SelfCalibration(across(640, 480, field), deviation, 0.6, 12, 12, 900, (389.0,), fov)


@pytest.mark.parametrize(
    ("deviation", "fov", "kept"),
    [(1.0, 110, True), (0.9, 110, True), (0.3, 130, True), (0.3, 60, False), (0.1, 110, False), (1.0, None, False)],
)
def test_a_stated_field_is_kept_where_the_motion_hardly_tells_it_and_does_not_speak_against_it(deviation, fov, kept):
    assert guessed(deviation, fov).leaves_stated_field == kept


@pytest.mark.parametrize(("deviation", "source"), [(1.0, "assumed"), (0.1, "self-calibrated")])
def test_the_camera_of_a_worthless_estimate_is_the_stated_one_and_it_is_said(deviation, source, tmp_path, monkeypatch):
    data = written(tmp_path / "data", box_film(across(60, 50, 90), 4))
    monkeypatch.setattr(
        "lightdepth.uncalibrated.self_calibrated", lambda frames, config, told, fov: guessed(deviation, fov)
    )
    with run_folder(tmp_path / "run", "predict", {}) as run:
        camera = found_camera(SequenceSource(data, fov=110.0), run)
    assert isinstance(camera, Pinhole) and camera.provenance is not None and camera.provenance.source == source
    (warned,) = said(tmp_path / "run")
    assert camera.provenance.note == warned and camera.provenance.doubt == warned
    if source == "assumed":
        assert camera.focal_length == pytest.approx(30 / np.tan(np.radians(55)))
        assert "110 degrees across, as --fov says" in warned and "+- 100.0 % (136 degrees across)" in warned
    else:
        assert "Give frames with more sideways motion or a calibration" in warned and "--fov" not in warned


def test_a_resumed_run_has_the_camera_that_was_found_with_its_doubt(tmp_path, monkeypatch):
    source = SequenceSource(written(tmp_path / "data", box_film(across(60, 50, 90), 4)), camera=Path("auto"))
    monkeypatch.setattr("lightdepth.uncalibrated.self_calibrated", lambda frames, config, told, fov: guessed(0.1, fov))
    with pytest.raises(KeyboardInterrupt), run_folder(tmp_path / "run", "predict", {}, resume=False) as run:
        run.hash_inputs(data=source.data)
        first = read_camera(with_camera(source, run).files["camera"])
        raise KeyboardInterrupt
    monkeypatch.delattr("lightdepth.uncalibrated.self_calibrated")
    with run_folder(tmp_path / "run", "predict", {}, resume=True) as run:
        again = read_camera(with_camera(source, run).files["camera"])
    assert again == first and again.provenance == first.provenance is not None
    assert said(tmp_path / "run") == [again.provenance.doubt]
