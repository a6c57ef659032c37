"""Maps on disk: a small scene whose every number is known, written and read back, and what is refused."""

import json
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import refused

from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.errors import InputError
from lightdepth.maps import read_map, read_trajectory, write_multimap, write_text_model
from lightdepth.maps.checks import reprojection
from lightdepth.sparse_map import Keyframe, SparseMap, Submap

PINHOLE = Pinhole(640, 480, 500.0, 510.0, 322.25, 238.5)
FISHEYE = KannalaBrandt(720, 540, 363.3, 363.9, 371.4, 271.0, -0.129, -0.006, 0.0017, -8e-5)


def rotation(axis: list[float], angle: float) -> np.ndarray:
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def scene(camera: CameraModel = PINHOLE, map_id: int = 0, first: int = 12, count: int = 4) -> Submap:
    """Points in front of a camera that moves sideways; every keyframe sees what projects into it, exactly."""
    rng = np.random.default_rng(map_id)
    points = rng.uniform([-25, -20, 30], [25, 20, 60], (60, 3))
    ids = np.sort(rng.choice(500, 60, replace=False)).astype(np.int64)
    keyframes = []
    for k in range(count):
        pose = np.eye(4)
        pose[:3, :3] = rotation([0.3, 1, 0.2], 0.1 + 0.05 * k)
        pose[:3, 3] = [2.0 * k - 6, 0.3 * k, 1.0]
        pixels, seen = camera.project(points @ pose[:3, :3].T + pose[:3, 3])
        keyframes.append(Keyframe(f"{first + k:06d}.png", camera, pose, pixels[seen], ids[seen]))
    return Submap(map_id, tuple(keyframes), ids, points)


def two_maps() -> SparseMap:
    return SparseMap((scene(FISHEYE, 0), scene(FISHEYE, 3, first=14)), "two")


def assert_equal_maps(a: Submap, b: Submap, atol: float = 0.0) -> None:
    assert a.id == b.id and np.array_equal(a.point_ids, b.point_ids)
    assert np.allclose(a.points, b.points, rtol=0, atol=atol)
    for x, y in zip(a.keyframes, b.keyframes, strict=True):
        assert x.name == y.name and type(x.camera) is type(y.camera)
        assert np.allclose(x.camera.params, y.camera.params, rtol=0, atol=atol)
        assert np.allclose(x.cam_from_map, y.cam_from_map, rtol=0, atol=max(atol, 1e-14))
        assert np.allclose(x.pixels, y.pixels, rtol=0, atol=atol)
        assert np.array_equal(x.point_ids, y.point_ids)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def line_of(path: Path, number: int) -> str:
    return path.read_text().split("\n")[number - 1]


# ---- COLMAP models


@pytest.mark.parametrize(
    "camera",
    [
        PINHOLE,
        FISHEYE,
        Brown(640, 480, 500.0, 510.0, 322.25, 238.5, -0.2, 0.05, 0.001, -0.002),
        Scaramuzza(640, 480, 322.25, 238.5, 400.0, 0.0, -8e-4, 6e-7, -1e-9, 0.9999, 0.003, -0.003),
    ],
    ids=lambda c: c.name,
)
def test_a_text_model_comes_back_bit_for_bit_on_every_lens(tmp_path, camera):
    write_text_model(scene(camera), tmp_path)
    assert_equal_maps(read_map(tmp_path).submaps[0], scene(camera))


def test_binary_equals_text_with_and_without_the_rigs_and_frames_files(tmp_path):
    from lightdepth.native import pycolmap

    write_text_model(scene(FISHEYE), tmp_path / "text")
    (tmp_path / "binary").mkdir()
    model = pycolmap().Reconstruction(tmp_path / "text")
    model.write_binary(tmp_path / "binary")
    assert (tmp_path / "binary" / "rigs.bin").exists()
    text, binary = read_map(tmp_path / "text").submaps[0], read_map(tmp_path / "binary").submaps[0]
    assert_equal_maps(text, binary)
    for part in ("rigs", "frames"):
        (tmp_path / "binary" / f"{part}.bin").unlink()
    assert_equal_maps(text, read_map(tmp_path / "binary").submaps[0])
    model.write_text(tmp_path / "text")
    assert (tmp_path / "text" / "frames.txt").exists()
    assert_equal_maps(binary, read_map(tmp_path / "text").submaps[0])


