"""Calibration files of other programs: what they mean, what comes back, and what is refused by name."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import refused
from scenes import BROWN, C3VD, ENDOMAPPER, PINHOLE

from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.datasets.c3vd import C3VD_V2
from lightdepth.errors import InputError
from lightdepth.photometry import PhotometricCalibration

RADIAL = replace(BROWN, p1=0.0, p2=0.0)
GEOMETRY = """<rig><camera><camera_model type="calibu_fu_fv_u0_v0_kb4" version="8">
<width> 1440 </width> <height> 1080 </height> <right> [ 1; 0; 0 ] </right>
<params> [ 726.7941; 727.7907; 742.7416; 542.1428; -0.1289632; -0.006051189; 0.001660961; -7.847858e-05 ] </params>
</camera_model><pose><T_wc> [ 1, 0 ] </T_wc></pose></camera></rig>"""
PHOTOMETRY = """<rig><camera><camera_model type="gamma"><gamma> [ 2.2 ] </gamma></camera_model></camera>
<light><light_model type="sls" version="1.0"><sigma> 1.000000 </sigma><mu> 2.767302 </mu>
<P> [ -6.1e-05; -0.001135; -0.003612 ] </P><D> [ 0.011092; 0.0; 0.999938 ] </D></light_model></light></rig>"""
YAML = """%YAML:1.0
---
calibration_time: "today"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 319.5, 0., 5.05e+02, 239.5, 0., 0., 1. ]
distortion_model: plumb_bob
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.2, 0.05, 1e-3, -7e-4, 0. ]
"""
OCAM = """#polynomial coefficients for the DIRECT mapping function

5 -769.2 0.0 8.1e-04 -6.2e-07 1.2e-09

#polynomial coefficients for the inverse mapping function

3 1.0 2.0 3.0

#center: "row" and "column", starting from 0 (C convention)

542.0 678.0

#affine parameters "c", "d", "e"

0.999 0.003 -0.002

#image size: "height" and "width"

