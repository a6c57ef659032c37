"""Maps of stella_vslam, and trajectories with point clouds: the small scene of test_maps, written and read back."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from raising import refused, warned
from scipy.spatial.transform import Rotation
from test_maps import FISHEYE, PINHOLE, assert_equal_maps, edit, refusal, scene

from lightdepth.calibration import write_camera
from lightdepth.camera import Brown, FullBrown, Pinhole, Scaramuzza
from lightdepth.maps import read_map, write_stella, write_text_model
from lightdepth.sparse_map import Keyframe, Submap

BROWN = Brown(640, 480, 500.0, 510.0, 322.25, 238.5, -0.2, 0.05, 0.001, -0.002)
GUESSED = "do not say which keyframe observed which point"


def write_tum(submap: Submap, folder: Path, fps: float | None = None, name: str = "KeyFrameTrajectory.txt") -> Path:
    """Trajectory and camera.json; times are frame numbers, or seconds where fps is given."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# t tx ty tz qx qy qz qw"]
    for k in submap.keyframes:
        pose = np.linalg.inv(k.cam_from_map)
        time = k.number if fps is None else k.number / fps
        numbers = (time, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat())
        lines.append(" ".join(f"{v:.12f}" for v in numbers))
    (folder / name).write_text("\n".join(lines) + "\n")
    write_camera(submap.keyframes[0].camera, folder / "camera.json")
    return folder / name


