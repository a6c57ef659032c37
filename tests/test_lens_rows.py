"""Lenses as people hold them, each in its smallest file, through the command line: which of ours they become."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from raising import warned
from scipy.io import savemat

from lightdepth.calibration import read_camera
from lightdepth.cli import main

K = [[400.0, 0.0, 320.0], [0.0, 405.0, 240.0], [0.0, 0.0, 1.0]]
SIZE = {"image_width": 640, "image_height": 480}
FISHEYE = [0.02, -0.004, 0.001, -0.0002]
KALIBR = {
    "camera_model": "pinhole",
    "intrinsics": [400.0, 405.0, 320.0, 240.0],
    "distortion_model": "radtan",
    "distortion_coeffs": [-0.2, 0.05, 0.001, 0.002],
    "resolution": [640, 480],
}
ORB = "%YAML:1.0\nCamera.type: 'KannalaBrandt8'\n" + "".join(
    f"Camera1.{name}: {value}\n"
    for name, value in zip(
        ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), (400, 405, 320, 240, *FISHEYE), strict=True
    )
)
ORB += "Camera.width: 640\nCamera.height: 480\n"


def vicalib(kind: str, numbers: str) -> str:
    size = "<width> 640 </width><height> 480 </height>"
    camera = f'<camera_model type="{kind}">{size}<params> [ {numbers} ] </params></camera_model>'
    return f"<rig><camera>{camera}</camera></rig>"


# The principal point is half a pixel more where files have the first pixel's centre at (0, 0).
EXACT: dict[str, tuple[str, object, str, tuple[float, ...]]] = {
    "COLMAP's SIMPLE_FISHEYE": (
        "cameras.txt",
        "1 SIMPLE_FISHEYE 640 480 400 320 240\n",
        "OPENCV_FISHEYE",
        (400, 400, 320, 240, 0, 0, 0, 0),
    ),
    "COLMAP's FISHEYE": (
        "cameras.txt",
        "1 FISHEYE 640 480 400 405 320 240\n",
        "OPENCV_FISHEYE",
        (400, 405, 320, 240, 0, 0, 0, 0),
    ),
    "FULL_OPENCV with zeros": (
        "cameras.txt",
        "1 FULL_OPENCV 640 480 400 405 320 240 -0.1 0.01 0 0 0 0 0 0\n",
        "OPENCV",
        (400, 405, 320, 240, -0.1, 0.01, 0, 0),
    ),
    "EndoMapper's fourth type": (
        "g.xml",
        vicalib("ocamcalib_cx_cy_a0_a2_a3_a4_e_f_g", "320; 240; 400; -8e-4; 6e-7; -1e-9; 0.9999; 0.003; -0.002"),
        "SCARAMUZZA",
        (320.5, 240.5, 400, 0, -8e-4, 6e-7, -1e-9, 0.9999, 0.003, -0.002),
    ),
    "vicalib's k1 k2 k3": (
        "g.xml",
        vicalib("calibu_fu_fv_u0_v0_k1_k2_k3", "400; 405; 320; 240; -0.2; 0.05; -0.01"),
        "FULL_OPENCV",
        (400, 405, 320.5, 240.5, -0.2, 0.05, 0, 0, -0.01, 0, 0, 0),
    ),
    "OpenCV's k3": (
        "a.yaml",
        {**SIZE, "camera_matrix": K, "distortion_coefficients": [-0.26, -0.03, 0.001, 0.0, 0.23]},
        "FULL_OPENCV",
        (400, 405, 320.5, 240.5, -0.26, -0.03, 0.001, 0, 0.23, 0, 0, 0),
    ),
    "a fisheye by its model, coefficients elsewhere": (
        "a.yaml",
        {**SIZE, "camera_matrix": K, "camera_model": "fisheye", "coefficients": FISHEYE},
        "OPENCV_FISHEYE",
        (400, 405, 320.5, 240.5, *FISHEYE),
    ),
    "Kalibr": (
        "camchain.yaml",
        {"cam0": KALIBR},
        "OPENCV",
        (400, 405, 320.5, 240.5, -0.2, 0.05, 0.001, 0.002),
    ),
    "ORB-SLAM3": ("settings.yaml", ORB, "OPENCV_FISHEYE", (400, 405, 320.5, 240.5, *FISHEYE)),
    "nerfstudio": (
        "transforms.json",
        {
            "fl_x": 400,
            "fl_y": 405,
            "cx": 320,
            "cy": 240,
            "w": 640,
            "h": 480,
            "k1": 0.1,
            "camera_model": "OPENCV_FISHEYE",
        },
        "OPENCV_FISHEYE",
        (400, 405, 320, 240, 0.1, 0, 0, 0),
    ),
    "MATLAB": (
        "a.mat",
        {"fc": [400.0, 405.0], "cc": [320.0, 240.0], "kc": [-0.2, 0.05, 0.0, 0.0, 0.0], "nx": 640, "ny": 480},
        "OPENCV",
        (400, 405, 320.5, 240.5, -0.2, 0.05, 0, 0),
    ),
}


def converted(folder: Path, name: str, content: object, *options: str) -> int:
    """The exit code of convert-camera on a file."""
    file = folder / name
    if file.suffix == ".mat":
        savemat(file, content)
    else:
        text = json.dumps(content) if file.suffix == ".json" else yaml.dump(content)
        file.write_text(content if isinstance(content, str) else text)
    return main(["convert-camera", str(file), "-o", str(folder / "camera.json"), "--overwrite", *options])


@pytest.mark.parametrize("row", EXACT)
@pytest.mark.filterwarnings("error::UserWarning")
def test_a_lens_of_another_program_becomes_ours_to_the_digit(tmp_path, row):
    name, content, model, params = EXACT[row]
    assert converted(tmp_path, name, content) == 0
    camera = read_camera(tmp_path / "camera.json")
    assert (camera.name, camera.width, camera.height) == (model, 640, 480)
    assert camera.params == pytest.approx(params, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("model", "numbers"), [("DIVISION", "400 400 320 240 -0.1"), ("EUCM", "400 400 320 240 0.6 1.1")]
)
def test_a_lens_that_none_of_ours_is_becomes_the_nearest_said_in_pixels(tmp_path, model, numbers):
    with warned(model, "off by") as said:
        assert converted(tmp_path, "cameras.txt", f"1 {model} 640 480 {numbers}\n") == 0
    largest = re.search(r"([\d.e-]+) \(largest\)", str(said[0].message))
    assert largest is not None and float(largest[1]) < 0.01
    assert read_camera(tmp_path / "camera.json").focal_length == pytest.approx(400, abs=0.01)


def test_a_matrix_in_parts_of_the_sides_is_scaled_and_said(tmp_path):
    matrix = (np.array(K) / [[640], [480], [1]]).tolist()
    with warned("scaled by 640 and 480"):
        assert converted(tmp_path, "a.yaml", {**SIZE, "K": matrix, "D": [0.0] * 5}) == 0
    assert read_camera(tmp_path / "camera.json").params == pytest.approx((400, 405, 320.5, 240.5))


def test_what_holds_no_camera_is_named_as_what_it_is(tmp_path, capsys):
    assert converted(tmp_path, "00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3) == 3
    assert "poses as KITTI has them" in " ".join(capsys.readouterr().err.split())
    assert converted(tmp_path, "chain.yaml", {"cam0": KALIBR, "cam1": KALIBR}) == 3
    assert "Kalibr's camchain of 2 cameras" in " ".join(capsys.readouterr().err.split())