def test_colmap_accepts_the_written_model_and_its_tracks(tmp_path):
    from lightdepth.native import pycolmap

    submap = scene()
    blue = {k.name: np.broadcast_to([0.0, 0.5, 1.0], (480, 640, 3)) for k in submap.keyframes}
    write_text_model(submap, tmp_path, images=blue)
    model = pycolmap().Reconstruction(tmp_path)
    assert model.is_valid() and model.compute_mean_reprojection_error() < 1e-9
    assert model.compute_num_observations() == sum(len(k.pixels) for k in submap.keyframes)
    seen = next(p for p in model.points3D.values() if p.track.length())
    assert seen.color.tolist() == [0, 128, 255]


def test_numbered_models_become_submaps_with_their_numbers_wherever_they_lie(tmp_path):
    for map_id in (0, 11):
        write_text_model(scene(map_id=map_id), tmp_path / "sparse" / str(map_id))
    for path in (tmp_path, tmp_path / "sparse"):
        assert [s.id for s in read_map(path).submaps] == [0, 11]
    assert [s.id for s in read_map(tmp_path / "sparse" / "11").submaps] == [11]


def test_a_model_folder_without_a_number_is_map_0(tmp_path):
    write_text_model(scene(), tmp_path / "model")
    assert read_map(tmp_path / "model").submaps[0].id == 0


def test_points_may_lack_colour_error_and_track_and_ids_may_start_at_0(tmp_path):
    write_text_model(scene(), tmp_path)
    points = [line for line in (tmp_path / "points3D.txt").read_text().split("\n") if line and line[0] != "#"]
    bare = [" ".join(line.split()[: (4, 7, 8)[k % 3]]) for k, line in enumerate(points)]
    (tmp_path / "points3D.txt").write_text("# comment\n\n" + "\n".join(bare) + "\n")
    assert_equal_maps(read_map(tmp_path).submaps[0], scene())


def test_keypoints_without_a_point_are_left_out_and_an_image_may_have_none(tmp_path):
    write_text_model(scene(), tmp_path)
    lines = (tmp_path / "images.txt").read_text().split("\n")
    lines[3] = "1.5 2.5 -1 " + lines[3] + " 3.5 4.5 18446744073709551615"
    lines[5] = ""
    (tmp_path / "images.txt").write_text("\n".join(lines))
    (submap,) = read_map(tmp_path).submaps
    assert np.array_equal(submap.keyframes[0].pixels, scene().keyframes[0].pixels)
    assert len(submap.keyframes[1].pixels) == 0


# ---- the multi-map tree


def test_a_multimap_tree_comes_back_within_1e_9(tmp_path):
    write_multimap(two_maps(), tmp_path)
    for a, b in zip(read_map(tmp_path).submaps, two_maps().submaps, strict=True):
        assert_equal_maps(a, b, atol=1e-9)


@pytest.mark.parametrize("below", ["output", "run_2", ""])
def test_the_tree_is_found_directly_under_output_or_under_a_run(tmp_path, below):
    write_multimap(two_maps(), tmp_path / below)
    assert [s.id for s in read_map(tmp_path).submaps] == [0, 3]
    assert [s.id for s in read_map(tmp_path / below / "3D_maps").submaps] == [0, 3]


def test_one_map_of_the_tree_alone_is_read_with_the_tree_s_pixels(tmp_path):
    write_multimap(two_maps(), tmp_path)
    assert_equal_maps(read_map(tmp_path / "3D_maps" / "3").submaps[0], two_maps().submaps[1], atol=1e-9)


def test_the_tree_has_the_exporter_s_traits(tmp_path):
    write_multimap(two_maps(), tmp_path)
    folder = tmp_path / "3D_maps" / "0"
    assert line_of(folder / "cameras.txt", 4).startswith(
        "0 OPENCV_FISHEYE 720 540 363.300000 363.900000 370.900000 270.5"
    )
    name = line_of(folder / "images.txt", 4).split()
    assert (name[0], name[8], name[9]) == ("0", "0", "000012.png")
    assert line_of(folder / "points3D.txt", 3).endswith(" 0 0 0 0 ")
    row = line_of(tmp_path / "camera_trajectory" / "cam_traj_map_003.txt", 2).split(",")
    assert len(row) == 12 and row[1] == "000014.png" and row[9:] == ["1", "0", "-1"]


