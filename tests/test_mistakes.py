"""What users get wrong with their data, and what the program says: what was found, where, and what would be right.

Every mistake is made on data that is read without a word before, and is met through a public entrance. The words are
parts that the message must hold. `python tests/test_mistakes.py` prints the table: the mistake, and what is said.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from colons import CAMERA, EXACT, colon, sequence, slam
from scipy.spatial.transform import Rotation

from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.camera import KannalaBrandt
from lightdepth.cli import main
from lightdepth.datasets import open_sequence, write_c3vd, write_endomapper, write_folder, write_hamlyn, write_simcol
from lightdepth.datasets.catalogue import read_dataset_yaml
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.datasets.splits import folders, read_split
from lightdepth.errors import InputError
from lightdepth.files.tum import write_tum
from lightdepth.maps import read_map, write_multimap, write_text_model
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import lens

FISHEYE = KannalaBrandt(96, 80, 50.0, 50.0, 48.0, 40.0, -0.1, 0.0, 0.0, 0.0)
KINDS = ("frames", "c3vd", "simcol", "hamlyn", "endomapper", "colmap", "multimap", "tum", "camera", "light", "split")


@dataclass(frozen=True)
class Mistake:
    """What the user did; on which data; how; through which entrance; the words that the message must hold."""

    did: str
    data: str
    make: Callable[[Path], Any]
    words: tuple[str, ...]
    refused: bool = True


MISTAKES: list[Mistake] = []


def mistake(did: str, data: str, *words: str, refused: bool = True):
    """Adds a row: the function makes the mistake in a copy of the data, and may return what to open in its place."""

    def add(make: Callable[[Path], Any]) -> Callable[[Path], Any]:
        MISTAKES.append(Mistake(did, data, make, words, refused))
        return make

    return add


# ---- data without mistakes


def made(folder: Path) -> None:
    """One of each kind, in folder."""
    frames = colon(0, 3, 6.0).frames
    write_folder(frames, folder / "frames")
    write_c3vd(colon(0, 3, 6.0, lens("c3vd", 100, 80)).frames, folder / "c3vd")
    write_simcol(frames, folder / "simcol" / "Frames_S1")
    write_hamlyn(frames, folder / "hamlyn")
    counted = [replace(f, name=f"out{f.number + 1}") for f in colon(0, 3, 6.0, FISHEYE).frames]
    write_endomapper(counted, folder / "endomapper")
    export = slam(frames, config=EXACT).map
    write_text_model(export.submaps[0], folder / "colmap")
    write_multimap(export, folder / "multimap")
    write_text_model(export.submaps[0], folder / "tum")
    (folder / "tum" / "images.txt").unlink()
    keyframes = export.submaps[0].keyframes
    write_tum(
        folder / "tum" / "KeyFrameTrajectory.txt",
        [k.number for k in keyframes],
        [np.linalg.inv(k.cam_from_map) for k in keyframes],
    )
    (folder / "camera").mkdir()
    write_camera(CAMERA, folder / "camera" / "camera.json")
    write_camera(CAMERA, folder / "camera" / "camera.yaml")
    write_camera(FISHEYE, folder / "camera" / "Endoscope_01_geometrical.xml")
    (folder / "light").mkdir()
    write_light(PhotometricCalibration(), folder / "light" / "light.json")
    write_light(PhotometricCalibration(position_mm=(0, -1.1, -3.6)), folder / "light" / "light.xml")
    (folder / "split" / "root" / "a").mkdir(parents=True)
    (folder / "split" / "root" / "b").mkdir()
    (folder / "split" / "split.yaml").write_text("parts:\n  train: [a]\n  test: [b]\n")


def opened(kind: str, path: Path) -> object:
    """What a user does with data of this kind, or with the file or the call that a mistake put in its place."""
    if kind in ("frames", "c3vd", "hamlyn", "endomapper"):
        return list(open_sequence(path))
    if kind == "simcol":
        return list(open_sequence(path / "Frames_S1"))
    if kind in ("colmap", "multimap", "tum"):
        return read_map(path)
    if kind == "camera":
        return [read_camera(file) for file in sorted(path.iterdir())]
    if kind == "light":
        return [read_light(file) for file in sorted(path.iterdir())]
    return folders(read_split(path / "split.yaml"), path / "root", ("train", "test"))


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


@mistake("Names a format that there is not", "frames", "format 'kitti'; expected one of folder, c3vd")
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
    _rewrite_images(path, lambda image: image[::2, ::2])


@mistake("Cropped the images", "frames", "64x80, the camera 96x80", "cropped or padded; give the calibration of this")
def cropped_images(path):
    _rewrite_images(path, lambda image: image[:, :64])


@mistake("Swapped width and height in camera.json", "frames", "96x80, the camera 80x96", "width and height are swapped")
def swapped_in_json(path):
    _edit_json(path / "camera.json", width=80, height=96)


@mistake("Swapped width and height in a calibration", "camera", "Endoscope_01", "width and height", "look swapped")
def swapped_in_xml(path):
    write_camera(KannalaBrandt(100, 160, 80.0, 80.0, 81.0, 49.0, -0.1, 0.0, 0.0, 0.0), path / "Endoscope_01.xml")


@mistake(
    "Calibrated at another image size", "camera", "camera.yaml: principal point", "outside it", "another image size"
)
def principal_point_outside(path):
    _replace(path / "camera.yaml", "image_width: 96", "image_width: 40")


@mistake("Gives the focal length in mm", "frames", "field of view", "is the focal length in mm", refused=False)
def focal_length_in_mm(path):
    _edit_json(path / "camera.json", params=[2.8, 2.8, 47.0, 41.0])


@mistake("Gives a negative focal length", "camera", "camera.json: PINHOLE camera: focal lengths -52", "positive pixels")
def negative_focal_length(path):
    _edit_json(path / "camera.json", params=[-52.0, 52.0, 47.0, 41.0])


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
    "camera.json: SCARAMUZZA has 10 parameters, found 9; expected cx cy a0",
)
def scaramuzza_short(path):
    _edit_json(path / "camera.json", model="SCARAMUZZA", params=[47.0, 41.0, 52.0, 0, 0, 0, 0, 1, 0])


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
    _replace(path / "camera.yaml", "distortion_model: plumb_bob", "distortion_model: division")


@mistake("Calibrated with k3", "camera", "camera.yaml: distortion_coefficients: k3 = 0.3; expected 0", "CALIB_FIX_K3")
def k3(path):
    _replace(path / "camera.yaml", "data: [ 0.0, 0.0, 0.0, 0.0, 0.0 ]", "data: [ 0.1, 0.0, 0.0, 0.0, 0.3 ]")


@mistake(
    "Gives fisheye coefficients without their model",
    "camera",
    "camera.yaml",
    "distortion_model: fisheye",
    refused=False,
)
def fisheye_unsaid(path):
    write_camera(FISHEYE, path / "camera.yaml")
    _replace(path / "camera.yaml", "distortion_model: fisheye\n", "")


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
    _edit_json(path / "light.json", gamma=22.0)


@mistake("Gives 1/gamma for gamma", "frames", "gamma is 0.4545", "was 1/gamma written", refused=False)
def inverse_gamma(path):
    _edit_json(path / "light.json", gamma=0.4545)


@mistake("Mistypes a key of light.json", "light", "light.json: gama is not known (is gamma meant?); expected gamma, mu")
def mistyped_key(path):
    _edit_json(path / "light.json", gama=2.2)


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
    _edit_poses(path, lambda rows: rows * [1, 0.001, 0.001, 0.001, 1, 1, 1, 1])


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

    _edit_poses(path, invert)


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

    _edit_poses(path, transpose)


@mistake("Has a pose too few", "frames", "poses.tum: 2 poses for 3 frames; expected one for each")
def a_pose_too_few(path):
    _edit_poses(path, lambda rows: rows[:2])


@mistake("Lost a frame while tracking: NaN in a pose", "frames", "poses.tum: line 2 has NaN")
def nan_pose(path):
    _edit_poses(path, lambda rows: np.where(np.arange(3)[:, None] == 1, np.nan, rows))


@mistake("Writes a quaternion of zeros", "frames", "poses.tum: line 2: the quaternion qx qy qz qw is zero")
def zero_quaternion(path):
    _edit_poses(path, lambda rows: rows * np.where(np.arange(3)[:, None] == 1, [[1] * 4 + [0] * 4], 1))


@mistake("Writes seven columns", "frames", "poses.tum: 7 columns; a TUM trajectory has 8: t tx ty tz qx qy qz qw")
def seven_columns(path):
    _edit_poses(path, lambda rows: rows[:, 1:])


@mistake(
    "Lost the truth of a frame", "frames", "no depth for 1 of 3 frames, the first is frame 1", "whole?", refused=False
)
def missing_truth(path):
    (path / "truth" / "distance" / "000001.tiff").unlink()


# ---- data sets


@mistake(
    "Downloaded C3VD without one depth file", "c3vd", "no depth for 1 of 3 frames, the first is frame 1", refused=False
)
def missing_depth(path):
    (path / "0001_depth.tiff").unlink()


@mistake(
    "Saved C3VD's depth again in 8 bits", "c3vd", "0001_depth.tiff: uint8", "C3VD's depth is one channel of 16 bits"
)
def eight_bits(path):
    code = cv2.imread(str(path / "0001_depth.tiff"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path / "0001_depth.tiff"), (code // 256).astype(np.uint8))


@mistake("Resized C3VD's colour, not its depth", "c3vd", "0001_depth.tiff: depth is 50x40, the image 100x80")
def depth_of_another_size(path):
    cv2.imwrite(str(path / "0001_depth.tiff"), np.ones((40, 50), np.uint16))


@mistake("Cropped C3VD's images", "c3vd", "images are 80x80; C3VD's camera is for 1350x1080", "--camera FILE")
def cropped_c3vd(path):
    for file in path.glob("*_color.png"):
        cv2.imwrite(str(file), cv2.imread(str(file))[:, :80])


@mistake("Cut pose.txt short", "c3vd", "pose.txt: 2 poses, but there is a frame 2")
def pose_txt_short(path):
    _edit_lines(path / "pose.txt", lambda lines: lines[:2])


@mistake("Writes twelve numbers a pose", "c3vd", "pose.txt: 12 numbers a line; expected 16")
def twelve_numbers(path):
    _edit_lines(path / "pose.txt", lambda lines: [",".join(line.split(",")[:12]) for line in lines])


@mistake("Scaled a rotation", "c3vd", "pose.txt: line 2: the pose is not a rotation", "is it scaled, or mirrored?")
def scaled_rotation(path):
    def scale(lines):
        return [lines[0], ",".join(str(1.1 * float(v)) for v in lines[1].split(",")[:15]) + ",1", lines[2]]

    _edit_lines(path / "pose.txt", scale)


@mistake("Has NaN in pose.txt", "c3vd", "pose.txt: line 2: the pose has NaN")
def nan_in_pose_txt(path):
    _edit_lines(path / "pose.txt", lambda lines: [lines[0], "nan," + lines[1].split(",", 1)[1], lines[2]])


@mistake("Left SimCol3D's cam.txt behind", "simcol", "no cam.txt here or in the folder above", "--camera FILE")
def no_cam_txt(path):
    (path / "cam.txt").unlink()


@mistake(
    "Left one of SimCol3D's pose files behind",
    "simcol",
    "SavedPosition_S1.txt",
    "no SavedRotationQuaternion_S1.txt beside it",
)
def half_of_the_poses(path):
    (path / "SavedRotationQuaternion_S1.txt").unlink()


@mistake(
    "Left Hamlyn's intrinsics.txt behind",
    "hamlyn",
    "no intrinsics.txt; put the sequence's there, or give --camera FILE",
)
def no_intrinsics(path):
    (path / "intrinsics.txt").unlink()


@mistake(
    "Extracted EndoMapper's frames from 0", "endomapper", "out0.png: number 0, but EndoMapper counts frames from 1"
)
def counted_from_zero(path):
    (path / "img_train" / "out3.png").rename(path / "img_train" / "out0.png")


@mistake(
    "Has the calibrations of two endoscopes",
    "endomapper",
    "2 calibrations",
    "Seq_NNN_info.json",
    "--camera and --light",
)
def two_endoscopes(path):
    shutil.copy(path / "Endoscope_00_geometrical.xml", path / "Endoscope_01_geometrical.xml")


@mistake("Did not deinterlace the video", "frames", "the images look interlaced", "deinterlace", refused=False)
def interlaced(path):
    shutil.rmtree(path / "truth")

    def weave(image):
        image = image.copy()
        image[1::2] = np.roll(image[1::2], 6, axis=1)
        return image

    _rewrite_images(path, weave)


# ---- maps


@mistake(
    "Exported a map's poses as map-from-camera",
    "colmap",
    "median reprojection error",
    "with the inverse poses",
    "pose_convention",
)
def map_poses_inverted(path):
    def invert(words):
        quaternion, translation = np.array(words[1:5], float), np.array(words[5:8], float)
        turned = Rotation.from_quat(quaternion, scalar_first=True).inv()
        numbers = [*turned.as_quat(scalar_first=True), *-turned.apply(translation)]
        return [words[0], *map(repr, map(float, numbers)), *words[8:]]

    _edit_images(path, pose=invert)


@mistake("Wrote a map's quaternions x y z w", "colmap", "with the quaternions read as x y z w. Write them as w x y z")
def quaternion_order(path):
    _edit_images(path, pose=lambda w: [w[0], *w[2:5], w[1], *w[5:]])


@mistake(
    "Ran the SLAM on images of half the size",
    "colmap",
    "with the camera at half its size",
    "Correct the size and intrinsics",
)
def half_size_map(path):
    _edit_images(path, keypoints=lambda xy: xy / 2)


@mistake(
    "Mixed two conventions of pixels: half a pixel",
    "colmap",
    "median reprojection error",
    "+0.5 px",
    "count pixels alike",
    refused=False,
)
def half_a_pixel(path):
    _edit_images(path, keypoints=lambda xy: xy - 0.5)


@mistake(
    "Mistypes a key of densify_map.json",
    "colmap",
    "densify_map.json: pixel_centre is not known (is pixel_center meant?)",
)
def mistyped_sidecar(path):
    (path / "densify_map.json").write_text('{"pixel_centre": 0.0}')


@mistake("Left a file of the model behind", "colmap", "points3D.txt missing; a model is cameras, images and points3D")
def file_of_the_model_missing(path):
    (path / "points3D.txt").unlink()


@mistake("Gives one file of a model", "colmap", "images.txt: one file of a COLMAP model; give the folder it is in")
def file_of_a_model(path):
    return path / "images.txt"


@mistake(
    "Lost a keyframe's line of keypoints",
    "colmap",
    "images.txt, line 2: found '000001.png'",
    "expected X Y POINT3D_ID, repeated",
)
def keypoints_missing(path):
    _edit_lines(path / "images.txt", lambda lines: [lines[0], *lines[2:]])


@mistake("Gives ORB-SLAM3's atlas", "colmap", "map.osa: an ORB-SLAM3 atlas", "export the multi-map tree instead")
def an_atlas(path):
    (path / "map.osa").write_bytes(b"22 serialization::archive")
    return path / "map.osa"


@mistake(
    "Gives a trajectory without points",
    "tum",
    "KeyFrameTrajectory.txt: a trajectory without points",
    "put points3D.txt, a PLY",
)
def no_points(path):
    for name in ("points3D.txt", "cameras.txt"):
        (path / name).unlink()


@mistake(
    "Writes times of day in nanoseconds",
    "tum",
    "KeyFrameTrajectory.txt: the time 1.7e+18 falls on no frame",
    "not nanoseconds",
)
def nanoseconds(path):
    _edit_lines(
        path / "KeyFrameTrajectory.txt", lambda lines: [f"{17 + i}e17 0 0 0 0 0 0 1" for i in range(len(lines))]
    )


@mistake("Writes times in seconds without the video's fps", "tum", "the time 0.04 is not a frame number", '"fps"')
def seconds_without_fps(path):
    _edit_lines(path / "KeyFrameTrajectory.txt", lambda lines: [f"{0.04 * i} 0 0 0 0 0 0 1" for i in range(len(lines))])


@mistake("Writes times in milliseconds", "tum", "keyframes 1000 to 3000", "none in common", "in milliseconds?")
def milliseconds(path):
    _edit_times(path, [1000 / 30, 2000 / 30, 3000 / 30])
    return lambda: check_shared_frames(read_map(path), sequence(colon(0, 3, 6.0).frames))


@mistake("Gives the map of another cut of the video", "tum", "1 of 3 keyframes", "in milliseconds?", refused=False)
def most_keyframes_without_a_frame(path):
    _edit_times(path, [0, 1000 / 30, 2000 / 30])
    return lambda: check_shared_frames(read_map(path), sequence(colon(0, 3, 6.0).frames))


@mistake("Exported two maps of one number", "multimap", "0 and 00 are both map 0; rename one of them")
def map_twice(path):
    shutil.copytree(path / "3D_maps" / "0", path / "3D_maps" / "00")


@mistake("Has NaN among the points", "multimap", "points3D.txt, line", "is not finite")
def nan_point(path):
    def spoil(lines):
        words = lines[-1].split()
        return [*lines[:-1], " ".join([words[0], "nan", *words[2:]])]

    _edit_lines(path / "3D_maps" / "0" / "points3D.txt", spoil)


# ---- splits


@mistake("Trains and tests on one sequence", "split", "split.yaml: A of test, which is a, is in train too")
def overlap(path):
    (path / "split.yaml").write_text("parts:\n  train: [a]\n  test: [A]\n")


@mistake("Follows a split that leads outside", "split", "split.yaml: train: '../../etc' leads outside the data's root")
def split_outside(path):
    (path / "split.yaml").write_text("parts:\n  train: [../../etc]\n")


@mistake("Has not downloaded all of a split", "split", "2 of the sequences", "are not there: c, d", "--data.root")
def sequences_missing(path):
    (path / "split.yaml").write_text("parts:\n  train: [a, c]\n  test: [d]\n")


@mistake("Was sent a YAML that runs code", "split", "split.yaml: not valid YAML")
def yaml_code(path):
    (path / "split.yaml").write_text("parts: !!python/object/apply:os.system [exit]\n")


@mistake(
    "Was sent a dataset.yaml whose sequence leads outside", "split", "dataset.yaml", "leads outside the data's root"
)
def dataset_outside(path):
    text = "name: x\nlicence: x\nurl: x\nunit: mm\nsequences: {/etc: 3}\n"
    (path / "dataset.yaml").write_text(text)
    return lambda: read_dataset_yaml(path / "dataset.yaml")


# ---- how mistakes are made


def _replace(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text, (file, old)
    file.write_text(text.replace(old, new))


def _edit_json(file: Path, **changes: object) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def _edit_lines(file: Path, change: Callable[[list[str]], list[str]]) -> None:
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    file.write_text("\n".join(change(lines)) + "\n")


def _edit_poses(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    file = path / "truth" / "poses.tum"
    np.savetxt(file, change(np.loadtxt(file)), fmt="%.9f")


def _edit_times(path: Path, times: list[float]) -> None:
    """Other times in a trajectory, of a video of 30 frames a second."""
    (path / "densify_map.json").write_text('{"fps": 30}')

    def change(lines):
        return [" ".join([f"{time:.6f}", *line.split()[1:]]) for time, line in zip(times, lines, strict=True)]

    _edit_lines(path / "KeyFrameTrajectory.txt", change)


def _edit_images(
    path: Path,
    pose: Callable[[list[str]], list[str]] = lambda words: words,
    keypoints: Callable[[np.ndarray], np.ndarray] = lambda xy: xy,
) -> None:
    """images.txt of a COLMAP model with other poses (words of a line) or keypoints (n, 2)."""

    def change(lines):
        out = []
        for i, line in enumerate(lines):
            if i % 2 == 0:
                out.append(" ".join(pose(line.split())))
            else:
                rows = np.array(line.split(), float).reshape(-1, 3)
                rows[:, :2] = keypoints(rows[:, :2])
                out.append(" ".join(f"{x:.9f} {y:.9f} {point:.0f}" for x, y, point in rows))
        return out

    _edit_lines(path / "images.txt", change)


def _rewrite_images(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for file in (path / "frames").iterdir():
        cv2.imwrite(str(file), change(cv2.imread(str(file))))
    (path / "mask.png").unlink()


# ---- the tests


@pytest.fixture(scope="session")
def originals(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    made(folder)
    return folder


def said(case: Mistake, originals: Path, at: Path) -> tuple[str, bool]:
    """What the program says, and whether it refused."""
    path = at / case.data
    shutil.copytree(originals / case.data, path)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            other = case.make(path)
            if callable(other):
                other()
            else:
                opened(case.data, path if other is None else other)
        except InputError as error:
            return str(error), True
    return "\n".join(str(w.message) for w in warned), False


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_data_without_a_mistake_are_read_without_a_word(originals, kind):
    with warnings.catch_warnings():
        if kind != "tum":  # which never says what a keyframe saw
            warnings.simplefilter("error")
        assert opened(kind, originals / kind)


@pytest.mark.parametrize("case", MISTAKES, ids=lambda case: case.make.__name__)
def test_a_mistake_is_named_with_where_it_is_and_what_would_be_right(originals, tmp_path, capfd, case):
    message, refused = said(case, originals, tmp_path)
    assert refused == case.refused, message or "nothing was said"
    for words in case.words:
        assert words in message


def test_there_are_many_mistakes_and_each_is_of_its_own():
    assert len(MISTAKES) >= 30
    assert len({case.did for case in MISTAKES}) == len({case.make.__name__ for case in MISTAKES}) == len(MISTAKES)


VERBS = {
    "predict in a folder one level too high": (["predict", "HERE"], "It holds folders of frames"),
    "predict without a calibration": (["predict", "HERE/bare"], "no camera.json; give --camera FILE"),
    "predict as another format": (["predict", "HERE/c3vd", "--format", "hamlyn"], "it looks like --format c3vd"),
    "predict with a mask of another size": (["predict", "HERE/frames", "--mask", "HERE/mask.png"], "the mask is 10x10"),
    "predict with a mistyped light": (["predict", "HERE/frames", "--light", "gama=2"], "is gamma meant?"),
    "densify with a map of other frames": (["densify", "HERE/late", "--map", "HERE/colmap"], "and none in common"),
    "densify with a map that is none": (["densify", "HERE/frames", "--map", "HERE/frames"], "no map in it"),
    "train and validate on one sequence": (
        ["train", "--data.sequences", "[HERE/frames]", "--data.val_sequences", "[HERE/frames]"],
        "is validated on, but also trained on",
    ),
    "train on a split that is not downloaded": (
        ["train", "--data.split", "HERE/split/split.yaml", "--data.root", "HERE/colmap"],
        "1 of the sequences of",
    ),
}


@pytest.mark.parametrize("what", VERBS)
def test_a_verb_says_it_without_a_traceback_exits_with_3_and_leaves_nothing(originals, tmp_path, capfd, what):
    argv, words = VERBS[what]
    here = tmp_path / "here"
    shutil.copytree(originals, here)
    shutil.copytree(here / "frames" / "frames", here / "bare")
    shutil.copytree(here / "frames", here / "late")
    for image in sorted((here / "late" / "frames").iterdir()):
        image.rename(image.with_name(f"{int(image.stem) + 900:06d}.png"))
    shutil.rmtree(here / "late" / "truth")
    cv2.imwrite(str(here / "mask.png"), np.full((10, 10), 255, np.uint8))
    extra = ["--checkpoint", "decline"] if argv[0] != "train" else []
    assert main([a.replace("HERE", str(here)) for a in argv] + extra + ["-o", str(tmp_path / "out")]) == 3
    err = capfd.readouterr().err
    assert words in err and "Traceback" not in err
    assert sorted(os.listdir(tmp_path)) == ["here"]


def test_one_broken_image_does_not_keep_the_others_from_being_read(originals, tmp_path, capfd):
    shutil.copytree(originals / "frames", tmp_path / "frames")
    (tmp_path / "frames" / "frames" / "000000.png").write_bytes(b"")
    read = open_sequence(tmp_path / "frames")
    assert read[1].number == 1 and read[2].number == 2
    with pytest.raises(InputError, match="0 bytes"):
        read[0]


def table() -> str:
    """Markdown: every mistake and what is said to it, without the folders it was made in."""
    lines = ["| the user | refused | what the program says |", "|---|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        made(Path(folder) / "originals")
        for case in MISTAKES:
            at = Path(folder) / case.make.__name__
            message, refused = said(case, Path(folder) / "originals", at)
            message = message.replace(f"{at}/", "").replace(str(at), ".").replace("|", "\\|").replace("\n", "<br>")
            lines.append(f"| {case.did} | {'yes' if refused else 'warned'} | {message} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
