"""Calibration files of other programs: read where one of our lenses holds them, else named as what they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import yaml
from raising import refused
from scipy.io import savemat
from test_lenses import K, off, opencv_pixels, rays_of, silently, written

from lightdepth.calibration import read_camera
from lightdepth.camera import KannalaBrandt
from lightdepth.cli import main
from lightdepth.files.tum import read_tum

CAM = {
    "camera_model": "pinhole",
    "intrinsics": [400.0, 405.0, 320.5, 238.5],
    "distortion_model": "radtan",
    "distortion_coeffs": [-0.2, 0.05, 0.001, 0.002],
    "resolution": [640, 480],
}


def test_a_camchain_of_two_cameras_is_named_with_the_way_out(tmp_path):
    with refused(found="Kalibr's camchain of 2 cameras (cam0, cam1)", cure="copy the section"):
        read_camera(written(tmp_path / "camchain.yaml", {"cam0": CAM, "cam1": CAM}))
    camera = silently(written(tmp_path / "one.yaml", {"cam1": CAM}))
    rays = rays_of(camera)
    assert off(camera, opencv_pixels(rays, K, CAM["distortion_coeffs"]), rays) < 1e-9


@pytest.mark.parametrize(
    ("model", "own", "bent"),
    [
        ("eucm", [0.6, 1.1], "none"),
        ("ds", [-0.2, 0.55], "none"),
        ("omni", [0.9], "radtan"),
        ("pinhole", [], "fov"),
    ],
)
def test_kalibr_s_other_lenses_are_the_nearest_of_ours(tmp_path, model, own, bent):
    terms = {"radtan": [-0.05, 0.01, 1e-4, 1e-4], "fov": [0.9], "none": []}[bent]
    numbers = [*own, *(f * (1.9 if model == "omni" else 1) for f in CAM["intrinsics"][:2]), *CAM["intrinsics"][2:]]
    cam = {**CAM, "camera_model": model, "intrinsics": numbers, "distortion_model": bent, "distortion_coeffs": terms}
    with pytest.warns(UserWarning, match=rf"{model}.* lens read as|EUCM lens read as"):
        camera = read_camera(written(tmp_path / "camchain.yaml", {"cam0": cam}))
    rays = rays_of(camera)
    if model == "omni":
        x, y, z = rays.T
        bent_rays = np.stack([x, y, z + own[0]], -1)
        matrix = [[numbers[1], 0, numbers[3]], [0, numbers[2], numbers[4]], [0, 0, 1]]
        expected = opencv_pixels(bent_rays, matrix, terms)
    elif model == "ds":
        x, y, z = rays.T
        second = np.sqrt(x * x + y * y + (z + own[0]) ** 2)
        plane = rays[:, :2] / (own[1] * second + (1 - own[1]) * (own[0] + z))[:, None]
        expected = plane * numbers[-4:-2] + numbers[-2:] + np.float64(0.5)
    elif model == "eucm":
        x, y, z = rays.T
        plane = rays[:, :2] / (own[0] * np.sqrt(own[1] * (x * x + y * y) + z * z) + (1 - own[0]) * z)[:, None]
        expected = plane * numbers[-4:-2] + numbers[-2:] + np.float64(0.5)
    else:
        side = np.hypot(rays[:, 0], rays[:, 1])
        radius = np.arctan(2 * side / rays[:, 2] * np.tan(0.45)) / 0.9
        expected = rays[:, :2] / side[:, None] * radius[:, None] * numbers[-4:-2] + numbers[-2:] + np.float64(0.5)
    assert off(camera, expected, rays) < 1.0


def test_orb_slam_3_s_own_example_is_read_as_it_stands(tmp_path):
    text = """%YAML:1.0
