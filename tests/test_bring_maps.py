"""Maps as programs leave them, and the frames they meet: by name, number, time and folder, through the command line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import msgpack
import numpy as np
import pytest
import trimesh
from test_cli import SMALL, lightdepth
from test_sfm import PINHOLE, aligned, film, pose
from videos import uneven_times, write_video

from lightdepth.datasets import write_folder
from lightdepth.files.tum import write_tum
from lightdepth.maps import read_map, write_stella, write_text_model
from lightdepth.sparse_map import Submap
from lightdepth.which_frame import WhichFrame

UNIX = 1795849646.97013
COUNT = 8


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("brought") / "seq"
    argv = ["--frames", COUNT, "--size", "[96, 80]", "--travel-mm", 10, "--lens", "pinhole"]
    assert lightdepth("synth", "-o", folder, *argv, "--slam.keyframe-every", 1, "--slam.maps", 1, *SMALL) == 0
    shutil.move(folder / "truth", folder.parent / "truth")  # its times would stand in for a rate
    return folder


@pytest.fixture(scope="module")
def submap(data) -> Submap:
    return read_map(data / "slam").submaps[0]


def met(data: Path, map: Path, *options: object) -> dict[str, tuple[str, ...]]:
    """What `select` makes of each frame by a map: which are keyframes, and how many others these share points with."""
    out = map.parent / f"of_{map.name}.txt"
    assert lightdepth("select", data, "--map", map, "--no-frames", "--overwrite", "-o", out, *options) == 0
    names, *rows = [line.split(",") for line in out.with_suffix(".csv").read_text().splitlines()]
    wanted = [names.index(name) for name in ("kept", "view", "matches")]
    return {row[0]: tuple(row[i] for i in wanted) for row in rows}


@pytest.fixture(scope="module")
def plain(data, submap, tmp_path_factory) -> dict[str, tuple[str, ...]]:
    folder = tmp_path_factory.mktemp("plain") / "model"
    write_text_model(submap, folder)
    return met(data, folder)


def trajectory(submap: Submap, path: Path, time: Callable[[int], float]) -> None:
    write_tum(
        path, [time(k.number) for k in submap.keyframes], [np.linalg.inv(k.cam_from_map) for k in submap.keyframes]
    )


def as_installed(submap: Submap, folder: Path, clock: float = 0.0, fps: float = 30.0, name: str = "map.msg") -> Path:
    """The output folder of stella_vslam 0.6: no src_frm_id, times of its clock, fps in the camera's own section."""
    write_stella(submap, folder / name)
    content = msgpack.unpackb((folder / name).read_bytes())
    for camera in content["cameras"].values():
        camera["fps"] = fps
    for entry in content["keyframes"].values():
        entry["ts"] = clock + entry.pop("src_frm_id") / fps
    (folder / name).write_bytes(msgpack.packb(content))
    for kind in ("frame", "keyframe"):
        trajectory(submap, folder / f"{kind}_trajectory.txt", lambda n: clock + n / fps)
    return folder


# ---- stella_vslam as it is installed today


@pytest.mark.parametrize("clock", [0.0, UNIX])
def test_its_output_folder_is_read_as_it_is_and_another_clock_is_said(data, submap, plain, tmp_path, clock, recwarn):
    as_installed(submap, tmp_path / "out", clock)
    assert met(data, tmp_path / "out") == plain
    said = [str(w.message) for w in recwarn]
    assert any("times are of another clock" in s and "--time-offset" in s for s in said) == bool(clock)


def test_a_clock_that_began_before_the_first_keyframe_is_told_by_the_trajectory_or_by_the_user(data, submap, tmp_path):
    late = Submap(0, submap.keyframes[2:], submap.point_ids, submap.points)
    write_text_model(late, tmp_path / "model")
    right = met(data, tmp_path / "model")
    as_installed(late, tmp_path / "out", UNIX)
    assert met(data, tmp_path / "out", "--time-offset", UNIX) == right
    trajectory(submap, tmp_path / "out" / "frame_trajectory.txt", lambda n: UNIX + n / 30)
    with pytest.warns(UserWarning, match="first stamp of frame_trajectory.txt"):
        assert met(data, tmp_path / "out") == right
    (tmp_path / "out" / "frame_trajectory.txt").unlink()
    (tmp_path / "out" / "densify_map.json").write_text(json.dumps({"time_offset": UNIX}))
    assert met(data, tmp_path / "out") == right