1080 1350
"""
HAMLYN = "383.1 0 155.9 0\n0 383.2 124.3 0\n0 0 1 0\n0 0 0 1\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("suffix", "camera"),
    [(s, c) for s in ("json", "yaml", "txt") for c in (PINHOLE, BROWN, ENDOMAPPER)]
    + [("xml", c) for c in (PINHOLE, RADIAL, ENDOMAPPER, C3VD)],
    ids=lambda v: v if isinstance(v, str) else v.name,
)
def test_a_camera_survives_the_files_that_can_hold_it(tmp_path, suffix, camera):
    path = tmp_path / f"camera.{suffix}"
    write_camera(camera, path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = read_camera(path)
    assert type(again) is type(camera) and (again.width, again.height) == (camera.width, camera.height)
    assert again.params == pytest.approx(camera.params, rel=1e-14)


@pytest.mark.parametrize(("suffix", "camera"), [("yaml", C3VD), ("txt", C3VD), ("xml", BROWN)])
def test_a_camera_that_a_format_cannot_hold_is_refused_with_the_way_out(tmp_path, suffix, camera):
    with pytest.raises(InputError, match=rf"camera\.{suffix}: .*convert-camera .*--model \w+"):
        write_camera(camera, tmp_path / f"camera.{suffix}")
    assert not (tmp_path / f"camera.{suffix}").exists()
    with refused(where="camera.dat", found="no camera format ends in '.dat'"):
        write_camera(camera, tmp_path / "camera.dat")


@pytest.mark.parametrize(("name", "format"), [("calib_results.txt", None), ("mine.dat", "ocamcalib")])
@pytest.mark.parametrize("camera", [C3VD, C3VD_V2, C3VD.resized(300, 216)], ids=["v1", "v2", "resized"])
def test_ocamcalib_holds_a_scaramuzza_camera(tmp_path, name, format, camera):
    write_camera(camera, tmp_path / name, format)
    again = read_camera(tmp_path / name)
    assert isinstance(again, Scaramuzza) and (again.width, again.height) == (camera.width, camera.height)
    np.testing.assert_allclose(again.params, camera.params, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("camera", [C3VD, C3VD_V2, C3VD.resized(300, 216)], ids=["v1", "v2", "resized"])
def test_the_toolbox_projects_with_the_inverse_polynomial_as_we_do(tmp_path, camera):
    """world2cam by hand: x down, y right, z backward; rho a polynomial of atan(z / hypot(x, y))."""
    write_camera(camera, tmp_path / "calib_results.txt")
    numbers = [
        [float(v) for v in line.split()]
        for line in (tmp_path / "calib_results.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    (_, *inverse), (row, column), (c, d, e) = numbers[1:4]
    theta, phi = np.radians([0.5, 10, 40, 60, 85])[:, None], np.radians([0, 100, 190, 300])
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1)
    x, y, z = points[..., 1], points[..., 0], -points[..., 2]
    side = np.hypot(x, y)
    rho = np.polyval(inverse[::-1], np.arctan(z / side))
    x, y = x / side * rho, y / side * rho
    theirs = np.stack([e * x + y + column, c * x + d * y + row], -1) + 0.5
    np.testing.assert_allclose(theirs, camera.project(points)[0], atol=0.02)


@pytest.mark.parametrize(("format", "side"), [(None, 3), ("intrinsics", 3), ("intrinsics4x4", 4)])
def test_intrinsics_hold_a_pinhole_without_its_size(tmp_path, format, side):
    write_camera(PINHOLE, tmp_path / "intrinsics.txt", format)
    assert np.loadtxt(tmp_path / "intrinsics.txt").shape == (side, side)
    assert np.loadtxt(tmp_path / "intrinsics.txt")[0, 2] == PINHOLE.cx - 0.5
    assert read_camera(tmp_path / "intrinsics.txt", (640, 480)) == PINHOLE


def test_a_format_without_a_place_for_the_camera_names_the_models_it_has(tmp_path):
    for camera, format, message in (
        (PINHOLE, "ocamcalib", "ocamcalib has no PINHOLE camera … --model SCARAMUZZA"),
        (BROWN, "intrinsics", "intrinsics.txt has no OPENCV camera … --model PINHOLE"),
        (BROWN, "vicalib", "tangential terms … it can be converted to OPENCV_FISHEYE or PINHOLE"),
        (C3VD.resized(1350, 200), "ocamcalib", "ocamcalib's is about 1: resize"),
        (PINHOLE, "kalibr", "format 'kalibr' is not known"),
    ):
        with refused(message):
            write_camera(camera, tmp_path / "camera.txt", format)
        assert not list(tmp_path.iterdir())


def test_vicalib_s_first_pixel_is_at_0_and_its_lens_is_kannala_brandt(tmp_path):
    camera = read_camera(written(tmp_path / "g.xml", GEOMETRY))
    assert isinstance(camera, KannalaBrandt)
    assert camera == ENDOMAPPER.with_pixel_center(0.0)
    assert camera.cx == 742.7416 + 0.5


def test_poly2_is_brown_without_tangential_terms(tmp_path):
    params = "[ 500; 505; 719.5; 539.5; -0.2; 0.05 ]"
    text = GEOMETRY.replace("kb4", "k1_k2")
    text = text[: text.index("<params>")] + f"<params> {params}" + text[text.index("</params>") :]
    camera = read_camera(written(tmp_path / "g.xml", text))
    assert camera == Brown(1440, 1080, 500, 505, 720, 540, -0.2, 0.05, 0, 0)
    radius = 0.5  # by hand: u = fu r (1 + k1 r^2 + k2 r^4) + u0
    u = 500 * radius * (1 - 0.2 * radius**2 + 0.05 * radius**4) + 720
    assert camera.project(np.array([radius, 0, 1.0]))[0] == pytest.approx((u, 540))


def test_opencv_projects_as_the_camera_read_from_what_it_wrote(tmp_path):
    """cv2 itself writes the file and projects; half a pixel lies between the two conventions."""
    matrix = np.array([[300.0, 0, 321.25], [0, 305.0, 238.75], [0, 0, 1]])
    points = np.random.default_rng(0).normal(0, 0.25, (50, 3)) + (0, 0, 1.0)
    for model, k in (("plumb_bob", [-0.2, 0.05, 1e-3, -7e-4]), ("fisheye", [-0.12, -0.006, 0.002, -1e-4])):
        storage = cv2.FileStorage(str(tmp_path / f"{model}.yaml"), cv2.FILE_STORAGE_WRITE)
        for key, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", matrix)):
            storage.write(key, value)
        storage.write("distortion_model", model)
        storage.write("distortion_coefficients", np.array(k))
        storage.release()
        camera = read_camera(tmp_path / f"{model}.yaml")
        zero = np.zeros(3)
        if model == "fisheye":
            theirs = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, np.array(k))[0]
        else:
            theirs = cv2.projectPoints(points, zero, zero, matrix, np.array(k))[0]
        np.testing.assert_allclose(camera._pixels(points)[0], theirs[:, 0] + 0.5, atol=1e-9)


@pytest.mark.parametrize("camera", [PINHOLE, BROWN, ENDOMAPPER], ids=lambda c: c.name)
def test_opencv_reads_what_is_written_for_it(tmp_path, camera):
    write_camera(camera, tmp_path / "camera.yaml")
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("image_width").real() == camera.width
    assert storage.getNode("camera_matrix").mat()[0, 2] == pytest.approx(camera.cx - 0.5)
    found = storage.getNode("distortion_coefficients").mat().ravel()
    expected = (*camera.params[4:], 0, 0, 0, 0, 0)[: len(found)]
    assert found == pytest.approx(expected)


def test_opencv_s_yaml_is_understood_in_its_variants(tmp_path):
    camera = Brown(640, 480, 500, 505, 320, 240, -0.2, 0.05, 1e-3, -7e-4)
    nested = YAML[: YAML.index("camera_matrix")] + (
        "Camera_Matrix: [[500, 0, 319.5], [0, 505, 239.5], [0, 0, 1]]\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 5e-2, 1e-3, -7e-4, 0]}\n"
    )
    assert read_camera(written(tmp_path / "a.yaml", YAML)) == camera
    assert read_camera(written(tmp_path / "b.yml", nested)) == camera
    assert read_camera(written(tmp_path / "without_suffix", YAML)) == camera


def test_four_coefficients_without_a_model_are_brown_s_and_said_to_be(tmp_path):
    text = YAML.replace("distortion_model: plumb_bob\n", "").replace("rows: 5", "rows: 4").replace(", 0. ]", " ]")
    with pytest.warns(UserWarning, match=r"4 numbers and no distortion_model.*distortion_model: fisheye"):
        assert isinstance(read_camera(written(tmp_path / "a.yaml", text)), Brown)
    text = text.replace("distortion_coeff", "distortion_model: equidistant\ndistortion_coeff")
    assert isinstance(read_camera(written(tmp_path / "a.yaml", text)), KannalaBrandt)


def test_ocamcalib_s_rays_are_its_own_formula_s_turned_to_our_axes(tmp_path):
    """The slow reference: (row, column) -> (x, y, ss(rho)) in the toolbox's axes, x down, y right, z backward."""
    camera = read_camera(written(tmp_path / "calib_results.txt", OCAM))
    assert isinstance(camera, Scaramuzza) and (camera.width, camera.height) == (1350, 1080)
    assert (camera.cx, camera.cy) == (678.5, 542.5)
    stretch, ss = np.array([[0.999, 0.003], [-0.002, 1.0]]), [-769.2, 0.0, 8.1e-4, -6.2e-7, 1.2e-9]
    for row, column in ((0, 0), (542, 678), (100.0, 1200.0), (900.5, 300.25)):
        x, y = np.linalg.inv(stretch) @ (row - 542, column - 678)
        rho = np.hypot(x, y)
        ray = np.array([y, x, -sum(s * rho**i for i, s in enumerate(ss))])
        found = camera.unproject(np.array([column + 0.5, row + 0.5]))[0]
        np.testing.assert_allclose(found, ray / np.linalg.norm(ray), atol=1e-12)


