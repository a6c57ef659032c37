"""Dense maps as other programs take them, read back by those programs where pip has them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from colons import colon, sequence, slam, truth
from raising import refused
from scipy.spatial import cKDTree

from densify.config import DensifyConfig
from densify.dense_map import read_dense_map
from densify.exporting.colmap import read_array, write_colmap
from densify.exporting.exported import Exportable, read_exportables
from densify.exporting.images import pinhole_of
from densify.exporting.nerfstudio import intrinsics, write_nerfstudio
from densify.fusion.volume import FusionConfig
from densify.judging.config import JudgeConfig
from densify.pipeline import densify
from densify.scale_file import MapScale, Scales
from lightdepth import native
from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.cli import main
from lightdepth.datasets import write_folder
from lightdepth.files.tum import read_tum
from lightdepth.maps import read_map, write_multimap
from lightdepth.maps.colmap import write_text_model
from lightdepth.maps.endocartoscope import read_trajectory
from lightdepth.photometry import PhotometricCalibration
from lightdepth.sparse_map import SparseMap

FISHEYE = KannalaBrandt(96, 80, 52.0, 51.0, 47.0, 41.0, -0.05, 0.01, 0.0, 0.0)
MM = 2.5


def made(folder: Path, camera: CameraModel, mm_per_unit: float | None = None) -> Path:
    """A densify run of one map, made with true depth, beside its frames and its map."""
    frames = colon(0, 8, 9.0, camera).frames
    found = slam(frames, maps=1, spurious=0.1).map
    write_folder(frames, folder / "data")
    write_text_model(found.submaps[0], folder / "map")
    config = DensifyConfig(judge=JudgeConfig(on=False), fusion=FusionConfig(voxels_per_distance=20.0))
    dense = densify(sequence(frames), read_map(folder / "map"), truth, config)[0].dense
    dense.write(folder / "run" / "map_000", mm_per_unit=mm_per_unit)
    arguments = {"data": str(folder / "data"), "map": str(folder / "map"), "mm_per_unit": mm_per_unit}
    record = {"unit": "mm" if mm_per_unit else "map units", "arguments": arguments, "seconds": 12.5}
    (folder / "run" / "run.json").write_text(json.dumps(record))
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return made(tmp_path_factory.mktemp("fisheye"), FISHEYE, MM)


@pytest.fixture(scope="module")
def exported(place) -> Exportable:
    return read_exportables(place / "run")[0]


def export(place: Path, to: str, *options: str) -> Path:
    out = place / f"as-{to}"
    assert main(["export", str(place / "run"), "-o", str(out), "--to", to, "--overwrite", *options]) == 0
    return out


def errors_by_pycolmap(model: Path) -> dict[str, np.ndarray]:
    """Distances [px] of the keypoints of each image from their points' projections, as COLMAP projects."""
    rebuilt = native.pycolmap().Reconstruction(model)
    found = {}
    for image in rebuilt.images.values():
        seen = [(p.xy, rebuilt.points3D[p.point3D_id].xyz) for p in image.points2D if p.has_point3D()]
        found[image.name] = np.array([np.linalg.norm(image.project_point(xyz) - xy) for xy, xyz in seen])
    return found


def test_a_colmap_model_reopens_with_tracks_and_the_same_reprojection(place, exported):
    folder = export(place, "colmap", "--points", "500") / "map_000"
    assert exported.tracked and exported.unit == "mm"
    found = errors_by_pycolmap(folder / "sparse" / "0")
    assert len(found) == 8
    together = np.concatenate([found[f"{k.number:06d}.png"] for k in exported.submap.keyframes])
    wanted = []
    for keyframe in exported.submap.keyframes:
        _, points, pixels = exported.submap.observed_points(keyframe)
        projected = keyframe.camera.project(keyframe.in_camera(points))[0]
        wanted.append(np.linalg.norm(projected - pixels, axis=1))
    assert np.abs(np.sort(together) - np.sort(np.concatenate(wanted))).max() < 1e-6
    rebuilt = native.pycolmap().Reconstruction(folder / "sparse" / "0")
    tracks = np.array([p.track.length() for p in rebuilt.points3D.values()])
    assert (tracks > 0).sum() == len(exported.submap.points) and 250 < (tracks == 0).sum() <= 500
    assert (folder / "images" / "000003.png").is_file()
    again = read_map(folder / "sparse" / "0").submaps[0]
    assert np.array_equal(again.points[: len(exported.submap.points)], exported.submap.points)


