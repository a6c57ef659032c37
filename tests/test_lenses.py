"""Lenses as other programs write them: exact where ours are the same formula, else the nearest, said in pixels."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from foreign_lenses import COLMAP_LENSES, FORMATS, drawn, pycolmap_pixels
from raising import refused, warned

from lightdepth.calibration import read_camera, write_camera
from lightdepth.camera import CameraModel, FullBrown, KannalaBrandt, Pinhole, Scaramuzza, camera_from_params
from lightdepth.camera.foreign import LARGEST_ERROR_PX, ForeignLens, _samples, fov_bend, nearest, opencv_bend
from lightdepth.cli import main
from lightdepth.maps import read_map
from lightdepth.native import pycolmap

K = [[400.0, 0.0, 320.5], [0.0, 405.0, 238.5], [0.0, 0.0, 1.0]]
FISHEYE = [0.02, -0.004, 0.001, -0.0002]
SIZE = {"image_width": 640, "image_height": 480}


def written(path: Path, content: object) -> Path:
    text = (
        content if isinstance(content, str) else json.dumps(content) if path.suffix == ".json" else yaml.dump(content)
    )
    path.write_text(text)
    return path


def silently(path: Path, size: tuple[int, int] | None = None) -> CameraModel:
    """The camera of a file that is to be read without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_camera(path, size)


def rays_of(camera: CameraModel) -> np.ndarray:
    """(n, 3) rays through the image, a pixel from its border, where the lens can be inverted."""
    u, v = np.meshgrid(np.linspace(1, camera.width - 1, 23), np.linspace(1, camera.height - 1, 17))
    rays, valid = camera.unproject(np.stack([u, v], -1))
    return rays[valid]


def opencv_pixels(rays: np.ndarray, matrix: object, terms: object, fisheye: bool = False) -> np.ndarray:
    """cv2's pixels, the first one's centre at (0.5, 0.5)."""
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    points, still = rays[None], np.zeros(3)
    found = project(points, still, still, np.array(matrix, float), np.array(terms, float))[0]
    return found.reshape(-1, 2) + 0.5


def off(camera: CameraModel, pixels: np.ndarray, rays: np.ndarray) -> float:
    return float(np.abs(camera.project(rays)[0] - pixels).max())


# ---- exact


@pytest.mark.parametrize("name", [name for name, lens in COLMAP_LENSES.items() if lens.exact])
def test_a_colmap_lens_that_is_one_of_ours_is_read_exactly_from_text_and_binary(tmp_path, name):
    lens = COLMAP_LENSES[name]
    model = pycolmap().Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap().Camera(camera_id=1, model=lens.model, width=640, height=480, params=lens.params)
    )
    model.write_text(tmp_path)
    model.write_binary(tmp_path)
    for file in ("cameras.txt", "cameras.bin"):
        camera = silently(tmp_path / file)
        assert camera.name == lens.exact
        rays = rays_of(camera)
        assert off(camera, pycolmap_pixels(lens, rays), rays) < 1e-9