def test_keypoints_and_principal_point_both_move_by_half_a_pixel(tmp_path):
    write_multimap(two_maps(), tmp_path)
    keyframe = read_map(tmp_path).submaps[0].keyframes[0]
    folder = tmp_path / "3D_maps" / "0"
    in_file = np.array(line_of(folder / "images.txt", 5).split()[:2], float)
    assert np.allclose(keyframe.pixels[0], in_file + 0.5)
    assert keyframe.camera.params[2] == pytest.approx(float(line_of(folder / "cameras.txt", 4).split()[6]) + 0.5)
    # The same files as a plain COLMAP model are already in our convention.
    shutil.copytree(folder, tmp_path / "plain")
    plain = read_map(tmp_path / "plain").submaps[0].keyframes[0]
    assert np.allclose(plain.pixels[0], in_file)
    assert plain.camera.params[2] == pytest.approx(keyframe.camera.params[2] - 0.5)


def test_a_file_beside_the_map_declares_another_convention(tmp_path):
    write_multimap(two_maps(), tmp_path)
    (tmp_path / "3D_maps" / "densify_map.json").write_text(json.dumps({"pixel_center": 0.5, "frame_offset": -1}))
    keyframe = read_map(tmp_path).submaps[0].keyframes[0]
    assert np.allclose(keyframe.pixels, two_maps().submaps[0].keyframes[0].pixels - 0.5)
    assert keyframe.name == "000011.png"


def test_undistorted_keypoints_are_put_back_where_the_lens_had_them_when_declared_and_refused_when_not(tmp_path):
    submap = scene(FISHEYE)
    matrix = FISHEYE.matrix
    straight = []
    for k in submap.keyframes:
        points = k.in_camera(submap.observed_points(k)[1]) @ matrix.T
        straight.append(replace(k, pixels=points[:, :2] / points[:, 2:]))
    write_text_model(replace(submap, keyframes=tuple(straight)), tmp_path)
    with refused(cure="0.00 px with undistorted keypoints"):
        read_map(tmp_path)
    (tmp_path / "densify_map.json").write_text('{"keypoints": "undistorted"}')
    assert_equal_maps(read_map(tmp_path).submaps[0], submap, atol=1e-9)


@pytest.mark.parametrize(
    ("declared", "says"),
    [
        ({"pixel_center": 0.25}, "pixel_center … 0.0 (OpenCV) or 0.5"),
        ({"pose_convention": "wc"}, "pose_convention"),
        ({"pixel_centre": 0.5}, "pixel_centre"),
        ({"map_id": 7}, "map_id 7 in the folder of map 0"),
    ],
)
def test_a_wrong_declaration_is_refused(tmp_path, declared, says):
    write_text_model(scene(), tmp_path)
    (tmp_path / "densify_map.json").write_text(json.dumps(declared))
    with refused("densify_map.json", says):
        read_map(tmp_path)


def test_the_trajectory_holds_every_localised_frame_and_says_which_are_keyframes(tmp_path):
    submap = two_maps().submaps[0]
    between = np.eye(4)
    between[:3, :3], between[:3, 3] = rotation([1, 2, 3], 0.4), [1.0, -2.0, 3.0]
    write_multimap(SparseMap((submap,), "one"), tmp_path, {0: {"000099.png": between}}, times={"000099.png": 7.5})
    path = tmp_path / "camera_trajectory" / "cam_traj_map_000.txt"
    path.write_text(path.read_text() + "8.0,000100.png,nan,nan,nan,1,0,0,0,0,0,-1\n")
    poses = read_trajectory(path)
    assert [p.name for p in poses] == [k.name for k in submap.keyframes] + ["000099.png"]
    assert [p.is_keyframe for p in poses] == [True] * 4 + [False]
    assert poses[-1].time == 7.5 and poses[0].time == pytest.approx(12 / 30, abs=1e-6)
    assert np.allclose(poses[-1].cam_from_map, between, atol=1e-8)
    assert np.allclose(poses[0].cam_from_map, submap.keyframes[0].cam_from_map, atol=1e-8)


def test_a_tree_without_images_takes_keyframes_from_the_trajectory_and_warns_that_visibility_is_weak(tmp_path):
    write_multimap(two_maps(), tmp_path)
    for map_id in (0, 3):
        (tmp_path / "3D_maps" / str(map_id) / "images.txt").unlink()
    with pytest.warns(UserWarning, match="no keyframe says which points it observed"):
        weak = read_map(tmp_path).submaps[0]
    true = two_maps().submaps[0]
    assert weak.weak_visibility and not true.weak_visibility
    for a, b in zip(weak.keyframes, true.keyframes, strict=True):
        assert a.name == b.name and np.array_equal(a.point_ids, b.point_ids)
        assert np.allclose(a.pixels, b.pixels, atol=1e-4)