def test_colmap_s_own_fusion_of_the_depth_and_normal_maps_is_the_surface(place, exported, tmp_path):
    dense = export(place, "colmap", "--points", "0") / "map_000" / "dense"
    pycolmap = native.pycolmap()
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.num_threads = 3, 1
    fused = pycolmap.stereo_fusion(tmp_path / "fused.ply", dense, options=options, output_type="PLY")
    points = np.array([p.xyz for p in fused.points3D.values()])
    off = exported.surface.distance(points)
    assert len(points) > 1000 and np.quantile(off, 0.9) < 0.02  # mm; half a pixel is 0.1
    kinds = ("depth_maps", "normal_maps")
    depth, normals = (read_array(dense / "stereo" / kind / "000004.png.geometric.bin") for kind in kinds)
    seen = depth > 0
    assert seen.mean() > 0.5 and np.allclose(np.linalg.norm(normals[seen], axis=1), 1, atol=1e-5)
    rays = pinhole_of(exported.submap.keyframes[0].camera).rays()[0]
    assert ((normals * rays).sum(-1)[seen] <= 0).all() and not normals[~seen].any()  # towards the camera


def test_transforms_json_puts_the_map_s_points_where_our_camera_does(place, exported):
    folder = export(place, "nerfstudio") / "map_000"
    found = json.loads((folder / "transforms.json").read_text())
    assert found["camera_model"] == "OPENCV_FISHEYE" and (found["w"], found["h"]) == (96, 80)
    k = np.array([[found["fl_x"], 0, found["cx"] - 0.5], [0, found["fl_y"], found["cy"] - 0.5], [0, 0, 1]])
    bends = np.array([found[f"k{i}"] for i in (1, 2, 3, 4)])
    assert len(found["frames"]) == len(exported.submap.keyframes)
    for frame, keyframe in zip(found["frames"], exported.submap.keyframes, strict=True):
        _, points, _ = exported.submap.observed_points(keyframe)
        ours, seen = keyframe.camera.project(keyframe.in_camera(points))
        opengl = np.linalg.inv(np.array(frame["transform_matrix"]))
        in_camera = (points @ opengl[:3, :3].T + opengl[:3, 3]) * (1, -1, -1)
        theirs = cv2.fisheye.projectPoints(in_camera[None], np.zeros(3), np.zeros(3), k, bends)[0][0] + 0.5
        assert np.abs(theirs - ours)[seen].max() < 1e-6  # the bar is 0.1 px
        image = cv2.imread(str(folder / frame["file_path"]))
        depth = np.load(folder / frame["depth_file_path"]) * found["depth_unit_scale_factor"]
        assert image.shape[:2] == depth.shape == (80, 96)
        pixel = np.floor(ours[seen]).astype(int).clip(0, (95, 79))
        near = np.abs(depth[pixel[:, 1], pixel[:, 0]] / in_camera[seen][:, 2] - 1)
        assert np.median(near) < 0.05
    cloud = trimesh.load(folder / found["ply_file_path"])
    assert len(cloud.vertices) == len(exported.dense.vertices)


