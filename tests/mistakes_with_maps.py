"""What users get wrong with data sets, maps and splits."""

from __future__ import annotations

import shutil
from dataclasses import replace

import cv2
import numpy as np
from colons import colon, sequence
from mistakes import edit_images, edit_lines, edit_times, mistake, rewrite_images
from scipy.spatial.transform import Rotation

from lightdepth.datasets.catalogue import read_dataset_yaml
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.maps import read_map

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
    edit_lines(path / "pose.txt", lambda lines: lines[:2])


@mistake("Writes twelve numbers a pose", "c3vd", "pose.txt: 12 numbers a line; expected 16")
def twelve_numbers(path):
    edit_lines(path / "pose.txt", lambda lines: [",".join(line.split(",")[:12]) for line in lines])


@mistake("Scaled a rotation", "c3vd", "pose.txt: line 2: the pose is not a rotation", "is it scaled, or mirrored?")
def scaled_rotation(path):
    def scale(lines):
        return [lines[0], ",".join(str(1.1 * float(v)) for v in lines[1].split(",")[:15]) + ",1", lines[2]]

    edit_lines(path / "pose.txt", scale)


@mistake("Has NaN in pose.txt", "c3vd", "pose.txt: line 2: the pose has NaN")
def nan_in_pose_txt(path):
    edit_lines(path / "pose.txt", lambda lines: [lines[0], "nan," + lines[1].split(",", 1)[1], lines[2]])


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

    rewrite_images(path, weave)


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

    edit_images(path, pose=invert)


@mistake("Wrote a map's quaternions x y z w", "colmap", "with the quaternions read as x y z w. Write them as w x y z")
def quaternion_order(path):
    edit_images(path, pose=lambda w: [w[0], *w[2:5], w[1], *w[5:]])


@mistake(
    "Ran the SLAM on images of half the size",
    "colmap",
    "with the camera at half its size",
    "Correct the size and intrinsics",
)
def half_size_map(path):
    edit_images(path, keypoints=lambda xy: xy / 2)


@mistake(
    "Mixed two conventions of pixels: half a pixel",
    "colmap",
    "median reprojection error",
    "+0.5 px",
    "count pixels alike",
    refused=False,
)
def half_a_pixel(path):
    edit_images(path, keypoints=lambda xy: xy - 0.5)


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
    edit_lines(path / "images.txt", lambda lines: [lines[0], *lines[2:]])


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
    edit_lines(path / "KeyFrameTrajectory.txt", lambda lines: [f"{17 + i}e17 0 0 0 0 0 0 1" for i in range(len(lines))])


@mistake("Writes times in seconds without the video's fps", "tum", "the time 0.04 is not a frame number", '"fps"')
def seconds_without_fps(path):
    edit_lines(path / "KeyFrameTrajectory.txt", lambda lines: [f"{0.04 * i} 0 0 0 0 0 0 1" for i in range(len(lines))])


@mistake("Writes times in milliseconds", "tum", "keyframes 1000 to 3000", "none in common", "in milliseconds?")
def milliseconds(path):
    edit_times(path, [1000 / 30, 2000 / 30, 3000 / 30])
    return lambda: check_shared_frames(read_map(path), sequence(colon(0, 3, 6.0).frames))


@mistake("Gives frames named by times with a map of numbers", "colmap", "none in common", "the frames' names are times")
def times_beside_numbers(path):
    frames = sequence([replace(f, name=f"frame_{(f.number + 3) / 30:.4f}") for f in colon(0, 3, 6.0).frames])
    return lambda: check_shared_frames(read_map(path), frames)


@mistake("Gives the folder that an export made", "colmap", "no map in it, but in map_000", "map_000/sparse")
def folder_above_the_maps(path):
    model = path.parent / "exported" / "map_000" / "sparse" / "0"
    shutil.copytree(path, model)
    return lambda: read_map(path.parent / "exported")


@mistake("Gives the map of another cut of the video", "tum", "1 of 3 keyframes", "in milliseconds?", refused=False)
def most_keyframes_without_a_frame(path):
    edit_times(path, [0, 1000 / 30, 2000 / 30])
    return lambda: check_shared_frames(read_map(path), sequence(colon(0, 3, 6.0).frames))


@mistake("Exported two maps of one number", "multimap", "0 and 00 are both map 0; rename one of them")
def map_twice(path):
    shutil.copytree(path / "3D_maps" / "0", path / "3D_maps" / "00")


@mistake("Has NaN among the points", "multimap", "points3D.txt, line", "is not finite")
def nan_point(path):
    def spoil(lines):
        words = lines[-1].split()
        return [*lines[:-1], " ".join([words[0], "nan", *words[2:]])]

    edit_lines(path / "3D_maps" / "0" / "points3D.txt", spoil)


# ---- splits


@mistake("Trains and tests on one sequence", "split", "split.yaml: A of test, which is a, is in train too")
def overlap(path):
    (path / "split.yaml").write_text("parts:\n  train: [a]\n  test: [A]\n")


@mistake("Follows a split that leads outside", "split", "split.yaml: train: '../../etc': leads outside the data's root")
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