def test_a_map_taken_with_a_colmap_fisheye_is_read(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_FISHEYE 640 480 400 320 240\n")
    (tmp_path / "images.txt").write_text(
        "1 1 0 0 0 0 0 0 1 000001.png\n320 240 7\n2 1 0 0 0 0.5 0 0 1 000002.png\n359.867 240 7\n"
    )
    (tmp_path / "points3D.txt").write_text("7 0 0 5 9 9 9 0.1\n")
    (submap,) = read_map(tmp_path).submaps
    assert submap.keyframes[0].camera == KannalaBrandt(640, 480, 400, 400, 320, 240, 0, 0, 0, 0)


def test_endomapper_s_fourth_type_is_scaramuzza_with_its_stretch(tmp_path):
    params = "678.54; 542.97; 769.24; -8.1e-4; 6.2e-7; -1.2e-9; 0.99998; 0.00288; -0.00296"
    text = (
        '<rig><camera><camera_model type="ocamcalib_cx_cy_a0_a2_a3_a4_e_f_g"><width> 1350 </width>'
        f"<height> 1080 </height><params> [ {params} ] </params></camera_model></camera></rig>"
    )
    camera = silently(written(tmp_path / "g.xml", text))
    assert camera == Scaramuzza(
        1350, 1080, 679.04, 543.47, 769.24, 0.0, -8.1e-4, 6.2e-7, -1.2e-9, 0.99998, 0.00288, -0.00296
    )
    write_camera(camera, tmp_path / "again.xml")
    assert silently(tmp_path / "again.xml").params == pytest.approx(camera.params, rel=1e-14)


def test_vicalib_s_poly3_is_opencv_s_k3(tmp_path):
    text = (
        '<rig><camera><camera_model type="calibu_fu_fv_u0_v0_k1_k2_k3"><width> 640 </width><height> 480 </height>'
        "<params> [ 400; 405; 320.5; 238.5; -0.2; 0.05; -0.01 ] </params></camera_model></camera></rig>"
    )
    camera = silently(written(tmp_path / "g.xml", text))
    rays = rays_of(camera)
    assert off(camera, opencv_pixels(rays, K, [-0.2, 0.05, 0, 0, -0.01]), rays) < 1e-9
    write_camera(camera, tmp_path / "again.xml")
    assert silently(tmp_path / "again.xml") == camera


@pytest.mark.parametrize("count", [4, 5, 8])
def test_opencv_s_coefficients_are_exact_with_k3_and_the_rational_terms(tmp_path, count):
    terms = [-0.2664, -0.0386, 0.0018, -0.0003, 0.2384, 0.02, 0.01, 0.003][:count]
    file = written(tmp_path / "a.yaml", {**SIZE, "camera_matrix": K, "dist": [terms], "camera_model": "opencv"})
    assert main(["convert-camera", str(file), "-o", str(tmp_path / "camera.json")]) == 0
    camera = silently(tmp_path / "camera.json")
    rays = rays_of(camera)
    assert len(rays) > 250
    assert off(camera, opencv_pixels(rays, K, terms), rays) < 1e-9
    write_camera(camera, tmp_path / "again.yaml")
    assert silently(tmp_path / "again.yaml").params == pytest.approx(camera.params, rel=1e-14)


@pytest.mark.parametrize("fisheye", [False, True])
def test_opencv_s_xml_is_read_as_its_yaml(tmp_path, fisheye):
    terms = FISHEYE if fisheye else [-0.2664, -0.0386, 0.0018, -0.0003, 0.2384]
    storage = cv2.FileStorage(str(tmp_path / "a.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 3 Mar 2025")
    storage.startWriteStruct("image_size", cv2.FileNode_SEQ)
    for side in (640, 480):
        storage.write("", side)
    storage.endWriteStruct()
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([terms]))
    storage.write("per_view_errors", np.array([0.3, 0.2]))
    if fisheye:
        storage.write("camera_model", "fisheye")
    storage.release()
    assert main(["convert-camera", str(tmp_path / "a.xml"), "-o", str(tmp_path / "camera.json")]) == 0
    camera = silently(tmp_path / "camera.json")
    rays = rays_of(camera)
    assert len(rays) > 250
    assert off(camera, opencv_pixels(rays, K, terms, fisheye), rays) < 1e-9


def test_a_matrix_without_a_size_is_told_of_the_option_that_gives_one(tmp_path, capsys):
    file = written(tmp_path / "a.yaml", {"K": K, "D": [0.0] * 5})
    argv = ["convert-camera", str(file), "-o", str(tmp_path / "camera.json")]
    assert main(argv) == 3 and "--size" in capsys.readouterr().err
    assert main([*argv, "--size", "[640, 480]"]) == 0


# ---- by fit


@pytest.mark.parametrize("name", [name for name, lens in COLMAP_LENSES.items() if not lens.exact])
def test_a_colmap_lens_that_is_none_of_ours_is_the_nearest_and_its_residual_is_said(tmp_path, name):
    lens = COLMAP_LENSES[name]
    file = written(tmp_path / "cameras.txt", f"1 {lens.model} 640 480 {' '.join(map(repr, lens.params))}\n")
    with pytest.warns(UserWarning, match=r"the nearest of ours: off by .* pixels \(median\), (.*) \(largest\)") as said:
        camera = read_camera(file)
    largest = float(str(said[0].message).split("(median), ")[1].split(" ")[0])
    rays = rays_of(camera)
    assert off(camera, pycolmap_pixels(lens, rays), rays) <= 1.6 * largest + 1e-6 <= 1.6 * LARGEST_ERROR_PX


@pytest.mark.parametrize("name", [name for name, lens in COLMAP_LENSES.items() if not lens.exact])
def test_a_colmap_lens_that_is_fitted_to_is_colmap_s_own_from_the_order_of_its_parameters_on(name, monkeypatch):
    monkeypatch.setattr("lightdepth.camera.params.nearest", lambda lens, where: lens)
    given = COLMAP_LENSES[name]
    lens = camera_from_params(given.model, 640, 480, list(given.params))
    rays = np.random.default_rng(0).normal(0, 0.5, (40, 3)) + (0, 0, 1.6)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert isinstance(lens, ForeignLens) and (lens.name, lens.width, lens.height) == (
        given.model.removeprefix("SIMPLE_"),
        640,
        480,
    )
    np.testing.assert_allclose(lens.pixels(rays), pycolmap_pixels(given, rays), atol=1e-9)


def test_a_lens_that_none_of_ours_comes_near_is_refused_with_the_residual(tmp_path, capsys):
    lens = {**SIZE, "camera_matrix": K, "distortion_coefficients": [-0.2, 0.05, 0, 0, 0, 0, 0, 0, 0.05, 0, -0.05, 0]}
    file = written(tmp_path / "a.yaml", lens)
    assert main(["convert-camera", str(file), "-o", str(tmp_path / "camera.json")]) == 3
    said = " ".join(capsys.readouterr().err.split())
    assert "thin-prism lens: the nearest of ours" in said and "expected 1 at most" in said
    small = {**lens, "distortion_coefficients": [-0.2, 0.05, 0, 0, 0, 0, 0, 0, 1e-3, 0, -1e-3, 0]}
    with pytest.warns(UserWarning, match="thin-prism lens read as"):
        camera = read_camera(written(tmp_path / "b.yaml", small))
    rays = rays_of(camera)
    assert off(camera, opencv_pixels(rays, K, small["distortion_coefficients"]), rays) < LARGEST_ERROR_PX
    with refused(found="a tilted sensor"):
        read_camera(written(tmp_path / "c.yaml", {**lens, "distortion_coefficients": [*[0.0] * 12, 0.01, 0]}))


# ---- read as what they are


@pytest.mark.parametrize(
    "key", ["camera_model", "model", "distortion_model", "lens_type", "Camera-Model", "projection"]
)
@pytest.mark.parametrize("word", ["fisheye", "equidistant", "KannalaBrandt8", "opencv_fisheye"])
def test_a_fisheye_is_one_by_whatever_key_it_is_called_so(tmp_path, key, word):
    camera = silently(written(tmp_path / "a.yaml", {**SIZE, key: word, "K": K, "D": FISHEYE}))
    rays = rays_of(camera)
    assert isinstance(camera, KannalaBrandt)
    assert off(camera, opencv_pixels(rays, K, FISHEYE, fisheye=True), rays) < 1e-9


@pytest.mark.parametrize("key", ["coefficients", "dist_coeffs", "distortion_params", "D"])
def test_a_fisheye_s_coefficients_are_read_under_whatever_key(tmp_path, key):
    camera = silently(
        written(tmp_path / "a.yaml", {**SIZE, "camera_model": "fisheye", "camera_matrix": K, key: FISHEYE})
    )
    rays = rays_of(camera)
    assert off(camera, opencv_pixels(rays, K, FISHEYE, fisheye=True), rays) < 1e-9


def test_a_name_of_the_endoscope_under_model_says_nothing_of_the_lens(tmp_path):
    content = {**SIZE, "model": "CF-H190L", "camera_matrix": K, "distortion_coefficients": [-0.1, 0.01, 0, 0, 0]}
    assert silently(written(tmp_path / "a.yaml", content)).name == "OPENCV"


@pytest.mark.parametrize("suffix", ["yaml", "json", "txt"])
def test_a_matrix_in_parts_of_the_sides_is_scaled_and_said(tmp_path, suffix):
    parts = [[0.9, 0, 0.5], [0, 1.2, 0.52], [0, 0, 1]]
    if suffix == "txt":
        file = written(tmp_path / "intrinsics.txt", "\n".join(" ".join(map(str, row)) for row in parts))
    else:
        file = written(tmp_path / f"a.{suffix}", {**SIZE, "camera_matrix": parts, "dist_coeffs": [0.0] * 5})
    with pytest.warns(
        UserWarning, match="in fractions of the image's sides: scaled by 640 and 480 to fx 576, fy 576, cx 320"
    ):
        camera = read_camera(file, (640, 480))
    assert isinstance(camera, Pinhole) and camera.params == pytest.approx((576.0, 576.0, 320.5, 250.1))


def test_a_focal_length_below_3_pixels_is_refused_with_what_it_would_be(tmp_path):
    camera = {"model": "PINHOLE", "width": 640, "height": 480, "params": [0.9, 1.2, 0.5, 0.5]}
    for file in (
        written(tmp_path / "camera.json", camera),
        written(tmp_path / "cameras.txt", "1 PINHOLE 640 480 0.9 1.2 0.5 0.5\n"),
    ):
        with refused(found="a focal length of 1.04 pixels", cure="fx 576, fy 576, cx 320, cy 240"):
            read_camera(file)


# ---- the kind, not the case


@pytest.mark.parametrize("case", [*range(24), *(pytest.param(case, marks=pytest.mark.slow) for case in range(24, 200))])
def test_a_lens_drawn_at_random_is_read_in_every_format_that_holds_it(tmp_path, case):
    seed = 7000 + case
    print(f"seed {seed}")
    lens = drawn(np.random.default_rng(seed))
    for name, write in FORMATS.items():
        content = write(lens)
        if content is None:
            continue
        camera = silently(written(tmp_path / name, content), (lens.width, lens.height))
        assert (camera.width, camera.height) == (lens.width, lens.height), name
        rays = rays_of(camera)
        expected = opencv_pixels(rays, lens.matrix, lens.terms, lens.fisheye)
        assert off(camera, expected, rays) < 1e-9, f"{name}: {lens}"
        if isinstance(camera, FullBrown):
            assert any(lens.terms[4:])


@pytest.mark.parametrize(
    ("lens", "found"),
    [
        ({"camera_model": "ds", "intrinsics": [5, 7, 300, 300, 320, 240]}, "alpha 7"),
        ({"camera_model": "eucm", "intrinsics": [60, 1.1, 300, 300, 320, 240]}, "alpha 60"),
        (
            {
                "camera_model": "pinhole",
                "intrinsics": [300, 300, 320, 240],
                "distortion_model": "fov",
                "distortion_coeffs": [50],
            },
            "omega 50",
        ),
    ],
)
def test_numbers_that_no_such_lens_has_are_refused_before_a_lens_is_fitted_to_them(tmp_path, lens, found):
    file = written(tmp_path / "camchain.yaml", {"cam0": {**lens, "resolution": [640, 480]}})
    with refused(found=found):
        read_camera(file)


def test_xml_that_is_nested_without_end_is_refused(tmp_path, capsys):
    text = "<opencv_storage>" + "<a>" * 5000 + "</a>" * 5000 + "</opencv_storage>"
    assert main(["convert-camera", str(written(tmp_path / "a.xml", text)), "-o", str(tmp_path / "c.json")]) == 3
    assert "nested without end" in capsys.readouterr().err


def test_a_refused_coefficient_names_its_file_once(tmp_path, capsys):
    numbers = {"camera_matrix": K, "distortion_coefficients": [1.0] * 7, **SIZE}
    file = written(tmp_path / "a.yaml", numbers)
    assert main(["convert-camera", str(file), "-o", str(tmp_path / "c.json")]) == 3
    assert capsys.readouterr().err.count(str(file)) == 1


def test_a_lens_is_followed_to_where_a_quarter_of_its_resolution_is_left_and_no_farther():
    lens = ForeignLens("turning", 4000, 4000, (1000.0, 1000.0, 2000.0, 2000.0), _turning)
    rays, pixels, area = _samples(lens, "here")
    theta = np.arccos(rays[:, 2])
    assert np.degrees(theta.max()) == pytest.approx(np.degrees(np.sqrt(0.75 / 0.6)), abs=0.4)
    np.testing.assert_allclose(pixels, lens.pixels(rays))
    inner = theta < 0.5  # the image's area between two angles grows with the radius
    np.testing.assert_allclose(area[inner], _area(theta[inner]), rtol=0.02, atol=2.0)


def _turning(rays: np.ndarray) -> np.ndarray:
    """radius = theta - 0.2 theta^3, whose slope 1 - 0.6 theta^2 falls to a quarter at 64 degrees."""
    theta = np.arccos(rays[:, 2])
    side = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-12)
    found: np.ndarray = rays[:, :2] * ((theta - 0.2 * theta**3) / side)[:, None]
    return found