def test_a_ply_has_normals_colour_confidence_and_views_for_those_who_look(place, exported):
    folder = export(place, "ply") / "map_000"
    mesh = trimesh.load(folder / "mesh.ply", process=False)
    raw = mesh.metadata["_ply_raw"]["vertex"]["data"]
    assert np.allclose(raw["confidence"].ravel(), exported.dense.confidence, atol=1e-6)
    assert np.array_equal(raw["quality"], raw["confidence"]) and raw["views"].max() > 1
    assert np.array_equal(mesh.faces, exported.dense.triangles)
    assert np.array_equal(np.asarray(mesh.visual.vertex_colors)[:, :3], exported.colors)
    theirs = native.open3d().io.read_triangle_mesh(str(folder / "mesh.ply"))
    assert theirs.has_vertex_colors() and theirs.has_vertex_normals() and len(theirs.triangles) == len(mesh.faces)
    assert np.allclose(np.asarray(theirs.vertices), exported.dense.vertices, atol=1e-4)
    assert np.allclose(np.asarray(theirs.vertex_normals), exported.normals, atol=1e-4)
    tensor = native.open3d().t.io.read_point_cloud(str(folder / "mesh.ply"))
    assert np.allclose(tensor.point["confidence"].numpy().ravel(), exported.dense.confidence, atol=1e-6)
    painted = trimesh.load(folder / "mesh_confidence.ply", process=False)
    looks = np.asarray(painted.visual.vertex_colors)[:, :3].astype(int)
    order = np.argsort(exported.dense.confidence)
    least, most = looks[order[:50]].mean(0), looks[order[-50:]].mean(0)
    assert most[1] > least[1] + 20  # viridis: the surer, the greener


@pytest.mark.parametrize("to", ["glb", "obj"])
def test_glb_and_obj_are_read_with_colour_by_trimesh_and_open3d(to, place, exported):
    file = export(place, to) / "map_000" / f"mesh.{to}"
    mesh = trimesh.load(file, process=False, force="mesh")
    assert np.allclose(mesh.vertices, exported.dense.vertices, atol=1e-4)
    assert np.array_equal(mesh.faces, exported.dense.triangles)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(int)
    assert np.abs(colors - exported.colors).max() <= 1
    theirs = native.open3d().io.read_triangle_mesh(str(file))
    assert len(theirs.triangles) == len(exported.dense.triangles) and theirs.has_vertex_colors()
    # Open3D's reader has the vertices in an order of its own
    near, row = cKDTree(exported.dense.vertices).query(np.asarray(theirs.vertices))
    off = np.abs(np.asarray(theirs.vertex_colors) * 255 - exported.colors[row]).max(1)
    assert near.max() < 1e-4 and (off < 1.5).mean() > 0.99


def test_a_trajectory_has_seconds_where_the_frames_have_them(place, exported):
    times, poses = read_tum(export(place, "tum") / "map_000" / "trajectory.tum")
    frames = colon(0, 8, 9.0, FISHEYE).frames
    assert np.allclose(times, [f.time for f in frames], atol=1e-6)
    assert np.allclose(np.linalg.inv(poses), [k.cam_from_map for k in exported.submap.keyframes], atol=1e-7)


def test_climb_s_tree_counts_from_one_and_says_how_long_it_took(place, exported):
    folder = export(place, "climb", "--points", "0")
    assert dict(line.split("=") for line in (folder / "runtime.txt").read_text().split()) == {
        "init_seconds": "0.000",
        "processing_seconds": "12.500",
    }
    again = read_map(folder).submaps[0]
    assert [k.number for k in again.keyframes] == list(range(8)), "the sidecar says that ours count from 0"
    assert np.allclose(again.points, exported.submap.points, atol=1e-12)
    assert np.abs(again.reprojection_errors() - exported.submap.reprojection_errors()).max() < 1e-6
    poses = read_trajectory(folder / "camera_trajectory" / "cam_traj_map_000.txt")
    assert poses[0].name == "000001.png" and len(poses) == 8 and poses[1].time > 0


def test_climb_s_tree_has_every_frame_that_the_slam_localised(place, exported, tmp_path):
    tree = tmp_path / "slam"
    submap = read_map(place / "map").submaps[0]
    between = {f"{100 + i:06d}.png": k.cam_from_map for i, k in enumerate(submap.keyframes)}
    write_multimap(SparseMap((submap,), "made"), tree, {0: between}, times={name: 7.5 for name in between})
    out = tmp_path / "out"
    assert main(["export", str(place / "run"), "-o", str(out), "--to", "climb", "--map", str(tree)]) == 0
    poses = read_trajectory(out / "camera_trajectory" / "cam_traj_map_000.txt")
    assert [p.name for p in poses[8:]] == [f"{101 + i:06d}.png" for i in range(8)] and len(poses) == 16
    assert [p.is_keyframe for p in poses] == [True] * 8 + [False] * 8 and poses[8].time == 7.5
    assert np.allclose(poses[8].cam_from_map, exported.submap.keyframes[0].cam_from_map, atol=1e-7)


