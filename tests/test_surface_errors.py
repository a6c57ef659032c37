"""Errors of surfaces against trying every pair, libraries and closed forms; and what must not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from colons import colon, sequence
from raising import refused
from scenes import PINHOLE, sphere
from scipy.spatial.transform import Rotation

from densify.dense_map import Surface
from densify.evaluation.errors import (
    SurfaceErrors,
    TrueSurface,
    closest,
    depth_triangles,
    pooled,
    surface_errors,
    thinned,
    true_cloud,
    true_points,
)
from densify.evaluation.judge import judge_maps
from densify.evaluation.judged_map import JudgedMap
from densify.evaluation.trajectory import in_order
from densify.evaluation.truth import Truth, read_truth
from densify.similarity import Similarity
from lightdepth.files.meshes import read_mesh

THRESHOLDS = (0.5, 1.0, 2.0)


def clouds(seed: int, n: int = 70, m: int = 130) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return 3 * rng.normal(size=(n, 3)), 3 * rng.normal(size=(m, 3))


def truth_of(cloud: np.ndarray, mesh: trimesh.Trimesh | None = None) -> TrueSurface:
    surface = None if mesh is None else Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return TrueSurface(cloud, "by hand", surface, "by hand")


@pytest.mark.parametrize("seed", range(5))
def test_distances_agree_with_trying_every_pair(seed):
    model, cloud = clouds(seed)
    pairs = np.sqrt(((model[:, None] - cloud) ** 2).sum(-1))
    found = surface_errors(model, truth_of(cloud))
    np.testing.assert_allclose(found.accuracy, pairs.min(1), atol=1e-9)
    np.testing.assert_allclose(found.completeness, pairs.min(0), atol=1e-9)
    summary = found.summary(THRESHOLDS)
    assert summary.points == 70 and summary.to_mesh is None
    assert summary.rms_mm == pytest.approx(np.sqrt((pairs.min(1) ** 2).mean()), abs=1e-9)
    assert summary.median_mm == pytest.approx(sorted(pairs.min(1))[34] / 2 + sorted(pairs.min(1))[35] / 2, abs=1e-9)
    assert summary.chamfer_mm == pytest.approx((pairs.min(1).mean() + pairs.min(0).mean()) / 2, abs=1e-9)
    for t in THRESHOLDS:
        p = sum(d <= t for d in pairs.min(1)) / 70
        r = sum(d <= t for d in pairs.min(0)) / 130
        key = f"{t:g}mm"
        assert (summary.precision[key], summary.recall[key]) == pytest.approx((p, r), abs=1e-12)
        assert summary.f_score[key] == pytest.approx(2 * p * r / (p + r) if p + r else 0, abs=1e-12)


def test_distances_agree_with_open3d():
    from lightdepth import native

    o3d = native.open3d()
    model, cloud = clouds(9, 500, 2000)
    theirs = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (model, cloud)]
    extent = np.ptp(cloud, 0).max()
    expected = np.asarray(theirs[0].compute_point_cloud_distance(theirs[1]))
    np.testing.assert_allclose(surface_errors(model, truth_of(cloud)).accuracy, expected, atol=1e-5 * extent)


def slow_to_triangle(p: np.ndarray, corners: np.ndarray) -> float:
    """Distance from a point to a triangle: to the plane where its foot is inside, else to the closest edge."""
    a, b, c = corners
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    foot = p - (p - a) @ normal * normal
    if all(np.cross(v - u, foot - u) @ normal >= 0 for u, v in ((a, b), (b, c), (c, a))):
        return abs((p - a) @ normal)
    along = [np.clip((p - u) @ (v - u) / ((v - u) @ (v - u)), 0, 1) for u, v in ((a, b), (b, c), (c, a))]
    edges = zip(along, ((a, b), (b, c), (c, a)), strict=True)
    return min(np.linalg.norm(u + s * (v - u) - p) for s, (u, v) in edges)


def test_distances_to_a_mesh_agree_with_trying_every_triangle_and_with_trimesh():
    mesh = trimesh.creation.icosphere(1, 20.0)
    points = 15 * np.random.default_rng(0).normal(size=(40, 3))
    found = surface_errors(points, truth_of(points[:1], mesh)).to_mesh
    slow = [min(slow_to_triangle(p, corners) for corners in mesh.triangles) for p in points]
    _, theirs, _ = trimesh.proximity.closest_point_naive(mesh, points)
    np.testing.assert_allclose(theirs, slow, atol=1e-9)
    np.testing.assert_allclose(found, slow, atol=1e-5 * 40)


def test_a_grid_held_over_a_plane_by_hand():
    grid = np.stack(np.meshgrid(np.arange(21.0), np.arange(21.0), [0.0]), -1).reshape(-1, 3)
    half = grid[grid[:, 0] < 10.5] + (0, 0, 0.75)
    found = surface_errors(half, truth_of(grid)).summary((0.5, 1.0))
    assert found.rms_mm == found.median_mm == found.p90_mm == pytest.approx(0.75)
    assert found.precision == {"0.5mm": 0, "1mm": 1} and found.f_score["0.5mm"] == 0
    assert found.recall["1mm"] == pytest.approx(11 / 21)
    assert found.f_score["1mm"] == pytest.approx(2 * (11 / 21) / (1 + 11 / 21))


def test_models_together_are_as_accurate_as_all_their_points_and_as_complete_as_the_best():
    cloud = clouds(0)[1]
    parts = [clouds(seed, n)[0] for seed, n in ((1, 20), (2, 50))]
    together = pooled([surface_errors(p, truth_of(cloud)) for p in parts])
    whole = surface_errors(np.concatenate(parts), truth_of(cloud))
    np.testing.assert_allclose(together.accuracy, whole.accuracy, atol=1e-12)
    np.testing.assert_allclose(together.completeness, whole.completeness, atol=1e-12)
    assert together.to_mesh is None and isinstance(together, SurfaceErrors)


def test_a_model_without_points_is_refused():
    with refused(where="the model", found="has no points"):
        closest(np.zeros((0, 3)), truth_of(clouds(0)[1]).tree)


@pytest.mark.parametrize("seed", range(3))
def test_thinning_keeps_one_point_a_cube_whatever_their_order_and_number(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (4000, 3))
    kept = thinned(points, 0.5)
    cells = np.floor(kept / 0.5)
    assert len(np.unique(cells, axis=0)) == len(kept) == len(np.unique(np.floor(points / 0.5), axis=0))
    again = np.concatenate([points, points[::3]])[rng.permutation(4000 + 1334)]
    np.testing.assert_array_equal(thinned(again, 0.5), kept)
    off = {tuple(c): np.inf for c in cells}  # slowly: the closest to the centre of each cube
    for p in points:
        c = tuple(np.floor(p / 0.5))
        off[c] = min(off[c], np.linalg.norm(p / 0.5 - np.array(c) - 0.5))
    found = np.linalg.norm(kept / 0.5 - cells - 0.5, axis=1)
    np.testing.assert_allclose(found, [off[tuple(c)] for c in cells], atol=1e-12)


def test_truth_that_is_metres_away_has_another_unit():
    with refused(where="the true surface", found="reaches 900 m"):
        thinned(np.array([[9e5, 0, 0]]), 0.2)


def test_a_sphere_s_depth_is_triangulated_without_holes_and_a_fold_is_not_bridged():
    camera = PINHOLE.resized(40, 30)
    frame = replace(sphere(camera, 20.0).frame(), true_world_from_cam=np.eye(4))
    vertices, triangles = depth_triangles(frame, 1)
    assert len(vertices) == 1200 and len(triangles) == 2 * 39 * 29
    normals = np.cross(*(vertices[triangles[:, i]] - vertices[triangles[:, 0]] for i in (1, 2)))
    assert ((normals * vertices[triangles[:, 0]]).sum(1) < 0).all() or (
        (normals * vertices[triangles[:, 0]]).sum(1) > 0
    ).all()
    fold = np.where(np.arange(40) < 20, 20.0, 30.0).astype(np.float32) * np.ones((30, 1), np.float32)
    assert len(depth_triangles(replace(frame, true_distance=fold), 1)[1]) == 2 * 38 * 29
    half = np.where(np.arange(40) < 20, 20.0, 0.0).astype(np.float32) * np.ones((30, 1), np.float32)
    assert len(depth_triangles(replace(frame, true_distance=half), 1)[1]) == 2 * 19 * 29
    assert len(depth_triangles(frame, 2)[0]) == 20 * 15


def test_what_the_mask_hides_is_no_true_point_and_a_jump_of_a_fifth_is_no_wall():
    camera = PINHOLE.resized(40, 30)
    mask = np.ones((30, 40), bool)
    mask[:, :10] = False
    frame = replace(sphere(camera, 20.0).frame(), true_world_from_cam=np.eye(4))
    assert true_points(replace(frame, mask=mask), 1)[1].sum() == 30 * 30
    fold = np.where(np.arange(40) < 20, 20.0, 24.0).astype(np.float32) * np.ones((30, 1), np.float32)
    assert len(depth_triangles(replace(frame, true_distance=fold), 1)[1]) == 2 * 38 * 29


def test_the_spacing_of_a_cloud_is_the_distance_of_neighbours():
    assert truth_of(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [6, 0, 0]])).spacing_mm == 1.0


# What must not matter


@pytest.fixture(scope="module")
def world() -> Truth:
    return read_truth(sequence(colon(0).frames))


def model(seed: int, map_from_world: Similarity, order: np.ndarray | None = None) -> JudgedMap:
    """A map whose points are the wall's with noise, in a frame of reference of its own."""
    rng = np.random.default_rng(seed)
    frames = colon(0).frames
    wall = true_cloud(frames, stride=4)
    points = wall + 0.5 * rng.normal(size=wall.shape)
    centers = np.stack([f.true_world_from_cam[:3, 3] for f in frames]) + 0.05 * rng.normal(size=(10, 3))
    points = points if order is None else points[order]
    trajectory = in_order(0, list(range(10)), map_from_world.apply(centers))
    return JudgedMap(trajectory, {"sparse": map_from_world.apply(points)})


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def figures(judged) -> dict[str, float]:
    """Every number of the sparse model, flat."""
    found = judged.as_dict()["maps"][0]["sparse"]
    flat = {k: v for k, v in found.items() if not isinstance(v, dict) and v is not None}
    return flat | {f"{k}/{n}": v for k, inner in found.items() if isinstance(inner, dict) for n, v in inner.items()}


