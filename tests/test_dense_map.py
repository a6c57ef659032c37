"""A dense map's files: what is written can be read by others and by us."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from colons import colon, sequence, slam, truth
from raising import refused
from view_runs import write_run

from densify.alignment import Alignment
from densify.config import DensifyConfig
from densify.dense_map import (
    GREEN,
    GREY,
    RED,
    DenseMap,
    Surface,
    map_folders,
    read_dense_map,
    surface_folders,
    write_cloud,
)
from densify.judging.config import JudgeConfig
from densify.pipeline import densify
from densify.viewing.watched import WatchedRun
from lightdepth import native
from lightdepth.calibration import read_camera
from lightdepth.files.tum import read_tum


@pytest.fixture(scope="module")
def dense() -> DenseMap:
    frames = colon(0).frames[:4]
    return densify(sequence(frames), slam(frames, spurious=0.2).map, truth, DensifyConfig(judge=JudgeConfig(on=False)))[
        0
    ].dense


@pytest.fixture(scope="module")
def folder(dense, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run") / "map_000"
    dense.write(path, ("ply", "glb", "obj"))
    return path


def colors(path: Path) -> np.ndarray:
    return np.asarray(trimesh.load(path, process=False).colors)[:, :3]


def test_the_mesh_is_read_back_in_every_format(dense, folder):
    for suffix in ("ply", "glb", "obj"):
        mesh = trimesh.load(folder / f"mesh.{suffix}", process=False, force="mesh")
        assert len(mesh.faces) == len(dense.triangles) > 1000
        np.testing.assert_allclose(np.sort(mesh.bounds, 0), np.sort([dense.vertices.min(0), dense.vertices.max(0)], 0))
        assert np.ptp(np.asarray(mesh.visual.vertex_colors)[:, :3], 0).max() > 20


def test_the_ply_keeps_vertices_triangles_and_colours(dense, folder):
    mesh = trimesh.load(folder / "mesh.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, dense.vertices, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, dense.triangles)
    np.testing.assert_array_equal(np.asarray(mesh.visual.vertex_colors)[:, :3], np.rint(dense.colors * 255))


def test_only_the_formats_asked_for_are_written(dense, tmp_path):
    dense.write(tmp_path / "map_000")
    written = {"mesh.ply", "cloud.ply", "sparse.ply", "keyframes.csv", "trajectory.tum", "camera.json"}
    assert {p.name for p in (tmp_path / "map_000").iterdir()} == written


def test_the_cloud_is_the_mesh_s_vertices_with_unit_normals(dense, folder):
    data = (folder / "cloud.ply").read_bytes()
    header, body = data.split(b"end_header\n", 1)
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    np.testing.assert_allclose(rows["xyz"], dense.vertices, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(rows["rgb"], np.rint(dense.colors * 255))
    length = np.linalg.norm(rows["normal"], axis=1)
    assert np.median(length) == pytest.approx(1, abs=1e-4)
    assert len(trimesh.load(folder / "cloud.ply").vertices) == len(dense.vertices)


def test_sparse_points_are_green_in_red_out_and_grey_where_nobody_judged(dense, tmp_path):
    ids = dense.submap.point_ids
    first = Alignment("0", 1.0, 0.1, 10, inlier_ids=ids[:10], outlier_ids=ids[10:20])
    second = replace(first, inlier_ids=ids[10:12], outlier_ids=ids[12:20])
    third = replace(second, reason="not trusted", inlier_ids=ids[30:40])
    judged = replace(dense, alignments=(first, second, third, third))
    judged.write(tmp_path / "map_000")
    found = colors(tmp_path / "map_000" / "sparse.ply")
    assert (found[:10] == GREEN).all()
    assert (found[10:20] == RED).all()  # in the minority, or as often in as out
    assert (found[20:] == GREY).all()
    read = read_dense_map(tmp_path / "map_000")
    assert read.sparse_inlier.tolist() == [True] * 10 + [False] * (len(ids) - 10)


def test_wrong_points_are_red(dense, folder):
    wrong = np.isin(dense.submap.point_ids, slam(colon(0).frames[:4], spurious=0.2).spurious_ids[0])
    red = (colors(folder / "sparse.ply") == RED).all(1)
    assert red[wrong].mean() > 0.8 and red[~wrong].mean() < 0.1


def test_every_keyframe_has_a_row_with_its_scale_or_its_reason(dense, tmp_path):
    failed = Alignment("000002.png", points=3, reason="=3 observed points, with a comma")
    alignments = (*dense.alignments[:2], failed, dense.alignments[3])
    given = {name: c for name, c in dense.contributions.items() if name != failed.keyframe}
    replace(dense, alignments=alignments, contributions=given).write(tmp_path / "map_000")
    with (tmp_path / "map_000" / "keyframes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["keyframe"] for r in rows] == [f"{i:06d}.png" for i in range(4)]
    assert [int(r["frame"]) for r in rows] == [0, 1, 2, 3] and [r["ok"] for r in rows] == ["1", "1", "0", "1"]
    assert float(rows[0]["scale"]) == pytest.approx(dense.alignments[0].scale, rel=1e-8)
    assert int(rows[0]["inliers"]) == len(dense.alignments[0].inlier_ids)
    assert rows[2]["reason"] == "'=3 observed points, with a comma" and rows[0]["reason"] == ""
    assert rows[2]["fused_share"] == rows[2]["views"] == ""


def test_the_trajectory_has_frame_numbers_for_times_and_the_camera_is_the_map_s(dense, folder):
    numbers, poses = read_tum(folder / "trajectory.tum")
    assert numbers.tolist() == [0, 1, 2, 3]
    for pose, keyframe in zip(poses, dense.submap.keyframes, strict=True):
        np.testing.assert_allclose(pose @ keyframe.cam_from_map, np.eye(4), atol=1e-6)
    assert read_camera(folder / "camera.json") == dense.submap.keyframes[0].camera


def test_lengths_are_in_millimetres_where_their_unit_is_known(dense, tmp_path):
    dense.write(tmp_path / "map_000", mm_per_unit=5.0)
    read = read_dense_map(tmp_path / "map_000")
    np.testing.assert_allclose(read.vertices, 5 * dense.vertices, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(read.sparse, 5 * dense.submap.points, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(read.map_from_cam[1, :3, 3], 5 * dense.submap.keyframes[1].center, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(read.map_from_cam[:, :3, :3]), 1)
    cloud = trimesh.load(tmp_path / "map_000" / "cloud.ply")
    np.testing.assert_allclose(cloud.vertices, read.vertices, rtol=1e-5)
    with (tmp_path / "map_000" / "keyframes.csv").open(newline="") as file:
        row = next(csv.DictReader(file))
    assert float(row["scale"]) == pytest.approx(5 * dense.alignments[0].scale)
    assert float(row["sigma"]) == pytest.approx(5 * dense.alignments[0].sigma, rel=1e-4)


def test_confidence_and_views_of_every_vertex_are_in_the_ply_for_us_and_for_others(dense, folder):
    read = read_dense_map(folder)
    np.testing.assert_allclose(read.confidence, dense.confidence, atol=1e-6)
    np.testing.assert_array_equal(read.views, dense.views)
    assert read.views.min() >= 1 and read.views.max() == 4 and 0 < read.confidence.min() < read.confidence.max() < 1
    header = (folder / "mesh.ply").read_bytes().split(b"end_header")[0]
    assert b"property float confidence\n" in header and b"property int views\n" in header
    mesh = native.open3d().t.io.read_triangle_mesh(str(folder / "mesh.ply"))
    np.testing.assert_allclose(mesh.vertex.positions.numpy(), dense.vertices, rtol=1e-5, atol=1e-6)
    assert len(mesh.triangle.indices) == len(dense.triangles)


def test_a_surface_of_an_older_run_has_no_confidence(dense, tmp_path):
    replace(dense, weights=None, views=None).write(tmp_path / "map_000")
    read = read_dense_map(tmp_path / "map_000")
    assert read.confidence is None and read.views is None and len(read.vertices) == len(dense.vertices)


def test_the_table_says_what_each_keyframe_gave_and_what_it_looks_at(dense, folder):
    with (folder / "keyframes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, keyframe in zip(rows, dense.submap.keyframes, strict=True):
        expected = dense.contributions[keyframe.name]
        for name in ("fused_share", "fused_weight", "confidence", "views"):
            assert float(row[name]) == pytest.approx(getattr(expected, name), abs=1e-4)
        assert 0.8 < expected.fused_share <= 1 and 0.3 < expected.fused_weight < 1 and 1 <= expected.views <= 4


def test_what_was_written_is_read(dense, folder):
    read = read_dense_map(folder)
    assert read.id == 0 and read.numbers.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(read.triangles, dense.triangles)
    np.testing.assert_allclose(read.sparse, dense.submap.points, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(read.sparse_inlier, dense.judged_points()[1])


def test_an_empty_surface_is_written_and_read(dense, tmp_path):
    empty = np.zeros((0, 3))
    nothing = replace(
        dense, vertices=empty, triangles=empty.astype(int), colors=empty, weights=empty[:, 0], views=empty[:, 0]
    )
    nothing.write(tmp_path / "map_003")
    read = read_dense_map(tmp_path / "map_003")
    assert read.id == 3 and read.vertices.shape == (0, 3) and read.triangles.shape == (0, 3) and len(read.sparse)
    assert np.isinf(Surface(read.vertices, read.triangles).cast(np.zeros(3), np.eye(3))).all()


@pytest.mark.parametrize("name", ["mesh.ply", "sparse.ply", "trajectory.tum", "camera.json"])
def test_a_missing_file_is_named(dense, tmp_path, name):
    dense.write(tmp_path / "map_000")
    (tmp_path / "map_000" / name).unlink()
    with refused(where="map_000", found=f"{name} missing"):
        read_dense_map(tmp_path / "map_000")


@pytest.mark.parametrize("name", ["mesh.ply", "sparse.ply"])
def test_a_damaged_file_is_named(dense, tmp_path, name):
    dense.write(tmp_path / "map_000")
    file = tmp_path / "map_000" / name
    file.write_bytes(file.read_bytes()[:500])
    with refused(where=name, found="damaged"):
        read_dense_map(tmp_path / "map_000")


def test_a_folder_without_a_map_s_number_is_refused(dense, tmp_path):
    dense.write(tmp_path / "map_old")
    with refused(where="map_old", cure="expected a name such as map_000"):
        read_dense_map(tmp_path / "map_old")


def test_rays_meet_the_surface_where_it_is():
    mesh = trimesh.creation.icosphere(4, 5.0)
    directions = np.array([[1.0, 0, 0], [0, 0.6, 0.8]])
    surface = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    np.testing.assert_allclose(surface.cast(np.zeros(3), directions), 5.0, rtol=5e-3)
    away = surface.cast(np.array([[10.0, 0, 0], [0, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, 1]]))
    assert np.isinf(away[0]) and away[1] == pytest.approx(5, rel=5e-3)
    assert len(surface.cast(np.zeros(3), np.zeros((0, 3)))) == 0


def test_a_cloud_without_normals_has_points_and_colours_only(tmp_path):
    points = np.arange(6.0).reshape(2, 3)
    write_cloud(tmp_path / "c.ply", points, np.array([[1, 2, 3], [250, 0, 9]]))
    read = trimesh.load(tmp_path / "c.ply")
    np.testing.assert_array_equal(read.vertices, points)
    np.testing.assert_array_equal(np.asarray(read.colors)[:, :3], [[1, 2, 3], [250, 0, 9]])
    assert b"nx" not in (tmp_path / "c.ply").read_bytes()


@pytest.mark.parametrize("off", [0.0, 5e6])
def test_a_surface_is_as_exact_far_from_the_origin_as_near(off):
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) + off
    surface = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    above = np.array([[0.25, 0.5, 0.125], [0.75, 0.25, 0.25]]) + off
    assert surface.distance(above) == pytest.approx([0.125, 0.25], abs=1e-6)
    distance, triangle = surface.meet(above, np.array([[0, 0, -1.0]]).repeat(2, 0))
    assert distance == pytest.approx([0.125, 0.25], abs=1e-6) and triangle.tolist() == [1, 0]
    places, _ = surface.closest(above)
    assert places - off == pytest.approx(np.array([[0.25, 0.5, 0], [0.75, 0.25, 0]]), abs=1e-6)


def test_a_folder_without_a_number_is_no_map_of_a_run(tmp_path):
    """Notes that somebody put beside the maps."""
    run = write_run(tmp_path / "run")
    for name in ("map_notes", "joined_old", "map_000.bak", "map_\u0661"):
        (run / name).mkdir()
    assert [f.name for f in surface_folders(run)] == ["map_000"] == [f.name for f in map_folders(run)]
    assert [each.name for each in WatchedRun(run).first()] == ["map_000"]
    shutil.rmtree(run / "map_000")
    with refused(found="no map_* folders"):
        WatchedRun(run)
