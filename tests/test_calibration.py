"""camera.json and light.json."""

from __future__ import annotations

import json

import pytest
from raising import refused
from scenes import C3VD, LENSES

from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.files.schema import read_json
from lightdepth.photometry import PhotometricCalibration

PINHOLE_FILE = {"model": "PINHOLE", "width": 640, "height": 480, "params": [500.0, 505.0, 319.5, 239.5]}


def written(path, data) -> str:
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


@pytest.mark.parametrize("name", LENSES)
def test_cameras_survive_their_file(tmp_path, name):
    write_camera(LENSES[name], tmp_path / "camera.json")
    assert read_camera(tmp_path / "camera.json") == LENSES[name]


@pytest.mark.parametrize(
    ("found", "cx"),
    [({}, 319.5), ({"pixel_center": 0.5}, 319.5), ({"pixel_center": 0.0}, 320.0), ({"pixel_center": 0}, 320.0)],
    ids=str,
)
def test_pixel_center_of_the_file_is_converted_to_ours(tmp_path, found, cx):
    camera = read_camera(written(tmp_path / "camera.json", {**PINHOLE_FILE, **found}))
    assert (camera.cx, camera.cy) == (cx, cx - 80)
    assert (camera.fx, camera.width) == (500, 640)


def test_c3vd_as_published_is_read_with_pixel_center_0(tmp_path):
    published = C3VD.with_pixel_center(1.0)  # our numbers moved back by half a pixel
    assert published.cx == pytest.approx(678.544839263292)
    file = {"model": "SCARAMUZZA", "width": 1350, "height": 1080, "params": published.params, "pixel_center": 0.0}
    assert read_camera(written(tmp_path / "camera.json", file)).params == pytest.approx(C3VD.params)


def test_colmap_models_are_read(tmp_path):
    file = {"model": "SIMPLE_RADIAL", "width": 640, "height": 480, "params": [500, 320, 240, -0.1]}
    camera = read_camera(written(tmp_path / "camera.json", file))
    assert (camera.name, camera.params) == ("OPENCV", (500, 500, 320, 240, -0.1, 0, 0, 0))


BAD_CAMERAS = {
    "fx is not known": {**PINHOLE_FILE, "fx": 500},
    "width missing": {k: v for k, v in PINHOLE_FILE.items() if k != "width"},
    "pixel_center": {**PINHOLE_FILE, "pixel_center": 0.25},
    "params.1": {**PINHOLE_FILE, "params": [500, "wide", 320, 240]},
    "unknown camera model 'MEI'": {**PINHOLE_FILE, "model": "MEI"},
    "3 parameters of PINHOLE": {**PINHOLE_FILE, "params": [500, 320, 240]},
    "PINHOLE camera … focal lengths": {**PINHOLE_FILE, "params": [-500, 500, 320, 240]},
    "cx not finite": '{"model": "PINHOLE", "width": 640, "height": 480, "params": [500, 500, NaN, 240]}',
    "size … 0x480": {**PINHOLE_FILE, "width": 0},
    "not valid JSON": "{'model': PINHOLE",
    "the file: found list": [1, 2],
}


@pytest.mark.parametrize("message", BAD_CAMERAS)
def test_a_camera_file_that_cannot_be_used_is_refused_by_name(tmp_path, message):
    with refused(message, where="camera.json"):
        read_camera(written(tmp_path / "camera.json", BAD_CAMERAS[message]))


def test_a_missing_file_and_one_that_is_no_text_are_refused_by_name(tmp_path):
    with refused(where="none.json", found="cannot be read (No such file"):
        read_json(tmp_path / "none.json")
    with refused(found="a folder, not a file"):
        read_json(tmp_path)
    (tmp_path / "image.json").write_bytes(b"\x89PNG\xff\xfe")
    with refused(where="image.json", found="not UTF-8"):
        read_json(tmp_path / "image.json")


def test_lights_survive_their_file(tmp_path):
    light = PhotometricCalibration(2.1, 1.5, (0.5, -1, 3), (0.1, 0, 0.9), 80.0, 0.4, "measured")
    write_light(light, tmp_path / "light.json")
    again = read_light(tmp_path / "light.json")
    assert again.direction == pytest.approx(light.direction, rel=1e-12)
    assert (again.gamma, again.mu, again.position_mm, again.gain, again.reflectance, again.source) == (
        light.gamma,
        light.mu,
        light.position_mm,
        light.gain,
        light.reflectance,
        light.source,
    )


def test_what_a_light_file_leaves_out_is_the_default_and_the_light_was_given(tmp_path):
    light = read_light(written(tmp_path / "light.json", {"gamma": 1.6}))
    assert light == PhotometricCalibration(gamma=1.6, source="given")


@pytest.mark.parametrize("text", ["gamma=2.2,mu=0", "gamma=2.2, mu=0", "mu=0"])
def test_a_light_can_be_written_out_on_the_command_line(text):
    assert read_light(text) == PhotometricCalibration(gamma=2.2, mu=0.0, source="given")


def test_a_file_whose_name_has_an_equals_sign_is_still_a_file(tmp_path):
    path = written(tmp_path / "mu=0.json", {"mu": 1.0})
    assert read_light(path).mu == 1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gama=2.2", "gama is not known … is gamma meant"),
        ("gamma=bright", "gamma … 'bright' … nput should be a valid number"),
        ("gamma=2.2,mu", "name=number pairs"),
        ("position_mm=1,2,3", "name=number pairs"),
        ("gamma=50", "gamma 50.0"),
        ("source=guessed", "source"),
    ],
)
def test_a_light_written_wrongly_is_refused_with_what_was_typed(text, message):
    with refused(f"--light {text}", message):
        read_light(text)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"sigma": 1.0}, "sigma is not known"),
        ({"position_mm": [0, 0]}, "position_mm"),
        ({"direction": [0, 0, 0]}, "direction is zero"),
        ({"mu": -1}, "mu -1.0"),
        ("{", "not valid JSON"),
    ],
)
def test_a_light_file_that_cannot_be_used_is_refused_by_name(tmp_path, data, message):
    with refused(where="light.json", found=message):
        read_light(written(tmp_path / "light.json", data))


def test_a_light_that_is_neither_file_nor_values_is_refused():
    with refused(where="nowhere.json", found="cannot be read"):
        read_light("nowhere.json")