def test_intrinsics_are_a_pinhole_of_the_given_size(tmp_path):
    expected = Pinhole(320, 240, 383.1, 383.2, 156.4, 124.8)
    assert read_camera(written(tmp_path / "intrinsics.txt", HAMLYN), (320, 240)) == expected
    three = "383.1, 0, 155.9\n0, 383.2, 124.3\n0, 0, 1\n"
    assert read_camera(written(tmp_path / "intrinsics.txt", three), (320, 240)) == expected
    with refused(where="intrinsics.txt", found="holds no image size", cure="pixel_center"):
        read_camera(tmp_path / "intrinsics.txt")


def test_a_colmap_file_has_to_hold_one_camera(tmp_path):
    one = "# CAMERA_ID MODEL\n7 SIMPLE_PINHOLE 640 480 500 320.0 240.0\n"
    assert read_camera(written(tmp_path / "cameras.txt", one)) == Pinhole(640, 480, 500, 500, 320, 240)
    two = one + "9 PINHOLE 640 480 500 500 320 240\n"
    with refused(where="cameras.txt", found="2 cameras, with ids 7, 9"):
        read_camera(written(tmp_path / "cameras.txt", two))


BOMB = '<?xml version="1.0"?><!DOCTYPE rig [<!ENTITY a "1"><!ENTITY b "&a;&a;">]>' + GEOMETRY
BAD = {
    "entities": ("g.xml", BOMB, "DTD or entities"),
    "broken": ("g.xml", GEOMETRY[:-8], "not valid XML"),
    "no params": ("g.xml", GEOMETRY.replace("params", "parms"), "params: missing; expected 8 numbers"),
    "no width": ("g.xml", GEOMETRY.replace("width", "w"), "width: missing"),
    "half a pixel": ("g.xml", GEOMETRY.replace(" 1440 ", " 1440.5 "), r"width 1440\.5; expected whole pixels"),
    "type": ("g.xml", GEOMETRY.replace("kb4", "w"), "type 'calibu_fu_fv_u0_v0_w' is not known; expected one of .*kb4"),
    "EndoMapper's own type": (
        "g.xml",
        GEOMETRY.replace("calibu_fu_fv_u0_v0_kb4", "ocamcalib_cx_cy_a0_a2_a3_a4_e_f_g"),
        "params: 8 numbers; expected 9",
    ),
    "count": ("g.xml", GEOMETRY.replace("542.1428; ", ""), "params: 7 numbers; expected 8"),
    "word": ("g.xml", GEOMETRY.replace("542.1428", "wide"), "params: found 'wide', which is not a number"),
    "not finite": ("g.xml", GEOMETRY.replace("542.1428", "nan"), "params: nan is not finite"),
    "swapped": (
        "g.xml",
        GEOMETRY.replace("1440", "x").replace("1080", "1440").replace("x", "1080", 1),
        "look swapped",
    ),
    "two": ("g.xml", GEOMETRY.replace("<rig>", "<rig><camera_model/>"), "2 elements camera_model; expected one"),
    "photometric": ("g.xml", PHOTOMETRY, "a photometric calibration .*--light"),
    "opencv xml of no camera": ("g.xml", "<opencv_storage/>", "camera_matrix missing"),
    "opencv xml with entities": (
        "g.xml",
        '<!DOCTYPE a [<!ENTITY a "1">]><opencv_storage><K>&a;</K></opencv_storage>',
        "DTD or entities",
    ),
    "opencv xml broken": ("g.xml", "<opencv_storage><K></opencv_storage>", "not valid XML"),
    "yaml model": ("a.yaml", YAML.replace("plumb_bob", "division_x"), "'division_x' is not known"),
    "yaml omni": ("a.yaml", YAML + "camera_model: omni\n", "cameramodel 'omni' is not known"),
    "yaml fisheye of 5": ("a.yaml", YAML.replace("plumb_bob", "fisheye"), "5 numbers; the model fisheye has 4"),
    "yaml 8": ("a.yaml", YAML.replace("rows: 5", "rows: 8"), "5 numbers for 8 rows"),
    "yaml skew": ("a.yaml", YAML.replace("500., 0.,", "500., 0.3,"), "camera_matrix: found 500 0.3"),
    "yaml nan": ("a.yaml", YAML.replace("319.5", ".NaN"), "camera_matrix: nan is not finite"),
    "yaml no size": ("a.yaml", YAML.replace("image_width", "broad"), "image_width missing"),
    "yaml no coefficients": (
        "a.yaml",
        YAML[: YAML.index("distortion_coeff")],
        r"distortion_coefficients missing; .*zer",
    ),
    "yaml code": ("a.yaml", YAML + "x: !!python/object/apply:os.getcwd []\n", "not valid YAML"),
    "yaml list": ("a.yaml", "- 1\n- 2\n", "no keys in it"),
    "yaml outside": ("a.yaml", YAML.replace("319.5", "2319.5"), "lies outside it; .*another image size"),
    "ocam sign": ("o.txt", OCAM.replace("-769.2", "769.2"), "polynomial starts with 769.2; expected a negative"),
    "ocam count": ("o.txt", OCAM.replace("5 -769", "6 -769"), "5 coefficients after the count 6"),
    "ocam degree": (
        "o.txt",
        OCAM.replace("5 -769", "6 -769").replace("1.2e-09", "1.2e-09 1e-12"),
        "degree 5; expected 4",
    ),
    "ocam size": ("o.txt", OCAM.replace("1080 1350", "1350 1080"), "look swapped"),
    "ocam centre": ("o.txt", OCAM.replace("542.0 678.0", "542.0"), "centre: 1 numbers; expected row and column"),
    "intrinsics count": ("i.txt", "500 0 320 0 500 240", "6 numbers; expected a camera matrix"),
    "intrinsics transposed": ("i.txt", "500 0 0\n0 500 0\n320 240 1", "not a camera matrix; it looks transposed"),
    "intrinsics skew": ("i.txt", "500 1 320\n0 500 240\n0 0 1", "skew 1 in the first row"),
    "intrinsics word": ("i.txt", "500 0 cx\n0 500 240\n0 0 1", "found 'cx', which is not a number"),
    "colmap params": ("cameras.txt", "1 PINHOLE 640 480 500 320 240\n", "line 1: 3 parameters of PINHOLE; expected 4"),
    "colmap model": ("cameras.txt", "1 EQUIRECTANGULAR 640 480 640 480\n", "unknown camera model 'EQUIRECTANGULAR'"),
    "colmap nan": ("cameras.txt", "1 PINHOLE 640 480 500 nan 320 240\n", "fy not finite"),
    "prose": (
        "readme.txt",
        "The camera is good.\n",
        "not a camera calibration that is known; expected camera.json, vic",
    ),
    "empty": ("empty.xml", "", "not a camera calibration that is known"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_calibration_that_cannot_be_used_is_refused_by_file_and_field(tmp_path, case):
    name, text, message = BAD[case]
    with pytest.raises(InputError, match=rf"{name}\b.*{message}"):
        read_camera(written(tmp_path / name, text), (640, 480))


def test_an_image_or_a_folder_is_no_calibration(tmp_path):
    (tmp_path / "frame.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\xff")
    with refused(where="frame.png", found="not a text file", cure="expected camera.json"):
        read_camera(tmp_path / "frame.png")
    with refused(found="a folder, not a file"):
        read_camera(tmp_path)
    with refused(found="a folder, not a file"):
        read_light(tmp_path)


def test_the_photometric_xml_s_metres_become_millimetres(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        light = read_light(written(tmp_path / "p.xml", PHOTOMETRY))
    assert (light.gamma, light.mu, light.gain, light.source) == (2.2, 2.767302, 1.0, "measured")
    assert light.position_mm == pytest.approx((-0.061, -1.135, -3.612))
    assert light.direction == pytest.approx((0.011092, 0, 0.999938), abs=1e-6)


def test_a_light_survives_the_photometric_xml(tmp_path):
    light = PhotometricCalibration(2.1, 1.5, (0.5, -1, 3), (0.1, 0, 0.9), source="measured")
    write_light(light, tmp_path / "light.xml")
    again = read_light(tmp_path / "light.xml")
    assert (again.gamma, again.mu, again.source) == (light.gamma, light.mu, "measured")
    assert again.position_mm == pytest.approx(light.position_mm) and again.direction == pytest.approx(light.direction)


def test_what_the_model_of_the_light_lacks_is_said(tmp_path):
    vignetting = PHOTOMETRY.replace("</gamma>", "</gamma><vignetting> [ 2.5 ] </vignetting><other/>")
    with pytest.warns(UserWarning, match="vignetting is ignored"):
        assert read_light(written(tmp_path / "p.xml", vignetting)).mu == 2.767302
    with pytest.warns(UserWarning, match="sigma 2 is ignored"):
        assert read_light(written(tmp_path / "p.xml", PHOTOMETRY.replace("1.000000", "2.0"))).gain == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<mu> 2.767302 </mu>", "", "mu … missing … expected 1 number"),
        ("<P> [ -6.1e-05; -0.001135", "<P> [ -0.001135", "2 numbers … expected 3"),
        ("-0.003612", "-3.612", "P is 3.612 from the lens"),
        ("0.011092; 0.0; 0.999938", "0; 0; 0", "direction is zero"),
        ("[ 2.2 ]", "[ inf ]", "gamma … inf is not finite"),
        ("[ 2.2 ]", "[ 22 ]", "gamma 22"),
        ('"sls"', '"area"', "light_model type 'area' is not known"),
        ("<rig>", "<!DOCTYPE rig><rig>", "DTD or entities"),
    ],
)
def test_a_photometric_xml_that_cannot_be_used_is_refused_by_file_and_field(tmp_path, old, new, message):
    assert old in PHOTOMETRY
    with refused(message, where="p.xml"):
        read_light(written(tmp_path / "p.xml", PHOTOMETRY.replace(old, new)))


def test_the_two_xml_files_of_an_endoscope_are_not_mistaken_for_each_other(tmp_path):
    with refused(found="a geometric calibration", cure="--camera"):
        read_light(written(tmp_path / "g.xml", GEOMETRY))


def test_endomapper_s_layout_is_read_from_the_sample_files(realdata):
    folder = realdata / "endomapper_assets"
    camera: CameraModel = read_camera(folder / "Endoscope_sample_geometrical.xml")
    assert camera == ENDOMAPPER.with_pixel_center(0.0)
    light = read_light(folder / "Endoscope_sample_photometrical.xml")
    assert np.linalg.norm(light.position_mm) == pytest.approx(3.787, abs=1e-3)
    with refused(where="pattern.xml", found="no elements camera_model"):
        read_camera(folder / "pattern.xml")