@pytest.mark.parametrize("seed", range(3))
def test_the_map_s_frame_of_reference_unit_and_order_of_points_do_not_matter(seed, world):
    expected = figures(judge_maps([model(seed, IDENTITY)], world))
    assert len(expected) == 20 and expected["to_mesh/median_mm"] > 0
    rng = np.random.default_rng(seed)
    away = Similarity(float(np.exp(2 * rng.normal())), Rotation.random(rng=rng).as_matrix(), 30 * rng.normal(size=3))
    exact = {k: v for k, v in expected.items() if not k.startswith("to_mesh")}
    moved = figures(judge_maps([model(seed, away)], world))
    assert {k: moved[k] for k in exact} == pytest.approx(exact, rel=1e-9)
    assert moved == pytest.approx(expected, rel=1e-4)  # distances to the mesh are in single precision
    order = rng.permutation(len(model(seed, IDENTITY).clouds["sparse"]))
    assert figures(judge_maps([model(seed, IDENTITY, order)], world)) == pytest.approx(expected, rel=1e-9)


def test_truth_that_is_given_twice_or_in_another_order_is_the_same(world):
    frames = colon(0).frames
    later = [replace(f, name=f"{f.number + 100:06d}") for f in frames]
    expected = figures(judge_maps([model(0, IDENTITY)], world))
    for given in ([*frames, *later], [*reversed(later), *frames], list(reversed(frames))):
        found = read_truth(sequence(given))
        np.testing.assert_array_equal(found.surface.cloud, world.surface.cloud)
        assert figures(judge_maps([model(0, IDENTITY)], found)) == pytest.approx(expected, rel=1e-6)