def under(exported: Exportable, camera: CameraModel) -> Exportable:
    """The same map, taken by another lens."""
    keyframes = tuple(replace(k, camera=camera) for k in exported.submap.keyframes[:2])
    return replace(exported, submap=replace(exported.submap, keyframes=keyframes))


def test_a_lens_that_others_do_not_know_is_fitted_and_said(exported, tmp_path):
    scaramuzza = Scaramuzza(96, 80, 47.0, 41.0, 52.0, 0.0, -0.003, 0.0, 0.0, 1.0, 0.0, 0.0)
    for name, write in (("ns", write_nerfstudio), ("colmap", write_colmap)):
        (tmp_path / name).mkdir()
        (said,) = write(under(exported, scaramuzza), tmp_path / name, None, 10)
        assert "OPENCV_FISHEYE in place of SCARAMUZZA: off by" in said and "px (largest)" in said
    assert json.loads((tmp_path / "ns" / "transforms.json").read_text())["camera_model"] == "OPENCV_FISHEYE"
    model = native.pycolmap().Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    assert {c.model.name for c in model.cameras.values()} == {"OPENCV_FISHEYE"}


def test_other_lenses_go_to_nerfstudio_by_their_own_names(exported, tmp_path):
    brown = Brown(96, 80, 70.0, 70.0, 47.0, 41.0, -0.1, 0.01, 0.001, 0.0)
    assert write_nerfstudio(under(exported, brown), tmp_path, None, 0) == []
    found = json.loads((tmp_path / "transforms.json").read_text())
    assert (found["camera_model"], found["k1"], found["p1"]) == ("OPENCV", -0.1, 0.001)
    assert intrinsics(Pinhole(96, 80, 70.0, 71.0, 47.0, 41.0)) == {
        "camera_model": "OPENCV",
        "w": 96,
        "h": 80,
        "fl_x": 70.0,
        "fl_y": 71.0,
        "cx": 47.0,
        "cy": 41.0,
    }


def test_without_its_map_and_frames_a_run_is_still_exported_and_what_is_missing_is_said(place, tmp_path, capsys):
    run = tmp_path / "run"
    (run / "map_000").mkdir(parents=True)
    for file in (place / "run" / "map_000").iterdir():
        (run / "map_000" / file.name).write_bytes(file.read_bytes())
    (run / "run.json").write_text(json.dumps({"unit": "mm", "arguments": {"data": str(tmp_path / "gone")}}))
    assert main(["export", str(run), "-o", str(tmp_path / "out"), "--to", "colmap"]) == 0
    said = capsys.readouterr().out
    assert "no tracks: give --map MAP" in said and "frames are not found" in said
    assert "map_000/ has dense/, sparse/: 8 keyframes, " in said and "in mm\nnext: colmap " in said
    assert said.endswith(f"written: {tmp_path / 'out'}\n")
    rebuilt = native.pycolmap().Reconstruction(tmp_path / "out" / "map_000" / "sparse" / "0")
    assert len(rebuilt.images) == 8 and all(p.track.length() == 0 for p in rebuilt.points3D.values())
    shutil.copytree(run / "map_000", run / "joined_000")
    assert main(["export", str(run), "-o", str(tmp_path / "joined"), "--to", "colmap"]) == 0
    assert "joined_000: the map's points have no tracks: they are of several maps" in capsys.readouterr().out
    shutil.rmtree(run / "joined_000")
    (run / "data").mkdir()
    (run / "data" / "slam").symlink_to(place / "map")  # a demo's run has them inside
    (run / "run.json").write_text(json.dumps({"unit": "mm", "arguments": {"mm_per_unit": MM}}))
    assert read_exportables(run)[0].tracked
    (run / "run.json").write_text(json.dumps({"unit": "mm", "arguments": {"mm_per_unit": "light"}}))
    assert not read_exportables(run)[0].tracked  # the unit of its map is not said
    Scales((MapScale(0, MM, (2.0, 3.0), "the light"),)).write_file(run, "mm", PhotometricCalibration())
    assert read_exportables(run)[0].tracked
    (run / "run.json").write_text(json.dumps({"unit": "mm"}))
    tracked = ["--map", str(place / "map"), "--data", str(place / "data")]
    assert main(["export", str(run), "-o", str(tmp_path / "out2"), "--to", "colmap", *tracked]) == 3
    assert "not the map that map_000 was made of" in capsys.readouterr().err  # the unit of the run is not said
    submap = read_map(place / "map").submaps[0]
    write_text_model(replace(submap, keyframes=submap.keyframes[1:]), tmp_path / "other")
    out = str(tmp_path / "o")
    assert main(["export", str(place / "run"), "-o", out, "--to", "colmap", "--map", str(tmp_path / "other")]) == 3