def _area(theta: np.ndarray) -> np.ndarray:
    step = np.radians(89.5) / 499
    return 1000**2 * (theta - 0.2 * theta**3) * (1 - 0.6 * theta**2) * step


def test_a_lens_of_nearly_our_longest_polynomial_becomes_that_and_is_off_by_what_it_lacks():
    bend = opencv_bend((-0.3, 0.1, 1e-3, -5e-4, -0.01, 0.0, 0.0, 0.0, 2e-4, 0.0, -1e-4, 0.0))
    lens = ForeignLens("prism", 640, 480, (420.0, 410.0, 322.0, 238.0), bend)
    with pytest.warns(UserWarning, match="OPENCV") as said:
        camera = nearest(lens, "here")
    assert isinstance(camera, FullBrown) and len(said) == 1
    rays = rays_of(camera)
    assert 0 < off(camera, lens.pixels(rays), rays) < 0.1
    np.testing.assert_allclose(camera.params[:5], (420, 410, 322, 238, -0.3), rtol=0.01)


@pytest.mark.parametrize("center", [(-50.0, 240.0), (700.0, 300.0)], ids=str)
def test_a_lens_whose_axis_lies_outside_its_image_becomes_the_nearest_as_well(center):
    """The image is cut out of a larger one, whose middle it does not hold."""
    with warned("FOV lens read as OPENCV_FISHEYE"):
        camera = camera_from_params("FOV", 640, 480, [400.0, 410.0, *center, 0.9])
    rays = rays_of(camera)
    lens = ForeignLens("FOV", 640, 480, (400.0, 410.0, *center), fov_bend(0.9))
    assert len(rays) > 200 and off(camera, lens.pixels(rays), rays) < 0.02


def test_a_lens_is_sampled_to_the_corners_of_its_image():
    lens = ForeignLens("straight", 640, 480, (410.0, 410.0, 300.0, 260.0), opencv_bend(()))
    _, pixels, _ = _samples(lens, "here")
    for corner in ((0, 0), (640, 0), (0, 480), (640, 480)):
        assert np.linalg.norm(pixels - corner, axis=1).min() < 4