def test_truth_sampled_more_densely_changes_no_more_than_its_spacing(world):
    dense = TrueSurface(true_cloud(colon(0).frames, stride=1, cube=0.05), "", world.surface.mesh)
    found = figures(judge_maps([model(0, IDENTITY)], replace(world, surface=dense)))
    expected = figures(judge_maps([model(0, IDENTITY)], world))
    assert 0 <= expected["median_mm"] - found["median_mm"] < world.surface.spacing_mm
    assert found["to_mesh/median_mm"] == expected["to_mesh/median_mm"] < found["median_mm"]


def test_a_map_that_may_be_turned_about_its_line_of_travel_gets_no_surface_figures(world):
    rng = np.random.default_rng(0)
    line = np.linspace(0, 60, 10)[:, None] * (1, 0, 0)
    straight = {n: np.eye(4) for n in range(10)}
    for n, center in enumerate(line + 0.2 * rng.normal(size=(10, 3))):
        straight[n][:3, 3] = center
    centers = line + 0.2 * rng.normal(size=(10, 3))
    given = replace(model(0, IDENTITY), trajectory=in_order(0, list(range(10)), centers))
    with refused(cure="may be turned about its line of travel, and its surface cannot be compared"):
        judge_maps([given], replace(world, poses=straight))
    alone = judge_maps([replace(given, clouds={})], replace(world, poses=straight)).judged
    assert not alone.pooled and alone.maps[0].aligned.rms_ate_mm < 1