@pytest.mark.filterwarnings("always:without its picture")
def test_a_picture_that_cannot_be_read_is_left_out_and_said(place, tmp_path):
    shutil.copytree(place / "data", tmp_path / "data")
    images = sorted((tmp_path / "data" / "frames").iterdir())
    images[0].write_bytes(images[0].read_bytes()[:200])
    given = [str(place / "run"), "--data", str(tmp_path / "data"), "--map", str(place / "map")]
    for to in ("tum", "nerfstudio"):
        assert main(["export", *given, "-o", str(tmp_path / to), "--to", to]) == 0
        with_it = json.loads((tmp_path / to / "run.json").read_text())["warnings"]
        assert any("without its picture" in warning for warning in with_it)
    assert len(list((tmp_path / "nerfstudio" / "map_000" / "images").iterdir())) == 7


@pytest.mark.parametrize("rows", [0, 1, 4])
def test_a_table_of_keyframes_that_lacks_some_is_refused_and_one_that_is_gone_is_done_without(place, tmp_path, rows):
    shutil.copytree(place / "run" / "map_000", tmp_path / "map_000")
    table = tmp_path / "map_000" / "keyframes.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:rows]))
    with refused("no row for frame", where="keyframes.csv", cure="numbers are names"):
        read_exportables(tmp_path / "map_000")
    table.unlink()
    assert len(read_exportables(tmp_path / "map_000")[0].submap.keyframes) == 8


def test_what_cannot_be_exported_is_refused_with_what_could(place, tmp_path, capsys):
    def refusal(*words: str, code: int = 3) -> str:
        assert main(["export", *words, "-o", str(tmp_path / "out")]) == code
        return capsys.readouterr().err

    assert "expected one of colmap" in refusal(str(place / "run"), code=2)
    assert "lightdepth densify" in refusal(str(place / "data"), "--to", "glb")
    assert "lightdepth predict" in refusal(str(place / "run"), "--to", "exr")
    assert "no network" in refusal("decline", "--to", "onnx")
    assert "leave it out" in refusal("lightdepth-self", "--to", "safetensors", "--size", "[64, 64]")
    assert "--points: -1" in refusal(str(place / "run"), "--to", "colmap", "--points", "-1")
    assert not (tmp_path / "out").exists()
    (tmp_path / "x.bin").write_bytes(b"1&2")
    with pytest.raises(ValueError, match="not a map of COLMAP's"):
        read_array(tmp_path / "x.bin")
    assert read_dense_map(place / "run" / "map_000").id == 0


def test_what_was_taken_off_a_far_map_stands_beside_what_is_made_of_it(place, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(place / "run", run)
    (run / "map_000" / "origin.json").write_text('{"add_to_all_coordinates": [460000.0, 5400000.0, 160.0]}\n')
    assert main(["export", str(run), "-o", str(tmp_path / "out"), "--to", "glb"]) == 0
    kept = json.loads((tmp_path / "out" / "map_000" / "origin.json").read_text())
    assert kept == {"add_to_all_coordinates": [460000.0, 5400000.0, 160.0]}
    assert "far from its origin" in (tmp_path / "out" / "log.txt").read_text()


@pytest.mark.parametrize("kind", ["ply", "exr"])
def test_what_is_not_there_is_said_not_to_be(tmp_path, capsys, kind):
    assert main(["export", str(tmp_path / "none"), "-o", str(tmp_path / "out"), "--to", kind]) == 3
    assert "none: does not exist" in capsys.readouterr().err and not (tmp_path / "out").exists()