#--------------------------------------------------------------------------------------------
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.978477
Camera1.fy: 190.973307
Camera1.cx: 254.931706
Camera1.cy: 256.897442
Camera1.k1: 0.003482389402
Camera1.k2: 0.000715034845
Camera1.k3: -0.002053236141
Camera1.k4: 0.000202936736
Camera.width: 512
Camera.height: 512
Camera.fps: 20
Camera.RGB: 1
Tbc1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
ORBextractor.nFeatures: 1500
"""
    camera = silently(written(tmp_path / "TUM_512.yaml", text))
    assert isinstance(camera, KannalaBrandt) and (camera.fx, camera.cx, camera.width) == (190.978477, 255.431706, 512)
    older = text.replace("Camera1.", "Camera.").replace("Camera.width: 512\nCamera.height: 512\n", "")
    with refused(found="holds no image size (Camera.width and Camera.height missing)"):
        read_camera(written(tmp_path / "old.yaml", older))
    assert silently(tmp_path / "old.yaml", (512, 512)) == camera


def test_transforms_json_is_nerfstudio_s_camera_also_by_its_angle_and_frame_by_frame(tmp_path):
    frame = {"file_path": "a_0001.png", "transform_matrix": np.eye(4).tolist()}
    angle = {"camera_angle_x": 2 * np.arctan(320 / 400), "frames": [frame]}
    camera = silently(written(tmp_path / "transforms.json", angle), (640, 480))
    assert camera.params == pytest.approx((400.0, 400.0, 320.0, 240.0))
    own = {"fl_x": 400.0, "fl_y": 405.0, "cx": 321.0, "cy": 239.0, "w": 640, "h": 480}
    each = {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "frames": [{**frame, **own}, {**frame, **own}]}
    assert silently(written(tmp_path / "transforms.json", each)).params == (400, 405, 321, 239, 0.1, 0, 0, 0)
    each["frames"][1] = {**each["frames"][1], "fl_x": 401.0}
    with refused(found="a transforms.json whose frames have different cameras"):
        read_camera(written(tmp_path / "transforms.json", each))


def test_poses_and_kitti_s_calibration_are_named_as_what_they_are(tmp_path, capsys):
    poses = "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3
    file = written(tmp_path / "00.txt", poses)
    assert main(["convert-camera", str(file), "-o", str(tmp_path / "camera.json")]) == 3
    assert "poses as KITTI has them (3 lines of 12 numbers)" in " ".join(capsys.readouterr().err.split())
    with refused(found="a TUM trajectory (2 lines of 8 numbers), which hold no camera"):
        read_camera(written(tmp_path / "tum.txt", "0 0 0 0 0 0 0 1\n" * 2))
    calib = "".join(f"P{i}: 718.8 0 607.1 0 0 718.8 185.2 0 0 0 1 0\n" for i in range(4))
    with refused(found="KITTI's calib.txt", cure="718.8 0 607.1 / 0 718.8 185.2 / 0 0 1"):
        read_camera(written(tmp_path / "calib.txt", calib))


def test_matlab_s_parameters_are_read_from_structures(tmp_path):
    terms = [-0.2, 0.05, 0.001, 0.002, -0.01]
    one_based = [[400.0, 0, 321.5], [0, 405.0, 239.5], [0, 0, 1.0]]
    structure = {
        "IntrinsicMatrix": np.array(one_based).T,
        "RadialDistortion": [terms[0], terms[1], terms[4]],
        "TangentialDistortion": terms[2:4],
        "ImageSize": [480, 640],
    }
    savemat(tmp_path / "a.mat", {"cameraParams": structure})
    savemat(tmp_path / "b.mat", structure | {"K": one_based})
    bouguet = {"fc": [400.0, 405.0], "cc": [320.5, 238.5], "kc": terms, "alpha_c": 0.0, "nx": 640, "ny": 480}
    savemat(tmp_path / "Calib_Results.mat", bouguet)
    for name in ("a.mat", "b.mat", "Calib_Results.mat"):
        camera = silently(tmp_path / name)
        rays = rays_of(camera)
        assert off(camera, opencv_pixels(rays, K, terms), rays) < 1e-9, name
    fisheye = {
        "MappingCoefficients": [769.2, -8.1e-4, 6.2e-7, -1.2e-9],
        "StretchMatrix": [[0.9999, 0.003], [-0.002, 1.0]],
        "DistortionCenter": [679.5, 543.5],
        "ImageSize": [1080, 1350],
    }
    savemat(tmp_path / "fisheye.mat", {"fisheyeParams": {"Intrinsics": fisheye}})
    camera = silently(tmp_path / "fisheye.mat")
    assert camera.params == (679.0, 543.0, 769.2, 0, -8.1e-4, 6.2e-7, -1.2e-9, 0.9999, 0.003, -0.002)


def test_what_matlab_alone_can_read_is_named_with_what_to_save(tmp_path):
    savemat(tmp_path / "other.mat", {"depth": np.ones((3, 3))})
    with refused(found="a MATLAB file with depth", cure="toStruct"):
        read_camera(tmp_path / "other.mat")
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n"
    (tmp_path / "new.mat").write_bytes(header)
    with refused(cure="-v7"):
        read_camera(tmp_path / "new.mat")
    (tmp_path / "broken.mat").write_bytes(b"no matlab")
    with refused(where="broken.mat"):
        read_camera(tmp_path / "broken.mat")
    with refused(found="a script of MATLAB's calibration toolbox", cure="Calib_Results.mat"):
        read_camera(written(tmp_path / "Calib_Results.m", "% a comment\nfc = [ 657.39 ; 657.76 ];\n"))


def test_a_file_without_a_size_takes_the_images_from_the_command_line(tmp_path):
    frames = tmp_path / "data"
    frames.mkdir()
    image = np.random.default_rng(0).integers(60, 200, (48, 64, 3)).astype(np.uint8)
    for i in range(2):
        cv2.imwrite(str(frames / f"{i:06d}.png"), image)
    (tmp_path / "k.yaml").write_text(yaml.dump({"K": [[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]], "D": [0.0] * 5}))
    out = tmp_path / "out"
    command = ["predict", str(frames), "--camera", str(tmp_path / "k.yaml"), "--checkpoint", "decline", "-o", str(out)]
    assert main(command) == 0
    assert len(list(out.glob("*.npz"))) == 2


def test_kitti_s_poses_are_a_trajectory_whose_times_are_the_frames(tmp_path):
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (5, 1, 1))
    for pose in poses:
        pose[:3, :3] = cv2.Rodrigues(rng.normal(size=3))[0]
        pose[:3, 3] = rng.normal(size=3)
    np.savetxt(tmp_path / "00.txt", poses[:, :3].reshape(5, 12))
    times, found = read_tum(tmp_path / "00.txt")
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert times.tolist() == [0, 1, 2, 3, 4]
    np.savetxt(tmp_path / "bad.txt", np.ones((2, 12)))
    with refused(found="line 1: its 12 numbers hold no rotation"):
        read_tum(tmp_path / "bad.txt")
