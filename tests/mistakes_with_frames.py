"""What users get wrong with frames, calibration, light, masks and truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA
from mistakes import FISHEYE, edit_json, edit_poses, edit_text, mistake, rewrite_images
from scipy.spatial.transform import Rotation

from lightdepth.calibration import read_camera, read_light, write_camera
from lightdepth.camera import KannalaBrandt
from lightdepth.datasets import open_sequence

# ---- frames of one's own


@mistake("Points at the folder above the sequences", "frames", "no images", "It holds folders of frames", "frames")
def one_level_too_high(path):
    return path.parent


@mistake(
    "Points at the images inside a sequence", "frames", "no camera.json, but", "has one; give the sequence's folder"
)
def one_level_too_low(path):
    return path / "frames"


@mistake("Gives an empty folder", "frames", "the folder is empty", "expected frames such as 000123.png")
def empty_folder(path):
    (path / "empty").mkdir()
    return path / "empty"


@mistake("Gives a folder that is not there", "frames", "nowhere", "does not exist; expected a folder of frames")
def no_folder(path):
    return path / "nowhere"


@mistake("Gives a video that is none", "frames", "video.mp4: not a video that can be read")
def a_video(path):
    (path / "video.mp4").write_bytes(b"\0" * 64)
    return path / "video.mp4"


@mistake("Names images without numbers", "frames", "no images with a number in their names", "found", "000123.png")
def no_numbers(path):
    for file, name in zip(sorted((path / "frames").iterdir()), ("first", "second", "third"), strict=True):
        file.rename(path / f"{name}.png")
    (path / "frames").rmdir()


@mistake("Has two images of one number", "frames", "000001 and frame1 have the same number")
def number_twice(path):
    shutil.copy(path / "frames" / "000001.png", path / "frames" / "frame1.png")
    shutil.rmtree(path / "truth")


@mistake(
    "Mixes images of two sizes", "frames", "000002.png: is 48x40, but 000000.png is 96x80", "one size in a sequence"
)
def mixed_sizes(path):
    cv2.imwrite(str(path / "frames" / "000002.png"), np.zeros((40, 48, 3), np.uint8))


@mistake("Copied an image halfway (PNG)", "frames", "000001.png: not a readable image (truncated")
def truncated_png(path):
    file = path / "frames" / "000001.png"
    file.write_bytes(file.read_bytes()[:-200])


@mistake("Copied an image halfway (JPEG)", "frames", "000001.jpg: not a readable image (truncated")
def truncated_jpeg(path):
    file = path / "frames" / "000001.png"
    image = cv2.imread(str(file))
    file.unlink()
    cv2.imwrite(str(file.with_suffix(".jpg")), image)
    file = file.with_suffix(".jpg")
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])


@mistake("Ran out of disk: an image of zero bytes", "frames", "000001.png", "the file is empty, 0 bytes")
def empty_image(path):
    (path / "frames" / "000001.png").write_bytes(b"")


@mistake("May not read an image", "frames", "000001.png: cannot be read (Permission denied)")
def no_permission(path):
    file = path / "frames" / "000001.png"

    def call():
        read = Path.read_bytes

        def denied(self):
            if self == file:
                raise PermissionError(13, "Permission denied", str(self))
            return read(self)

        with pytest.MonkeyPatch.context() as patch:  # file modes do not stop the superuser
            patch.setattr(Path, "read_bytes", denied)
            return list(open_sequence(path))

    return call


@mistake("May not list the folder", "frames", "frames: cannot be read (Permission denied)")
def no_permission_for_the_folder(path):
    def denied(self):
        raise PermissionError(13, "Permission denied", str(self))

    def call():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Path, "iterdir", denied)
            return open_sequence(path)

    return call


@mistake("Names another format", "c3vd", "neither image01/ and depth01/", "it looks like --format c3vd")
def wrong_format(path):
    return lambda: open_sequence(path, "hamlyn")


@mistake("Names a format that there is not", "frames", "format: 'kitti' is not known; expected one of folder, c3vd")
def unknown_format(path):
    return lambda: open_sequence(path, "kitti")


# ---- calibration and images


@mistake("Gives no calibration", "frames", "no camera.json; give --camera FILE", '"params": [fx, fy, cx, cy]')
def no_camera(path):
    (path / "camera.json").unlink()


@mistake(
    "Resized the images, not the calibration", "frames", "48x40, the camera 96x80", "multiply fx, fy, cx, cy by 0.5"
)
def resized_images(path):
    rewrite_images(path, lambda image: image[::2, ::2])


@mistake("Cropped the images", "frames", "64x80, the camera 96x80", "cropped or padded; give the calibration of this")
def cropped_images(path):
    rewrite_images(path, lambda image: image[:, :64])


@mistake("Swapped width and height in camera.json", "frames", "96x80, the camera 80x96", "width and height are swapped")
def swapped_in_json(path):
    edit_json(path / "camera.json", width=80, height=96)


@mistake("Swapped width and height in a calibration", "camera", "Endoscope_01", "width and height", "look swapped")
def swapped_in_xml(path):
    write_camera(KannalaBrandt(100, 160, 80.0, 80.0, 81.0, 49.0, -0.1, 0.0, 0.0, 0.0), path / "Endoscope_01.xml")


@mistake(
    "Calibrated at another image size", "camera", "camera.yaml: principal point", "outside it", "another image size"
)
def principal_point_outside(path):
    edit_text(path / "camera.yaml", "image_width: 96", "image_width: 40")


@mistake("Gives the focal length in mm", "frames", "field of view", "is the focal length in mm", refused=False)
def focal_length_in_mm(path):
    edit_json(path / "camera.json", params=[2.8, 2.8, 47.0, 41.0])


@mistake("Gives a negative focal length", "camera", "camera.json: PINHOLE camera: focal lengths -52", "positive pixels")
def negative_focal_length(path):
    edit_json(path / "camera.json", params=[-52.0, 52.0, 47.0, 41.0])


@mistake(
    "Leaves a key out of camera.json", "camera", "camera.json: params missing; expected model, width, height, params"
)
def missing_key(path):
    data = json.loads((path / "camera.json").read_text())
    del data["params"]
    (path / "camera.json").write_text(json.dumps(data))


@mistake("Breaks camera.json with a comma", "camera", "camera.json: not valid JSON", "line 3 column 1")
def broken_json(path):
    (path / "camera.json").write_text('{"model": "PINHOLE",\n "width": 96,\n}')


@mistake(
    "Has one number too few",
    "camera",
    "camera.json: 9 parameters of SCARAMUZZA; expected 10: cx cy a0",
)
def scaramuzza_short(path):
    edit_json(path / "camera.json", model="SCARAMUZZA", params=[47.0, 41.0, 52.0, 0, 0, 0, 0, 1, 0])


@mistake(
    "Has a line too few in calib_results.txt",
    "camera",
    "calib_results.txt: 4 lines of numbers",
    "five lines: polynomial",
)
def ocamcalib_short(path):
    (path / "calib_results.txt").write_text("5 -52 0 1e-3 0 0\n2 50 1\n41 47\n1 0 0\n")


@mistake(
    "Uses a distortion model that is not known",
    "camera",
    "camera.yaml: distortion_model 'division' is not known",
    "plumb_bob",
)
def unknown_distortion(path):
    edit_text(path / "camera.yaml", "distortion_model: plumb_bob", "distortion_model: division")


@mistake(
    "Calibrated a tilted sensor", "camera", "camera.yaml: distortion_coefficients: a tilted sensor", "CALIB_TILTED"
)
def tilted(path):
    edit_text(path / "camera.yaml", "data: [ 0.0, 0.0, 0.0, 0.0, 0.0 ]", f"data: {[0.0] * 12 + [0.01, 0.0]}")
    edit_text(path / "camera.yaml", "cols: 5", "cols: 14")


@mistake(
    "Gives fisheye coefficients without their model",
    "camera",
    "camera.yaml",
    "distortion_model: fisheye",
    refused=False,
)
def fisheye_unsaid(path):
    write_camera(FISHEYE, path / "camera.yaml")
    edit_text(path / "camera.yaml", "distortion_model: fisheye\n", "")


@mistake("Gives a bare 3x3 matrix", "camera", "intrinsics.txt: holds no image size; give it", '"model": "PINHOLE"')
def matrix_without_size(path):
    (path / "intrinsics.txt").write_text("52 0 47\n0 52 41\n0 0 1\n")


@mistake(
    "Transposed the matrix", "camera", "intrinsics.txt: not a camera matrix; it looks transposed", "fx 0 cx / 0 fy cy"
)
def transposed_matrix(path):
    (path / "intrinsics.txt").write_text("52 0 0\n0 52 0\n47 41 1\n")


@mistake("Was sent an XML bomb", "camera", "Endoscope_01_geometrical.xml: has a DTD or entities, which are refused")
def billion_laughs(path):
    levels = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    (path / "Endoscope_01_geometrical.xml").write_text(f'<!DOCTYPE r [<!ENTITY l0 "ha">{levels}]><rig>&l9;</rig>')


@mistake("Was sent an XML that reads other files", "camera", "Endoscope_01_geometrical.xml: has a DTD or entities")
def external_entity(path):
    text = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><rig>&x;</rig>'
    (path / "Endoscope_01_geometrical.xml").write_text(text)


@mistake("Gives the light's file as the camera's", "light", "light.xml: a photometric calibration", "This is --light's")
def light_as_camera(path):
    return lambda: read_camera(path / "light.xml")


# ---- light


@mistake(
    "Wrote the photometric XML in millimetres", "light", "light.xml: P is 3.76", "expected metres", "divide it by 1000"
)
def light_in_mm(path):
    (path / "light.xml").write_text((path / "light.xml").read_text().replace("-0.0011; -0.0036", "-1.1; -3.6"))


@mistake(
    "Gives a gamma of 22", "light", "light.json: light: gamma 22.0; expected a response exponent between 0.2 and 10"
)
def gamma_22(path):
    edit_json(path / "light.json", gamma=22.0)


@mistake("Gives 1/gamma for gamma", "frames", "gamma is 0.4545", "was 1/gamma written", refused=False)
def inverse_gamma(path):
    edit_json(path / "light.json", gamma=0.4545)


@mistake("Mistypes a key of light.json", "light", "light.json: gama is not known (is gamma meant?); expected gamma, mu")
def mistyped_key(path):
    edit_json(path / "light.json", gama=2.2)


@mistake(
    "Writes the light as a list", "light", "--light gamma=2.2,0", "expected name=number pairs such as gamma=2.2,mu=0"
)
def light_without_name(path):
    return lambda: read_light("gamma=2.2,0")


# ---- masks


@mistake(
    "Made the mask at another size", "frames", "mask.png: the mask is 48x40, but 000000.png is 96x80", "images' size"
)
def mask_of_another_size(path):
    cv2.imwrite(str(path / "mask.png"), np.full((40, 48), 255, np.uint8))


@mistake("Saved a black mask", "frames", "mask.png: the mask is black everywhere; expected white where tissue shows")
def black_mask(path):
    cv2.imwrite(str(path / "mask.png"), np.zeros((80, 96), np.uint8))


@mistake("Gives a text file as mask", "frames", "mask.png: not a readable mask; expected an image, white")
def no_mask(path):
    (path / "mask.png").write_text("mask")


@mistake(
    "Drew the mask of the wrong part", "frames", "mask", "dark part of the image", "is it inverted?", refused=False
)
def mask_of_the_border(path):
    mask = ~(cv2.imread(str(path / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0)
    mask[30:50, 38:58] = True  # and the middle, by which polarity is told
    for file in (path / "frames").iterdir():  # a bright border, as burnt-in text and panels make
        image = cv2.imread(str(file))
        image[mask] = 30
        image[:8] = image[-8:] = 30
        image[~mask] = 200
        cv2.imwrite(str(file), image)
    cv2.imwrite(str(path / "mask.png"), mask.astype(np.uint8) * 255)


# ---- truth


@mistake(
    "Writes poses in metres, distances in mm",
    "frames",
    "contradict each other",
    "multiplied by 1000: they are in metres",
)
def poses_in_metres(path):
    edit_poses(path, lambda rows: rows * [1, 0.001, 0.001, 0.001, 1, 1, 1, 1])


@mistake(
    "Writes the inverse poses",
    "frames",
    "contradict each other",
    "camera-from-world (w2c), expected is world-from-camera",
)
def inverse_poses(path):
    def invert(rows):
        turned = Rotation.from_quat(rows[:, 4:]).inv()
        return np.column_stack([rows[:, 0], -turned.apply(rows[:, 1:4]), turned.as_quat()])

    edit_poses(path, invert)


@mistake(
    "Saves depth along the axis as distance", "frames", "contradict each other", "expected is distance along the ray"
)
def depth_as_distance(path):
    ray_z = CAMERA.rays()[0][..., 2].astype(np.float32)
    for file in (path / "truth" / "distance").iterdir():
        cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED) * ray_z)


@mistake("Transposed the rotations", "frames", "contradict each other", "with the rotations transposed")
def transposed_rotations(path):
    def transpose(rows):
        return np.column_stack([rows[:, :4], Rotation.from_quat(rows[:, 4:]).inv().as_quat()])

    edit_poses(path, transpose)


@mistake("Has a pose too few", "frames", "poses.tum: 2 poses for 3 frames; expected one for each")
def a_pose_too_few(path):
    edit_poses(path, lambda rows: rows[:2])


@mistake("Lost a frame while tracking: NaN in a pose", "frames", "poses.tum: line 2 has NaN")
def nan_pose(path):
    edit_poses(path, lambda rows: np.where(np.arange(3)[:, None] == 1, np.nan, rows))


@mistake("Writes a quaternion of zeros", "frames", "poses.tum: line 2: the quaternion qx qy qz qw is zero")
def zero_quaternion(path):
    edit_poses(path, lambda rows: rows * np.where(np.arange(3)[:, None] == 1, [[1] * 4 + [0] * 4], 1))


@mistake("Writes seven columns", "frames", "poses.tum: 7 columns; expected 8: t tx ty tz qx qy qz qw")
def seven_columns(path):
    edit_poses(path, lambda rows: rows[:, 1:])


@mistake(
    "Lost the truth of a frame",
    "frames",
    "no depth for 1 of 3 frames, the first is frame 1",
    "complete?",
    refused=False,
)
def missing_truth(path):
    (path / "truth" / "distance" / "000001.tiff").unlink()