def write_points(submap: Submap, path: Path) -> None:
    """points3D.txt as CLiMB writes it, an ASCII PLY, or lines of x y z."""
    rows = [" ".join(f"{v:.12f}" for v in p) for p in submap.points]
    if path.suffix == ".ply":
        axes = "".join(f"property double {axis}\n" for axis in "xyz")
        rows.insert(0, f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{axes}end_header")
    elif path.name == "points3D.txt":
        rows = [f"{i} {row} 0 0 0 0 " for i, row in zip(submap.point_ids, rows, strict=True)]
    path.write_text("\n".join(rows) + "\n")


def read_weak(folder: Path) -> Submap:
    with pytest.warns(UserWarning, match=GUESSED):
        (submap,) = read_map(folder).submaps
    assert submap.weak_visibility
    return submap


def tum_map(folder: Path, **how) -> Path:
    trajectory = write_tum(scene(), folder, **how)
    write_points(scene(), folder / "points3D.txt")
    return trajectory


# ---- TUM trajectory with a point cloud


def test_a_trajectory_with_points_comes_back_with_its_poses_ids_and_camera_and_a_warning(tmp_path):
    tum_map(tmp_path)
    weak, true = read_weak(tmp_path), scene()
    assert np.array_equal(weak.point_ids, true.point_ids) and np.allclose(weak.points, true.points, atol=1e-9)
    for a, b in zip(weak.keyframes, true.keyframes, strict=True):
        assert a.name == b.name and np.allclose(a.cam_from_map, b.cam_from_map, atol=1e-9)
        assert np.allclose(a.camera.params, b.camera.params)
        assert len(a.point_ids) and set(a.point_ids) <= set(b.point_ids)
    assert np.median(weak.reprojection_errors()) < 1e-6


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.xyz", "cloud.txt"])
def test_a_ply_or_lines_of_x_y_z_stand_in_for_points3d_with_ids_from_0(tmp_path, name):
    write_tum(scene(), tmp_path)
    write_points(scene(), tmp_path / name)
    weak = read_weak(tmp_path)
    assert np.array_equal(weak.point_ids, np.arange(60)) and np.allclose(weak.points, scene().points, atol=1e-6)


def test_a_trajectory_may_have_any_name_where_it_is_the_only_one(tmp_path):
    tum_map(tmp_path, name="run 3.tum")
    assert len(read_weak(tmp_path).keyframes) == 4
    tum_map(tmp_path, name="other.txt")
    refusal(tmp_path, "several trajectories (other.txt, run 3.tum)")
    tum_map(tmp_path)
    assert len(read_weak(tmp_path).keyframes) == 4


def test_seconds_become_frame_numbers_by_the_declared_rate_and_are_refused_without_one(tmp_path):
    tum_map(tmp_path, fps=29.97)
    refusal(tmp_path, "KeyFrameTrajectory.txt: the time 0.4004 is not a frame number", '"fps"', "densify_map.json")
    (tmp_path / "densify_map.json").write_text('{"fps": 29.97, "frame_offset": -1}')
    assert [k.name for k in read_weak(tmp_path).keyframes] == [f"{n:06d}.png" for n in (11, 12, 13, 14)]
    (tmp_path / "densify_map.json").write_text('{"fps": 3}')
    refusal(tmp_path, "keyframes fall on frame 1; is fps in densify_map.json too low?")
    (tmp_path / "densify_map.json").write_text('{"fps": 0}')
    refusal(tmp_path, "densify_map.json: fps")


def test_nanoseconds_and_negative_times_are_no_frame_numbers(tmp_path):
    trajectory = tum_map(tmp_path)
    for time in ("1403636579763555584", "-1"):
        tum_map(tmp_path)
        edit(trajectory, "12.000000000000", time)
        refusal(tmp_path, "KeyFrameTrajectory.txt: the time", "falls on no frame")


def test_cameras_txt_is_in_opencv_s_pixels_unless_declared_and_must_hold_one_camera(tmp_path):
    tum_map(tmp_path)
    (tmp_path / "camera.json").unlink()
    refusal(tmp_path, "no camera; a trajectory with points needs camera.json or cameras.txt")
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 510 321.75 238\n")
    assert np.allclose(read_weak(tmp_path).keyframes[0].camera.params, PINHOLE.params)
    (tmp_path / "densify_map.json").write_text('{"pixel_center": 0.5}')
    assert read_weak(tmp_path).keyframes[0].camera.params[2] == 321.75
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 510 321 238\n2 PINHOLE 640 480 500 510 321 238\n")
    refusal(tmp_path, "cameras.txt: 2 cameras")


def test_a_point_far_behind_a_nearer_one_is_not_observed_and_one_little_behind_is(tmp_path):
    camera = Pinhole(320, 320, 200.0, 200.0, 160.0, 160.0)
    points = np.array([[0.1, 0.1, 10.0], [0.12, 0.12, 12.0], [0.4, 0.4, 40.0], [20.0, 0.0, 40.0]])
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    submap = Submap(0, (Keyframe("000001.png", camera, np.eye(4), *none),), np.arange(4), points)
    write_tum(submap, tmp_path)
    write_points(submap, tmp_path / "points3D.txt")
    assert read_weak(tmp_path).keyframes[0].point_ids.tolist() == [0, 1, 3]


def test_numbered_models_beside_a_trajectory_are_read_first(tmp_path):
    tum_map(tmp_path)
    write_text_model(scene(), tmp_path / "sparse" / "5")
    assert [s.id for s in read_map(tmp_path).submaps] == [5]


def test_a_trajectory_with_something_missing_or_broken_is_refused_by_file(tmp_path):
    trajectory = write_tum(scene(), tmp_path)
    refusal(tmp_path, "KeyFrameTrajectory.txt: a trajectory without points", "points3D.txt, a PLY")
    for cloud, says in (
        ("cloud.ply", "cloud.ply: not a PLY"),
        ("cloud.xyz", "cloud.xyz, line 2: 2 columns; expected x y z"),
        ("points3D.txt", "points3D.txt, line 1: found '1 2 3'"),
    ):
        path = tmp_path / cloud
        path.write_text("ply\nformat none\n" if path.suffix == ".ply" else "1 2 3\n4 5\n")
        if cloud != "points3D.txt":
            refusal(tmp_path, says)
        path.unlink()
    for cloud in ("a.ply", "b.ply"):
        write_points(scene(), tmp_path / cloud)
    refusal(tmp_path, "several point clouds (a.ply, b.ply)")
    (tmp_path / "b.ply").unlink()
    refusal(trajectory, f"give the folder it is in, {tmp_path}")
    write_points(replace(scene(), points=scene().points + [0, 0, 1e4]), tmp_path / "a.ply")
    edit(trajectory, "12.000000000000", "twelve")
    refusal(tmp_path, "KeyFrameTrajectory.txt: not a TUM trajectory")


def test_points_that_no_keyframe_has_in_view_are_refused(tmp_path):
    tum_map(tmp_path)
    write_points(replace(scene(), points=scene().points - [0, 0, 1e4]), tmp_path / "points3D.txt")
    refusal(tmp_path, str(tmp_path), "none has a point in its view", "pose_convention")


# ---- stella_vslam


@pytest.mark.parametrize("suffix", [".msg", ".json"])
@pytest.mark.parametrize("camera", [PINHOLE, BROWN, FISHEYE], ids=lambda c: c.name)
def test_a_stella_map_comes_back_within_1e_9_on_its_lenses(tmp_path, camera, suffix):
    write_stella(scene(camera), tmp_path / f"map{suffix}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (submap,) = read_map(tmp_path / f"map{suffix}").submaps
    assert_equal_maps(submap, scene(camera), atol=1e-9)
    assert not submap.weak_visibility


def test_several_stella_maps_in_one_folder_or_in_numbered_ones_are_submaps(tmp_path):
    write_stella(scene(), tmp_path / "a.msg")
    assert_equal_maps(read_map(tmp_path).submaps[0], scene(), atol=1e-9)
    write_stella(scene(), tmp_path / "b.msg")
    assert [s.id for s in read_map(tmp_path).submaps] == [0, 1]
    write_stella(scene(), tmp_path / "session" / "4" / "map.msg")
    write_stella(scene(), tmp_path / "session" / "7" / "map.msg")
    assert [s.id for s in read_map(tmp_path / "session").submaps] == [4, 7]
    write_stella(scene(), tmp_path / "session" / "7" / "again.msg")
    refusal(tmp_path / "session", "several maps (again.msg, map.msg)")
    for name in ("map_2.msg", "map_10.msg"):
        write_stella(scene(), tmp_path / "numbered" / name)
    assert [s.id for s in read_map(tmp_path / "numbered").submaps] == [2, 10]


def stella(path: Path, change) -> Path:
    """The scene in a file whose content was changed in place."""
    write_stella(scene(FISHEYE), path)
    content = msgpack.unpackb(path.read_bytes())
    change(content)
    path.write_bytes(msgpack.packb(content))
    return path


@pytest.mark.parametrize("field", ["undists", "undist_keypts"])
def test_undistorted_keypoints_alone_are_put_back_where_the_lens_had_them(tmp_path, field):
    true = scene(FISHEYE)

    def straighten(content):
        for keyframe, entry in zip(true.keyframes, content["keyframes"].values(), strict=True):
            points = keyframe.in_camera(true.observed_points(keyframe)[1]) @ FISHEYE.matrix.T
            pixels = (points[:, :2] / points[:, 2:] - 0.5).tolist()
            del entry["keypts"]
            entry[field] = pixels if field == "undists" else [{"pt": p, "ang": 0.0} for p in pixels]

    assert_equal_maps(read_map(stella(tmp_path / "m.msg", straighten)).submaps[0], true, atol=1e-8)


def test_keypoints_without_a_landmark_are_left_out(tmp_path):
    def add(content):
        entry = content["keyframes"]["0"]
        entry["keypts"].append({"pt": [1.0, 2.0]})
        entry["lm_ids"].append(-1)

    assert_equal_maps(read_map(stella(tmp_path / "m.msg", add)).submaps[0], scene(FISHEYE), atol=1e-9)


def test_the_camera_beside_the_map_stands_in_for_an_incomplete_one_and_the_file_s_own_goes_first(tmp_path):
    path = stella(tmp_path / "m.msg", lambda c: c["cameras"]["camera 0"].pop("k3"))
    refusal(path, "m.msg: cameras.camera 0.k3: missing", "put camera.json beside the map")
    write_camera(FISHEYE, tmp_path / "camera.json")
    assert_equal_maps(read_map(path).submaps[0], scene(FISHEYE), atol=1e-9)
    write_camera(PINHOLE, tmp_path / "camera.json")
    assert_equal_maps(read_map(stella(path, lambda c: None)).submaps[0], scene(FISHEYE), atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*median reprojection error")  # the keypoints are another lens's
def test_a_third_radial_term_is_read_exactly_and_radial_division_as_the_nearest_of_our_lenses(tmp_path):
    folded = FullBrown(640, 480, 500.0, 510.0, 322.25, 238.5, -0.2, 0.05, 0.001, -0.002, -0.01, 0.0, 0.0, 0.0)
    write_stella(scene(folded), tmp_path / "k3.msg")
    assert_equal_maps(read_map(tmp_path / "k3.msg").submaps[0], scene(folded), atol=1e-9)

    def division(content):
        content["cameras"]["camera 0"].update(model_type="RadialDivision", distortion=-0.1)

    path = stella(tmp_path / "division.msg", division)
    with warned("camera 0", "DIVISION", "largest"):
        camera = read_map(path).submaps[0].keyframes[0].camera
    where = np.array([0.3, -0.2])  # on the plane of the lens, x = (u - cx) / fx
    ray = np.append(where / (1 - 0.1 * where @ where), 1)
    fx, fy, cx, cy = FISHEYE.params[:4]
    assert camera.project(ray)[0] == pytest.approx(where * (fx, fy) + (cx, cy), abs=0.01)


def test_keyframes_without_a_frame_number_are_counted_by_time_where_the_rate_is_declared(tmp_path):
    def by_time(content):
        for entry in content["keyframes"].values():
            entry["ts"] = entry.pop("src_frm_id") / 40

    path = stella(tmp_path / "m.msg", by_time)
    refusal(path, "is not a frame number; give --map-fps", "densify_map.json")
    (tmp_path / "densify_map.json").write_text(json.dumps({"fps": 40}))
    assert_equal_maps(read_map(path).submaps[0], scene(FISHEYE), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("keyframes"), "keyframes missing"),
        (lambda c: c.pop("landmarks"), "landmarks missing"),
        (lambda c: c.pop("cameras"), "cameras.camera 0: missing"),
        (lambda c: c.update(keyframes={}), "no keyframes"),
        (lambda c: c.update(landmarks={}), "landmarks: no points"),
        (lambda c: c.update(landmarks=[1]), "landmarks: found list; expected fields by name"),
        (lambda c: c["landmarks"].update(seven={"pos_w": [1, 2, 3]}), "landmarks.seven: found 'seven'"),
        (lambda c: c["landmarks"].update({"7": {}}), "landmarks.7.pos_w: missing"),
        (lambda c: c["landmarks"].update({"7": {"pos_w": [1, float("nan"), 3]}}), "landmarks.7.pos_w: found [1, nan"),
        (lambda c: c["keyframes"]["0"].pop("rot_cw"), "keyframes.0.rot_cw: missing"),
        (lambda c: c["keyframes"]["0"].update(rot_cw=[0, 0, 0, 0]), "keyframes.0.rot_cw: quaternion of norm 0"),
        (lambda c: c["keyframes"]["0"].update(trans_cw=[0, 0]), "keyframes.0.trans_cw: found [0, 0]"),
        (lambda c: c["keyframes"]["0"].pop("keypts"), "keyframes.0: no keypts and no undists"),
        (lambda c: c["keyframes"]["0"].update(keypts=[{"at": [1, 2]}]), "keyframes.0.keypts: not pixels; expected"),
        (lambda c: c["keyframes"]["0"]["keypts"][0].update(pt=[1.0, float("inf")]), "keyframes.0.keypts: NaN or"),
        (lambda c: c["keyframes"]["0"]["lm_ids"].pop(), "keyframes.0.lm_ids: found"),
        (lambda c: c["keyframes"]["0"]["lm_ids"].__setitem__(0, 2**63), "0.lm_ids: found 9223372036854775808"),
        (lambda c: c["keyframes"]["0"].update(src_frm_id="x"), "keyframes.0.src_frm_id: found 'x'"),
        (lambda c: c["keyframes"]["0"].update(src_frm_id=13), "frame 13 is in it twice"),
        (lambda c: c["keyframes"]["0"].update(cam="left"), "cameras.left: missing"),
        (
            lambda c: c["cameras"]["camera 0"].update(model_type="Equirectangular"),
            "model_type: found 'Equirectangular'",
        ),
        (lambda c: c["cameras"]["camera 0"].update(fx="wide"), "cameras.camera 0.fx: found ['wide']"),
        (lambda c: c["cameras"]["camera 0"].update(model_type="Perspective", p1=0, p2=0, k3="x"), "k3: found ['x']"),
    ],
)
def test_a_stella_field_that_cannot_be_read_is_refused_with_file_and_field(tmp_path, change, says):
    refusal(stella(tmp_path / "m.msg", change), "m.msg", says)


def test_a_file_that_is_no_stella_map_is_refused(tmp_path):
    path = tmp_path / "m.msg"
    write_stella(scene(), path)
    whole = path.read_bytes()
    for broken in (whole[:-9], whole + b"x", b"", b"\xc1"):
        path.write_bytes(broken)
        refusal(path, "m.msg: not msgpack, or copied incompletely")
    path.write_bytes(msgpack.packb([1, 2]))
    refusal(path, "m.msg: found list")
    write_camera(PINHOLE, tmp_path / "camera.json")
    refusal(tmp_path / "camera.json", "camera.json: keyframes missing; expected a stella_vslam map")


def test_inverse_poses_in_a_stella_map_are_refused_and_named(tmp_path):
    inverse = tuple(replace(k, cam_from_map=np.linalg.inv(k.cam_from_map)) for k in scene().keyframes)
    write_stella(replace(scene(), keyframes=inverse), tmp_path / "m.msg")
    refusal(tmp_path / "m.msg", "with the inverse poses")


def test_a_lens_that_stella_does_not_have_is_not_written(tmp_path):
    camera = Scaramuzza(640, 480, 322.25, 238.5, 400.0, 0.0, -8e-4, 6e-7, -1e-9, 0.9999, 0.003, -0.003)
    with refused(where="SCARAMUZZA camera", found="stella_vslam has no such lens"):
        write_stella(scene(camera), tmp_path / "m.msg")