# ---- readings that do not fit


def changed(change: Callable[[Keyframe], Keyframe]) -> Submap:
    submap = scene(FISHEYE)
    return replace(submap, keyframes=tuple(change(k) for k in submap.keyframes))


def test_inverse_poses_are_refused_and_named_and_read_when_declared(tmp_path):
    write_text_model(changed(lambda k: replace(k, cam_from_map=np.linalg.inv(k.cam_from_map))), tmp_path)
    with refused(found="median reprojection error", cure="would be 0.00 px with the inverse poses"):
        read_map(tmp_path)
    (tmp_path / "densify_map.json").write_text('{"pose_convention": "c2w"}')
    assert_equal_maps(read_map(tmp_path).submaps[0], scene(FISHEYE), atol=1e-9)


@pytest.mark.parametrize(("size", "says"), [((1440, 1080), "at half its size"), ((360, 270), "at double its size")])
def test_a_camera_of_another_size_than_the_keypoints_is_refused_and_named(tmp_path, size, says):
    write_text_model(changed(lambda k: replace(k, camera=k.camera.resized(*size))), tmp_path)
    with refused(cure=f"would be 0.00 px with the camera {says}"):
        read_map(tmp_path)


def test_quaternions_with_w_last_are_refused_and_named(tmp_path):
    write_text_model(scene(FISHEYE), tmp_path)
    lines = (tmp_path / "images.txt").read_text().split("\n")
    for n in range(2, len(lines) - 1, 2):
        image_id, w, x, y, z, *rest = lines[n].split()
        lines[n] = " ".join([image_id, x, y, z, w, *rest])
    (tmp_path / "images.txt").write_text("\n".join(lines))
    with refused(cure="would be 0.00 px with the quaternions read as x y z w"):
        read_map(tmp_path)


def test_a_map_that_fits_no_reading_is_read_with_a_warning(tmp_path):
    rng = np.random.default_rng(0)
    write_text_model(changed(lambda k: replace(k, pixels=k.pixels + rng.normal(0, 40, k.pixels.shape))), tmp_path)
    with pytest.warns(UserWarning, match="median reprojection error .* px.*expected about 1 px"):
        read_map(tmp_path)