def test_where_nothing_tells_when_a_clock_began_the_images_do(data, submap, tmp_path):
    late = Submap(0, submap.keyframes[2:], submap.point_ids, submap.points)
    as_installed(late, tmp_path / "out", UNIX)
    for file in tmp_path.glob("out/*.txt"):
        file.unlink()
    argv = ["--map", tmp_path / "out", "--checkpoint", "decline", "--judge.on=false", "--no-fit-light"]
    with pytest.warns(UserWarning, match="the images show that tracking began 2 frames after"):
        assert lightdepth("densify", data, *argv, "-o", tmp_path / "run") == 0
    rows = (tmp_path / "run" / "map_000" / "keyframes.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[1]) for row in rows] == list(range(2, COUNT))


@pytest.mark.parametrize("name", ["good", "unix_clock", "drifting"])
def test_maps_of_the_real_program_meet_the_frames_that_they_were_made_of(realdata, name, tmp_path):
    for part in ("frames", "camera.json", "mask.png"):
        (tmp_path / part).symlink_to(realdata / "stella" / part)
    (tmp_path / "out").symlink_to(realdata / "stella" / name)
    expected = json.loads((realdata / "stella" / "maps.json").read_text())[name]["keyframe_frames"]
    found = met(tmp_path, tmp_path / "out")
    assert sorted(int(n) for n, row in found.items() if row[1] == "1") == sorted(expected)


@pytest.mark.parametrize("places", [("a.msg", "b.msg"), ("0/map.msg", "1/map.msg")])
def test_several_of_its_maps_are_submaps_on_one_clock(data, submap, tmp_path, places):
    parts = [Submap(i, submap.keyframes[4 * i : 4 * i + 4], submap.point_ids, submap.points) for i in (0, 1)]
    for i, part in enumerate(parts):
        write_text_model(part, tmp_path / "models" / str(i))
        at = tmp_path / "out" / places[i]
        as_installed(part, at.parent, UNIX, name=at.name)
    assert met(data, tmp_path / "out") == met(data, tmp_path / "models")


# ---- names and times


@pytest.mark.parametrize("form", ["{:05.2f}s", "{:.4f}"])
def test_frames_named_by_their_times_meet_a_map_of_their_names_and_one_of_times(data, submap, plain, tmp_path, form):
    times = {f"{n:06d}": f"frame_{form.format(n / 30)}" for n in range(COUNT)}
    timed = tmp_path / "timed"
    shutil.copytree(data, timed)
    for image in sorted((timed / "frames").iterdir()):
        image.rename(image.with_name(times[image.stem] + image.suffix))
    right = {times[name]: row for name, row in plain.items()}
    write_text_model(submap, tmp_path / "model")
    text = (tmp_path / "model" / "images.txt").read_text()
    for name, timed_name in times.items():
        text = text.replace(f"{name}.png", f"{timed_name}.png")
    (tmp_path / "model" / "images.txt").write_text(text)
    assert met(timed, tmp_path / "model", "--map-rules.between", 1) == {n: r for n, r in right.items()}
    as_installed(submap, tmp_path / "out")
    for older in (False, True):  # neither its own fps nor src_frm_id counts anything in such names
        if older:
            content = msgpack.unpackb((tmp_path / "out" / "map.msg").read_bytes())
            for number, entry in enumerate(content["keyframes"].values()):
                entry["src_frm_id"] = number
            (tmp_path / "out" / "map.msg").write_bytes(msgpack.packb(content))
        of_map = met(timed, tmp_path / "out", "--map-rules.between", 1)
        assert {n: r[1] for n, r in of_map.items()} == {n: r[1] for n, r in right.items()}
    (tmp_path / "out" / "map.msg").unlink()
    shutil.copy(tmp_path / "model" / "points3D.txt", tmp_path / "out")
    found = met(timed, tmp_path / "out", "--map-rules.between", 1)
    assert {n: r[1] for n, r in found.items()} == {n: r[1] for n, r in right.items()}


@pytest.mark.parametrize("how", ["--map-fps", "times.csv", "densify_map.json"])
def test_a_trajectory_in_unix_seconds_meets_frames_that_count_from_0(data, submap, plain, tmp_path, how, capsys):
    frames = tmp_path / "frames"
    shutil.copytree(data, frames)
    out = tmp_path / "orb"
    out.mkdir()
    trajectory(submap, out / "KeyFrameTrajectory.txt", lambda n: UNIX + n / 25)
    write_text_model(submap, tmp_path / "model")
    shutil.copy(tmp_path / "model" / "points3D.txt", out)
    options: list[object] = []
    if how == "times.csv":
        rows = [f"{n:06d},{n / 25:.6f}" for n in range(COUNT)]
        (frames / "times.csv").write_text("\n".join(["name,seconds", *rows]) + "\n")
    elif how == "densify_map.json":
        (out / "densify_map.json").write_text('{"fps": 25}')
    else:
        assert lightdepth("select", frames, "--map", out, "-o", tmp_path / "no.txt") == 3
        assert "--map-fps" in capsys.readouterr().err
        options = ["--map-fps", 25]
    found = met(frames, out, *options)
    assert {n: r[1] for n, r in found.items()} == {n: r[1] for n, r in plain.items()}


def test_a_video_of_uneven_rate_meets_a_trajectory_by_its_own_times(data, submap, plain, tmp_path):
    times = uneven_times(COUNT)
    images = [cv2.imread(str(image))[..., ::-1] for image in sorted((data / "frames").iterdir())]
    (tmp_path / "film").mkdir()
    video = write_video(tmp_path / "film" / "film.mkv", images, times)
    shutil.copy(data / "camera.json", tmp_path / "film")
    out = tmp_path / "orb"
    out.mkdir()
    trajectory(submap, out / "KeyFrameTrajectory.txt", lambda n: UNIX + times[n])
    write_text_model(submap, tmp_path / "model")
    shutil.copy(tmp_path / "model" / "points3D.txt", out)
    found = met(video, out)
    assert {n: r[1] for n, r in found.items()} == {n: r[1] for n, r in plain.items()}


def test_a_trajectory_beside_its_map_is_judged_on_any_clock(data, submap, tmp_path):
    shutil.copytree(data, tmp_path / "true")
    shutil.copytree(data.parent / "truth", tmp_path / "true" / "truth")
    found = []
    for name, clock in (("video", 0.0), ("unix", UNIX)):
        as_installed(submap, tmp_path / name, clock)
        for judged in (tmp_path / name, tmp_path / name / "frame_trajectory.txt"):
            out = tmp_path / f"{name}_{judged.stem}_judged"
            assert lightdepth("evaluate", judged, "--truth", tmp_path / "true", "-o", out) == 0
            (row,) = json.loads((out / "metrics.json").read_text())["maps"]
            found.append((row["poses"], row["rms_ate_mm"]))
    assert found[0][0] == COUNT and all(row == pytest.approx(found[0], rel=1e-3) for row in found), found


def test_known_poses_by_time_are_those_of_the_frames_at_these_times(data, submap, tmp_path):
    trajectory(submap, tmp_path / "poses.txt", lambda n: n / 30)
    argv = ["--poses", tmp_path / "poses.txt", "--map-fps", 30, "-o", tmp_path / "mapped"]
    assert lightdepth("sparse", data, *argv) == 0
    (found,) = read_map(tmp_path / "mapped" / "sparse").submaps
    by_number = {k.number: k for k in submap.keyframes}
    assert all(np.allclose(k.center, by_number[k.number].center, atol=1e-5) for k in found.keyframes)


def test_a_map_that_counts_from_1_is_told_what_helps_and_it_helps(data, submap, plain, tmp_path, capsys):
    later = tuple(replace(k, name=f"{k.number + 1:06d}.png") for k in submap.keyframes)
    write_text_model(replace(submap, keyframes=later), tmp_path / "model")
    argv = ["densify", data, "--map", tmp_path / "model", "--checkpoint", "decline", "-o", tmp_path / "run"]
    assert lightdepth(*argv) == 3
    assert "every keyframe is 1 frame earlier; add -1 to --frame-offset" in capsys.readouterr().err
    assert met(data, tmp_path / "model", "--frame-offset", -1) == plain


@pytest.mark.parametrize(
    ("name", "number", "time"),
    [
        ("frame_00.03s.png", 30_000, 0.03),
        ("left/1403636579.763555.png", 1403636579763555, 1403636579.763555),
        ("1403636579763555584.png", 1403636579763555584, 1403636579.7635556),
        ("t0.04.jpg", 40_000, 0.04),
        ("0012_color.png", 12, None),
        ("shot01.0001.png", 1, None),
        ("shot_01.0001.png", 1, None),
        ("shot_01.1000.png", 1000, None),
        ("frame_0.0333.png", 33_300, 0.0333),
        ("frame_12.0333.png", 12_033_300, 12.0333),
        ("frame-00.0667.png", 66_700, 0.0667),
        ("left/img_0.00000.png", 0, 0.0),
        ("0.0333.png", 33_300, 0.0333),
        ("out12", 12, None),
    ],
)
def test_a_name_tells_number_time_and_folder(name, number, time):
    found = WhichFrame.named(name)
    assert found.number == number and found.folder == name.rpartition("/")[0]
    assert found.time == (None if time is None else pytest.approx(time, abs=1e-6))


# ---- rigs, folders


def rig(submap: Submap, folder: Path, one_folder: bool) -> None:
    """A second camera, half a unit to the right, in the same model; its images are of the same numbers."""
    write_text_model(submap, folder)
    camera = (folder / "cameras.txt").read_text().splitlines()[-1]
    (folder / "cameras.txt").write_text(f"{camera}\n2 {camera.split(None, 1)[1]}\n")
    lines = (folder / "images.txt").read_text().splitlines()[2:]
    left, right = [], []
    for head, seen in zip(lines[::2], lines[1::2], strict=True):
        *numbers, name = head.split()
        left += [" ".join([*numbers, name if one_folder else f"rig/left/{name}"]), seen]
        numbers[0], numbers[5], numbers[8] = str(100 + int(numbers[0])), str(float(numbers[5]) - 0.5), "2"
        right += [" ".join([*numbers, f"right_{name}" if one_folder else f"rig/right/{name}"]), ""]
    (folder / "images.txt").write_text("\n".join(left + right) + "\n")


def test_of_a_rig_in_one_model_a_folder_is_chosen_and_all_are_named(data, submap, plain, tmp_path, capsys):
    rig(submap, tmp_path / "rig", one_folder=False)
    assert lightdepth("select", data, "--map", tmp_path / "rig", "-o", tmp_path / "no.txt") == 3
    said = capsys.readouterr().err
    assert "--map-folder" in said and "rig/left (8 images)" in said and "rig/right (8 images)" in said
    assert met(data, tmp_path / "rig", "--map-folder", "left") == plain
    assert met(data, tmp_path / "rig", "--map-sensor", 1) == plain
    assert lightdepth("select", data, "--map", tmp_path / "rig", "--map-folder", "top", "-o", tmp_path / "n.txt") == 3
    assert "rig/left (8 images)" in capsys.readouterr().err
    shutil.copytree(data, tmp_path / "left")
    assert met(tmp_path / "left", tmp_path / "rig") == plain


def test_of_a_rig_in_one_folder_a_sensor_is_chosen(data, submap, plain, tmp_path, capsys):
    rig(submap, tmp_path / "rig", one_folder=True)
    assert lightdepth("select", data, "--map", tmp_path / "rig", "-o", tmp_path / "no.txt") == 3
    assert "--map-sensor, one of 1 (8 images), 2 (8 images)" in capsys.readouterr().err
    assert met(data, tmp_path / "rig", "--map-sensor", 1) == plain


# ---- far maps


def test_a_far_map_gives_the_same_mesh_and_keeps_what_was_taken_off(data, submap, tmp_path):
    far = np.array([4.6e5, 5.4e6, 160.0])
    write_text_model(submap, tmp_path / "near")
    write_text_model(Submap(0, *_shifted(submap, far)), tmp_path / "far")
    for name in ("near", "far"):
        argv = ["--map", tmp_path / name, "--checkpoint", "decline", "--judge.on=false", "--no-fit-light"]
        assert lightdepth("densify", data, *argv, "-o", tmp_path / f"of_{name}") == 0
    near, there = (trimesh.load(tmp_path / f"of_{n}" / "map_000" / "mesh.ply", process=False) for n in ("near", "far"))
    assert not (tmp_path / "of_near" / "map_000" / "origin.json").exists()
    added = json.loads((tmp_path / "of_far" / "map_000" / "origin.json").read_text())["add_to_all_coordinates"]
    record = json.loads((tmp_path / "of_far" / "run.json").read_text())["maps"][0]
    assert record["origin"] == added
    apart = near.kdtree.query(np.asarray(there.vertices) - (far - added))[0]
    # The grid of voxels begins elsewhere, so vertices are not the same; the surface is.
    assert np.median(apart) < record["voxel"] and np.abs(near.area / there.area - 1) < 0.005


def test_a_far_map_that_is_repaired_stays_where_it_lies(tmp_path):
    frames = film(PINHOLE, 6)
    write_folder([replace(f, name=f"{f.number:06d}") for f in frames], tmp_path / "film")
    assert lightdepth("sparse", tmp_path / "film", "-o", tmp_path / "mapped") == 0
    (found,) = read_map(tmp_path / "mapped" / "sparse").submaps
    far = np.array([4.6e5, 5.4e6, 160.0])
    write_text_model(Submap(0, *_shifted(found, far)), tmp_path / "far")
    argv = ["--repair", tmp_path / "far", "-o", tmp_path / "repaired"]
    assert lightdepth("sparse", tmp_path / "film", *argv) == 0
    (again,) = read_map(tmp_path / "repaired" / "sparse").submaps
    assert np.allclose(again.origin, far, atol=100)
    centers = [np.stack([k.center for k in s.keyframes]) + s.origin for s in (found, again)]
    assert np.allclose(centers[0] + far, centers[1], atol=0.5)


def _shifted(submap: Submap, by: np.ndarray) -> tuple:
    keyframes = []
    for keyframe in submap.keyframes:
        pose = keyframe.cam_from_map.copy()
        pose[:3, 3] -= pose[:3, :3] @ by
        keyframes.append(replace(keyframe, cam_from_map=pose))
    return tuple(keyframes), submap.point_ids, submap.points + by


# ---- CLiMB 2026


def climb(submap: Submap, folder: Path, first: int = 1) -> Path:
    """What is submitted: <sequence>/<run>/ with points alone, and every localised frame in nine columns."""
    maps, poses = folder / "seq" / "1" / "3D_maps" / "1", folder / "seq" / "1" / "camera_trajectory"
    write_text_model(submap, folder / "model")
    maps.mkdir(parents=True)
    shutil.copy(folder / "model" / "points3D.txt", maps)
    poses.mkdir()
    lines = ["# timestamp, name_image, tx, ty, tz, qw, qx, qy, qz"]
    trajectory(submap, folder / "tum.txt", lambda n: n / 30)
    for keyframe, row in zip(submap.keyframes, (folder / "tum.txt").read_text().splitlines(), strict=True):
        t, x, y, z, qx, qy, qz, qw = row.split()
        lines.append(",".join([t, f"{keyframe.number + first:06d}.png", x, y, z, qw, qx, qy, qz]))
    (poses / "cam_traj_map_001.txt").write_text("\n".join(lines) + "\n")
    (folder / "seq" / "1" / "runtime.txt").write_text("init_seconds=1\nprocessing_seconds=2\n")
    return folder / "seq"


def test_a_climb_submission_is_read_as_it_is_by_the_frames_camera(data, submap, tmp_path):
    tree = climb(submap, tmp_path / "submitted")
    with pytest.warns(UserWarning, match="counts frames from 1"):
        found = met(data, tree)
    keyframes = [name for name, row in found.items() if row[1] == "1"]
    assert keyframes[0] == "000000" and 2 <= len(keyframes) <= COUNT
    argv = ["--map", tree / "1", "--checkpoint", "decline", "--judge.on=false", "--no-fit-light", "--trust-map"]
    assert lightdepth("densify", data, *argv, "-o", tmp_path / "run") in (0, 4)
    localised = json.loads((tmp_path / "run" / "run.json").read_text())["localised"]["1"]
    assert localised["localised"] == localised["frames"] == COUNT and localised["keyframes"] == len(keyframes)


def test_a_climb_submission_that_counts_as_the_frames_do_is_left_as_it_is(data, submap, tmp_path, recwarn):
    found = met(data, climb(submap, tmp_path / "submitted", first=0))
    assert found["000000"][1] == "1" and not any("counts frames from 1" in str(w.message) for w in recwarn)


# ---- sparse, by another mapper


@pytest.mark.parametrize("how", ["chosen", "second"])
def test_the_global_mapper_is_a_choice_and_takes_what_the_incremental_one_left(tmp_path, how):
    frames = film(PINHOLE, 6)
    write_folder([replace(f, name=f"{f.number:06d}") for f in frames], tmp_path / "film")
    # No two images have so many matches: the incremental mapper finds no beginning.
    argv = ["--sfm.mapper", "global"] if how == "chosen" else ["--sfm.init_min_num_inliers", 100_000]
    assert lightdepth("sparse", tmp_path / "film", *argv, "-o", tmp_path / "mapped") == 0
    (found,) = read_map(tmp_path / "mapped" / "sparse").submaps
    true = np.stack([pose(k.number - 10)[:3, 3] for k in found.keyframes])
    scale, rotation, shift = aligned(np.stack([k.center for k in found.keyframes]), true)
    away = [np.linalg.norm(scale * rotation @ k.center + shift - t) for k, t in zip(found.keyframes, true, strict=True)]
    assert len(found.keyframes) == 6 and max(away) < 0.2
    if how == "second":
        argv += ["--sfm.mapper", "incremental"]
        assert lightdepth("sparse", tmp_path / "film", *argv, "-o", tmp_path / "none") == 3
