"""What was seen, how well, and what was not, on surfaces whose areas are known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from colons import colon, sequence, slam, truth
from scenes import cylinder, sphere

from densify.config import DensifyConfig
from densify.coverage import CoverageConfig, contribution, coverage, find_holes, looked_at, patches, rims, seen_well
from densify.dense_map import Contribution, DenseMap
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from densify.judging.config import JudgeConfig
from densify.pipeline import densify
from lightdepth.sparse_map import Keyframe, Submap
from lightdepth.tube import lens

BALL = trimesh.creation.icosphere(4, 10.0)
VERTICES, INWARD = np.asarray(BALL.vertices), np.asarray(BALL.faces)[:, ::-1]  # seen from inside
POLAR = np.arccos(VERTICES[INWARD].mean(1)[:, 2] / np.linalg.norm(VERTICES[INWARD].mean(1), axis=1))


def look(z: float, number: int) -> Keyframe:
    pose = np.eye(4)
    pose[2, 3] = -z
    return Keyframe(f"{number:06d}.png", lens("fisheye", 80, 64), pose, np.zeros((0, 2)), np.zeros(0, int))


def ball(triangles: np.ndarray, weights: np.ndarray, views: np.ndarray) -> DenseMap:
    submap = Submap(0, (look(0, 3), look(-9, 8)), np.arange(1), np.ones((1, 3)))
    colors = np.full_like(VERTICES, 0.5)
    return DenseMap(submap, VERTICES, triangles, colors, (), 0.4, "map units", weights, views)


def test_a_hole_in_a_wall_is_found_with_its_area_and_place():
    ((area, middle),) = find_holes(VERTICES, INWARD[POLAR > 0.4])
    cap = 2 * np.pi * 100 * (1 - np.cos(0.4))
    assert area == pytest.approx(cap, rel=0.06)  # jagged, and cut off flat
    np.testing.assert_allclose(middle, [0, 0, 10 * np.cos(0.4)], atol=0.4)


def test_the_outer_rim_of_a_patch_and_the_ends_of_a_tube_are_no_holes():
    assert find_holes(VERTICES, INWARD[POLAR < 0.8]) == []
    tube = trimesh.creation.cylinder(5.0, 30.0, sections=64)
    side = np.abs(tube.face_normals[:, 2]) < 0.5
    faces = np.asarray(tube.faces)[side][:, ::-1]
    assert len(rims(faces)) == 2 and find_holes(np.asarray(tube.vertices), faces) == []


def test_a_hole_in_the_side_of_a_fused_tube_is_found_and_its_ends_are_not():
    scene = cylinder(lens("fisheye", 160, 128))
    prediction = scene.prediction()
    points = (scene.rays * scene.distance)[0].permute(1, 2, 0).numpy()
    missing = np.linalg.norm(points - [8, 0, 10], axis=-1) < 2.5
    volume = TsdfVolume(0.35, FusionConfig())
    volume.integrate(
        surface_view(
            replace(prediction, valid=prediction.valid & ~missing), scene.frame().image, RectifyConfig(), 25.0
        ),
        np.eye(4),
    )
    mesh = volume.extract_mesh()
    holes = [h for h in find_holes(mesh.vertices, mesh.triangles) if h[0] > 1]
    assert len(holes) == 1
    assert np.pi * 2.5**2 < holes[0][0] < np.pi * (2.5 + 2 * 0.35) ** 2  # marching cubes stops a voxel or two before
    np.testing.assert_allclose(holes[0][1], [8, 0, 10], atol=0.6)


def test_two_holes_that_touch_in_a_vertex_are_still_closed_loops():
    grid = trimesh.creation.box().subdivide().subdivide().subdivide()
    faces = np.asarray(grid.faces)
    around = faces[(faces == faces[0, 0]).any(1)]
    kept = np.array([not any((f == a).all() for a in around[::2]) for f in faces])
    loops = rims(faces[kept])
    directed = {(int(a), int(b)) for loop in loops for a, b in zip(loop, np.roll(loop, -1), strict=True)}
    edges = {(int(f[i]), int(f[(i + 1) % 3])) for f in faces[kept] for i in range(3)}
    assert directed == {(a, b) for a, b in edges if (b, a) not in edges}


def test_area_is_split_into_what_was_seen_well_weakly_and_not_at_all():
    front = VERTICES[:, 2] / 10 > np.cos(1.0)
    views, weights = np.where(front, 5, 2), np.where(VERTICES[:, 0] > -20, 3.0, 0.0)
    found = coverage(ball(INWARD[POLAR > 0.4], weights, views))
    cap = 2 * np.pi * 100 * (1 - np.cos(1.0))
    gone = 2 * np.pi * 100 * (1 - np.cos(0.4))
    assert found.area == pytest.approx(400 * np.pi - gone, rel=0.02)
    assert found.well == pytest.approx(cap - gone, rel=0.1)
    assert found.well_share == pytest.approx((cap - gone) / (400 * np.pi), rel=0.1)
    (weak,), (hole,) = found.weak, found.holes
    assert weak.area == pytest.approx(400 * np.pi - cap, rel=0.04) and weak.center[2] < 0
    assert hole.frame == 3  # the nearer camera from which it lies in front


def test_lengths_go_by_one_power_areas_by_two():
    dense = ball(INWARD[POLAR > 0.4], np.full(len(VERTICES), 3.0), np.full(len(VERTICES), 5))
    found, scaled = coverage(dense), coverage(dense).scaled(2.0)
    assert scaled.area == 4 * found.area and scaled.hole_area == 4 * found.hole_area
    np.testing.assert_allclose(scaled.holes[0].center, 2 * found.holes[0].center)
    assert scaled.well_share == pytest.approx(found.well_share)
    record = scaled.record()
    assert record["holes"][0]["area"] == scaled.holes[0].area and record["well_area"] == scaled.well


@pytest.mark.parametrize(
    "config, well",
    [({}, 1.0), ({"views": 5}, 1.0), ({"views": 6}, 0.0), ({"weight": 3.0}, 1.0), ({"weight": 3.5}, 0.0)],
)
def test_well_is_what_the_settings_say(config, well):
    dense = ball(INWARD, np.full(len(VERTICES), 3.0), np.full(len(VERTICES), 5))
    assert coverage(dense, CoverageConfig(**config)).well_share == pytest.approx(well)
    assert seen_well(dense, CoverageConfig(**config)).mean() == well


def test_what_is_smaller_than_a_few_voxels_is_not_listed():
    views = np.full(len(VERTICES), 5)
    views[0] = 1
    dense = ball(INWARD, np.full(len(VERTICES), 3.0), views)
    assert coverage(dense).weak == ()
    assert len(coverage(dense, CoverageConfig(min_voxels=0.1)).weak) == 1


def test_patches_are_listed_largest_first():
    views = np.where((VERTICES[:, 2] > 8) | (VERTICES[:, 2] < -4), 1, 5)
    first, second = coverage(ball(INWARD, np.full(len(VERTICES), 3.0), views)).weak
    assert first.area > 2 * second.area and first.center[2] < 0 < second.center[2]


def test_a_nearer_camera_that_looks_away_does_not_show_a_hole():
    """The hole is at z 9.2, behind the camera at z 9.5 and before that at 0."""
    dense = ball(INWARD[POLAR > 0.4], np.full(len(VERTICES), 3.0), np.full(len(VERTICES), 5))
    near = replace(dense, submap=replace(dense.submap, keyframes=(look(0, 3), look(9.5, 8))))
    assert coverage(near).holes[0].frame == 3


def test_patches_hang_together_by_vertices():
    rows = np.flatnonzero((POLAR < 0.4) | (POLAR > 2.8))
    parts = patches(INWARD, rows)
    assert len(parts) == 2 and sorted(np.concatenate(parts)) == rows.tolist()
    assert {bool((POLAR[p] < 1).all()) for p in parts} == {True, False}


def test_an_empty_surface_has_no_coverage():
    none = np.zeros((0, 3))
    dense = replace(ball(INWARD, none[:, 0], none[:, 0]), vertices=none, triangles=none.astype(int))
    found = coverage(dense)
    assert found.area == found.well == found.hole_area == 0 == found.well_share


def test_a_keyframe_says_what_share_it_gave_and_with_what_weight():
    prediction = sphere(lens("fisheye", 80, 64)).prediction()
    image = np.full((64, 80, 3), 0.5, np.float32)
    whole = contribution(surface_view(prediction, image, RectifyConfig(feather=0.0)), prediction)
    assert whole.fused_share == 1 and whole.fused_weight == pytest.approx(1, abs=0.01) and np.isnan(whole.views)
    dark = surface_view(prediction, 0 * image, RectifyConfig(feather=0.0))
    assert contribution(dark, prediction).fused_weight == pytest.approx(0.5, abs=0.01)
    cropped = surface_view(prediction, image, RectifyConfig(field="pinhole", feather=0.0))
    assert 0.4 < contribution(cropped, prediction).fused_share < 0.7


def test_a_keyframe_says_how_well_what_it_looks_at_was_seen():
    dense = ball(INWARD, np.where(VERTICES[:, 2] > 0, 3.0, 1.0), np.where(VERTICES[:, 2] > 0, 5, 2))
    found = looked_at(dense, look(0, 3), Contribution(1.0, 1.0))
    assert found.confidence == pytest.approx(0.75) and found.views == 5 and found.fused_share == 1.0
    blind = replace(dense, vertices=VERTICES + [0, 0, -100.0])
    assert np.isnan(looked_at(blind, look(0, 3), Contribution(1.0, 1.0)).views)


def test_confidence_tells_good_wall_from_bad():
    """On a colon whose distances are wrong where the wall is far: the confident half errs less."""
    rendered = colon(1)
    rng = np.random.default_rng(0)

    def noisy(frame):
        right = truth(frame)
        wave = cv2.resize(rng.normal(size=(6, 7)), right.distance.shape[::-1], interpolation=cv2.INTER_CUBIC)
        wrong = np.exp(0.1 * wave * right.distance / np.median(right.distance))
        return replace(right, distance=(right.distance * wrong).astype(np.float32))

    frames = rendered.frames[::2]
    found = slam(frames, 1, spurious=0.0)
    dense = densify(sequence(frames), found.map, noisy, DensifyConfig(judge=JudgeConfig(on=False)))[0].dense
    scale, rotation, translation = found.map_from_world[0]
    off = rendered.tube.distance_to_wall((dense.vertices - translation) @ rotation / scale)
    confident = dense.confidence > np.median(dense.confidence)
    print(
        f"median error {np.median(off[confident]):.3f} mm where confident, {np.median(off[~confident]):.3f} elsewhere"
    )
    assert np.median(off[confident]) < 0.85 * np.median(off[~confident])