def test_a_few_pixels_of_noise_pass_without_a_word(tmp_path):
    rng = np.random.default_rng(0)
    write_text_model(changed(lambda k: replace(k, pixels=k.pixels + rng.normal(0, 1.5, k.pixels.shape))), tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_map(tmp_path)


# ---- bad input


def refusal(path: Path, *says: str) -> None:
    with pytest.raises(InputError) as raised:
        read_map(path)
    for words in says:
        assert words in str(raised.value), raised.value


def test_a_missing_path_is_refused_with_what_would_be_right(tmp_path):
    refusal(tmp_path / "nowhere", "nowhere: no such file or folder", "COLMAP model", "3D_maps/0")


def test_an_empty_folder_and_a_folder_of_other_things_are_refused_with_what_was_found(tmp_path):
    refusal(tmp_path, "the folder is empty")
    (tmp_path / "frames").mkdir()
    (tmp_path / "0").mkdir()
    refusal(tmp_path, "found 0, frames", "expected a COLMAP model")
    (tmp_path / "3D_maps").mkdir()
    refusal(tmp_path, "3D_maps: no map in it")


@pytest.mark.parametrize("part", ["cameras.txt", "images.txt", "points3D.txt"])
def test_a_model_with_a_file_missing_is_refused_by_its_name(tmp_path, part):
    write_text_model(scene(), tmp_path)
    (tmp_path / part).unlink()
    refusal(tmp_path, f"{part} missing")


def test_two_folders_of_one_number_are_refused(tmp_path):
    write_multimap(SparseMap((scene(),), "one"), tmp_path)
    shutil.copytree(tmp_path / "3D_maps" / "0", tmp_path / "3D_maps" / "000")
    refusal(tmp_path, "0 and 000 are both map 0")
    refused_plain = tmp_path / "sparse"
    shutil.copytree(tmp_path / "3D_maps", refused_plain)
    refusal(refused_plain, "0 and 000 are both map 0")


def test_several_runs_below_one_folder_are_refused(tmp_path):
    for run in ("1", "2"):
        write_multimap(two_maps(), tmp_path / run)
    refusal(tmp_path, "several runs", "(1, 2)")


def test_an_empty_map_is_refused(tmp_path):
    for part, says in (("images", "no images"), ("points3D", "no points")):
        write_text_model(scene(), tmp_path)
        (tmp_path / f"{part}.txt").write_text("# nothing\n")
        refusal(tmp_path, says, str(tmp_path))


@pytest.mark.parametrize(
    ("part", "number", "replacement", "says"),
    [
        ("cameras", 2, "1 PINHOLE 640 480 500 510 322", "3 parameters of PINHOLE; expected 4"),
        ("cameras", 2, "1 PINHOLE 640 480 500 510 322 238 1", "5 parameters of PINHOLE; expected 4"),
        ("cameras", 2, "1 TELESCOPE 640 480 500 510 322 238", "unknown camera model 'TELESCOPE'"),
        ("cameras", 2, "1 PINHOLE wide 480 500 510 322 238", "'wide', which is not an integer"),
        ("images", 3, "1 1 0 0 0 0 0 0 1", "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        ("images", 3, "1 1 0 0 zero 0 0 0 1 000012.png", "'zero', which is not a number"),
        ("images", 3, "1 nan 0 0 0 0 0 0 1 000012.png", "image 000012.png: the pose has NaN"),
        ("images", 3, "1 1 0 0 0 inf 0 0 1 000012.png", "image 000012.png: the pose has NaN or infinite"),
        ("images", 3, "1 0 0 0 0 0 0 0 1 000012.png", "quaternion of norm 0"),
        ("images", 4, "1.5 2.5 3 4.5", "4 numbers; expected X Y POINT3D_ID"),
        ("images", 4, "1.5 2,5 3", "'2,5', which is not a number"),
        ("images", 4, "nan 2.5 3", "NaN or infinite keypoints"),
        ("points3D", 2, "7 1.0 2.0", "expected POINT3D_ID X Y Z"),
        ("points3D", 2, "7 1.0 2.0 far 0 0 0 0", "'far', which is not a number"),
        ("points3D", 2, "seven 1.0 2.0 3.0 0 0 0 0", "'seven', which is not an integer"),
        ("points3D", 2, "7 1.0 nan 3.0 0 0 0 0", "point 7 is not finite (1 such)"),
    ],
)
def test_a_line_that_cannot_be_read_is_refused_with_file_and_line(tmp_path, part, number, replacement, says):
    write_text_model(scene(), tmp_path)
    path = tmp_path / f"{part}.txt"
    edit(path, line_of(path, number) + "\n", replacement + "\n")
    refusal(tmp_path, f"{part}.txt, line {number}", says)


def test_an_image_of_a_camera_that_is_not_there_is_refused(tmp_path):
    write_text_model(scene(), tmp_path)
    edit(tmp_path / "images.txt", "1 000012.png", "5 000012.png")
    refusal(tmp_path, "image 000012.png has camera 5", "cameras.txt, which has 1")


def test_one_point_or_one_frame_twice_and_a_name_without_a_number_are_refused(tmp_path):
    write_text_model(scene(), tmp_path)
    points = tmp_path / "points3D.txt"
    points.write_text(points.read_text() + line_of(points, 2) + "\n")
    refusal(tmp_path, f"point {line_of(points, 2).split()[0]} is in points3D twice")
    write_text_model(scene(), tmp_path)
    edit(tmp_path / "images.txt", "000013.png", "000012.jpg")
    refusal(tmp_path, str(tmp_path), "frame 12 is in it twice")
    edit(tmp_path / "images.txt", "000012.jpg", "polyp.png")
    refusal(tmp_path, "polyp.png: no number in the name")


def test_broken_binary_files_are_refused_by_name(tmp_path):
    from lightdepth.native import pycolmap

    write_text_model(scene(), tmp_path / "text")
    pycolmap().Reconstruction(tmp_path / "text").write_binary(tmp_path)
    for part in ("cameras", "images", "points3D"):
        path = tmp_path / f"{part}.bin"
        whole = path.read_bytes()
        for broken, says in (
            (whole[:-5], "ends too early"),
            (whole + b"more", "4 bytes too many"),
            (b"", "ends too early"),
        ):
            path.write_bytes(broken)
            refusal(tmp_path, f"{part}.bin", says)
        path.write_bytes(whole)
    cameras = tmp_path / "cameras.bin"
    cameras.write_bytes(cameras.read_bytes()[:12] + (99).to_bytes(4, "little") + cameras.read_bytes()[16:])
    refusal(tmp_path, "cameras.bin", "unknown model number 99")


def test_a_binary_file_named_txt_is_refused(tmp_path):
    write_text_model(scene(), tmp_path)
    (tmp_path / "points3D.txt").write_bytes(b"\xff\xfe\x00\x80")
    refusal(tmp_path, "points3D.txt: not a text file")


def test_an_orb_slam_atlas_is_refused_with_the_export_to_make(tmp_path):
    (tmp_path / "session.osa").write_bytes(b"22 serialization::archive")
    for path in (tmp_path / "session.osa", tmp_path):
        refusal(path, "session.osa", "export the multi-map tree")


def test_a_trajectory_alone_is_refused_with_what_is_needed(tmp_path):
    (tmp_path / "KeyFrameTrajectory.txt").write_text("# time\n0.1 1 2 3 0 0 0 1\n")
    for path in (tmp_path / "KeyFrameTrajectory.txt", tmp_path):
        refusal(path, "KeyFrameTrajectory.txt: a trajectory without points", "which keyframe saw them")


def test_one_file_of_a_model_is_refused_with_the_folder_to_give(tmp_path):
    write_text_model(scene(), tmp_path)
    refusal(tmp_path / "images.txt", f"give the folder it is in, {tmp_path}")
    (tmp_path / "cloud.ply").write_text("ply\n")
    refusal(tmp_path / "cloud.ply", "no known map format")


def test_reading_maps_does_not_import_pycolmap():
    program = "import lightdepth.maps, sys; assert not {'pycolmap', 'open3d'} & set(sys.modules)"
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# ---- real maps


def test_a_real_colmap_model_has_its_known_figures_in_text_and_binary(realdata):
    folder = realdata / "sinus" / "derived_colmap"
    (text,), (binary,) = read_map(folder / "sparse_txt").submaps, read_map(folder / "sparse_bin").submaps
    assert_equal_maps(text, binary)
    assert (text.id, len(text.keyframes), len(text.points)) == (0, 35, 1769)
    assert sum(len(k.pixels) for k in text.keyframes) == 16536
    assert reprojection(text) == (pytest.approx(1.16, abs=0.01), 1.0)


def test_a_real_multimap_has_its_known_figures(realdata):
    submaps = read_map(realdata / "sinus" / "derived_multimap").submaps
    figures = [(s.id, len(s.keyframes), len(s.points), sum(len(k.pixels) for k in s.keyframes)) for s in submaps]
    assert figures == [(0, 19, 1377, 8224), (1, 20, 1328, 9873)]
    assert [round(float(np.median(s.reprojection_errors())), 2) for s in submaps] == [1.19, 1.16]
    assert submaps[0].keyframes[0].camera.params[2] == pytest.approx(872.127)
    shared = {k.number for k in submaps[0].keyframes} & {k.number for k in submaps[1].keyframes}
    assert shared == {4599, 4600, 4601, 4602}


def test_a_real_multimap_is_written_as_it_was(realdata, tmp_path):
    original = realdata / "sinus" / "derived_multimap" / "output"
    write_multimap(read_map(original), tmp_path)
    for map_id in ("0", "1"):
        for part in ("cameras", "points3D"):
            path = Path("3D_maps") / map_id / f"{part}.txt"
            assert (tmp_path / path).read_bytes() == (original / path).read_bytes()
    # Quaternions may differ in the fifteenth decimal; everything else is the same text.
    ours, theirs = ((root / "3D_maps/1/images.txt").read_text().split() for root in (tmp_path, original))
    assert len(ours) == len(theirs)
    different = [(a, b) for a, b in zip(ours, theirs, strict=True) if a != b]
    assert all(abs(float(a) - float(b)) < 3e-15 for a, b in different)


def test_the_inverse_poses_of_a_real_map_are_noticed(realdata, tmp_path):
    (submap,) = read_map(realdata / "sinus" / "derived_multimap" / "output" / "3D_maps" / "0").submaps
    inverse = tuple(replace(k, cam_from_map=np.linalg.inv(k.cam_from_map)) for k in submap.keyframes)
    write_text_model(replace(submap, keyframes=inverse), tmp_path)
    refusal(tmp_path, "it would be 1.19 px with the inverse poses")