def test_a_mesh_beside_the_frames_is_the_truth_unless_it_is_another_s(tmp_path, world):
    frames = colon(0).frames
    pieces = [depth_triangles(f, 1) for f in frames[::3]]
    counts = np.cumsum([0, *(len(v) for v, _ in pieces)])
    faces = np.concatenate([t + n for (_, t), n in zip(pieces, counts, strict=False)])
    vertices = np.concatenate([v for v, _ in pieces])
    for scale, name in ((1, "coverage_mesh.obj"), (0.001, "metres.ply")):
        trimesh.Trimesh(scale * vertices, faces, process=False).export(tmp_path / name)
    found = read_truth(sequence(frames, str(tmp_path)))
    assert found.surface.mesh_source == f"coverage_mesh.obj, {len(faces)} triangles"
    points = model(0, IDENTITY).clouds["sparse"]
    np.testing.assert_allclose(
        np.median(found.surface.mesh.distance(points)), np.median(world.surface.mesh.distance(points)), atol=0.05
    )
    with refused("the true depth is … mm from it", where="metres.ply"):
        read_truth(sequence(frames), tmp_path / "metres.ply")
    (tmp_path / "broken.ply").write_text("no mesh")
    with refused(where="broken.ply", found="not a mesh that can be read"):
        read_mesh(tmp_path / "broken.ply")
    with refused(where="none.ply", found="no such mesh"):
        read_mesh(tmp_path / "none.ply")


def test_a_sequence_with_poses_alone_judges_trajectories_and_one_with_neither_nothing():
    frames = [replace(f, true_distance=None) for f in colon(0).frames]
    judged = judge_maps([model(0, IDENTITY)], read_truth(sequence(frames))).as_dict()
    assert judged["kind"] == "trajectory" and judged["all"] == {} and "sparse" not in judged["maps"][0]
    assert judged["truth"]["cloud"] == "the sequence has true poses but no true depth"
    with refused(found="no frame has a true pose"):
        read_truth(sequence([replace(f, true_world_from_cam=None) for f in colon(0).frames]))
    holes = [replace(f, true_distance=f.true_distance * np.nan) for f in colon(0).frames]
    with refused(where="000000", found="the true depth is NaN or infinite at 7680 pixels"):
        read_truth(sequence(holes))
