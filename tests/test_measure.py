"""Lengths and areas on surfaces whose answers are known: plane, sphere, tube."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from raising import refused
from scenes import cylinder, slanted_plane, sphere

from densify.alignment import Alignment
from densify.commands.measure import measure
from densify.dense_map import DenseMap
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from densify.measure import Wall, disc, on_wall, patch, path
from lightdepth.sparse_map import Keyframe, Submap
from lightdepth.tube import lens

SCENES = {"plane": slanted_plane, "sphere": sphere, "tube": cylinder}
CAMERA = lens("fisheye", 160, 128)


@cache
def wall(name: str, voxel: float = 0.35) -> Wall:
    """The surface that fusion makes of exact depth."""
    scene = SCENES[name](CAMERA)
    volume = TsdfVolume(voxel, FusionConfig())
    volume.integrate(surface_view(scene.prediction(), scene.frame().image, RectifyConfig(), 25.0), np.eye(4))
    mesh = volume.extract_mesh()
    return Wall(mesh.vertices, mesh.triangles)


def on_sphere(polar: float, azimuth: float) -> np.ndarray:
    return 10 * np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])


@pytest.mark.parametrize(
    "ends", [((0.1, 0), (0.9, 0)), ((0.7, 0.2), (0.8, 3.1)), ((1.0, 0.3), (1.0, -0.4)), ((0, 0), (0.02, 0))]
)
def test_the_way_over_a_sphere_is_an_arc_of_a_great_circle(ends):
    start, end = (on_sphere(*e) for e in ends)
    arc = 10 * np.arccos(np.clip(start @ end / 100, -1, 1))
    found = path(wall("sphere"), *on_wall(wall("sphere"), np.stack([start, end])))
    print(f"arc {arc:.3f}, found {found.length:.3f} ({found.length / arc - 1:+.2%})")
    assert found.length == pytest.approx(arc, rel=0.005)
    assert found.straight == pytest.approx(np.linalg.norm(start - end), rel=0.005)
    assert found.over_holes == 0 and np.abs(np.linalg.norm(found.points, axis=1) - 10).max() < 0.02


def test_the_way_over_a_plane_is_straight():
    w = wall("plane")
    places = on_wall(w, w.vertices[[50, len(w.vertices) // 2]])
    found = path(w, *places)
    assert found.straight > 3 and found.length == pytest.approx(found.straight, rel=0.002)


def test_the_way_around_a_tube_is_a_helix():
    start, end = np.array([8.0, 0, 9]), np.array([8 * np.cos(1.5), 8 * np.sin(1.5), 13])
    found = path(wall("tube"), *on_wall(wall("tube"), np.stack([start, end])))
    assert found.length == pytest.approx(np.hypot(8 * 1.5, 4), rel=0.005)


@pytest.mark.parametrize("radius", [2.0, 4.0])
def test_a_disc_of_a_sphere_has_the_area_of_a_cap(radius):
    """Of straight radius r: pi r², on any sphere."""
    for polar in (0.0, 0.6):
        assert disc(wall("sphere"), on_sphere(polar, 0), radius).area == pytest.approx(np.pi * radius**2, rel=0.01)


def test_an_outlined_patch_of_a_sphere_has_its_area_and_outline():
    """A triangle of great arcs: its excess over 180 degrees, times r²."""
    corners = np.stack([on_sphere(0.5, a) for a in (0.3, 2.4, 4.5)])
    unit = corners / 10
    normals = [np.cross(unit[i], unit[(i + 1) % 3]) for i in range(3)]
    normals = [n / np.linalg.norm(n) for n in normals]
    angles = [np.pi - np.arccos(normals[i] @ normals[(i + 1) % 3]) for i in range(3)]
    arcs = sum(10 * np.arccos(unit[i] @ unit[(i + 1) % 3]) for i in range(3))
    found = patch(wall("sphere"), on_wall(wall("sphere"), corners))
    print(f"area {100 * (sum(angles) - np.pi):.3f}, found {found.area:.3f}")
    assert found.area == pytest.approx(100 * (sum(angles) - np.pi), rel=0.01)
    assert found.outline == pytest.approx(arcs, rel=0.005)


def test_an_outline_that_bends_inwards_keeps_its_bay_outside():
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    across = np.cross(normal, [0, 1.0, 0])
    across /= np.linalg.norm(across)
    flat = np.array([[-3, -3], [3, -3], [3, 3], [0, 0], [-3, 3.0]])
    corners = -12 * normal + flat @ np.stack([across, np.cross(normal, across)])
    assert patch(wall("plane"), on_wall(wall("plane"), corners)).area == pytest.approx(36 - 9, rel=0.01)


def test_the_other_side_of_a_tube_does_not_count_with_a_patch():
    ring = [(a, z) for a, z in ((-0.4, 9), (0.4, 9), (0.4, 13), (-0.4, 13))]
    corners = np.array([[8 * np.cos(a), 8 * np.sin(a), z] for a, z in ring])
    assert patch(wall("tube"), on_wall(wall("tube"), corners)).area == pytest.approx(0.8 * 8 * 4, rel=0.02)


def test_what_cannot_be_measured_says_why():
    w = wall("sphere")
    with refused(found="is 5 from the surface"):
        on_wall(w, np.array([[0, 0, 5.0]]))
    with refused(where="3 corners", found="lie on a line"):
        ends = np.array([[x, y, 0.3 * x - 0.2 * y + 12 * np.sqrt(1.13)] for x, y in ((-3, 2), (-3, 2), (4, -1))])
        patch(wall("plane"), on_wall(wall("plane"), ends))
    apart = Wall(
        np.concatenate([w.vertices, w.vertices + 100]), np.concatenate([w.triangles, w.triangles + len(w.vertices)])
    )
    with refused(found="parts that do not touch", cure="the straight distance is 17"):
        path(apart, w.vertices[0], w.vertices[0] + 100)
    with refused(found="no triangles"):
        Wall(np.zeros((0, 3)), np.zeros((0, 3), int))


def test_the_way_keeps_to_the_wall_around_a_hole():
    """Two tangents and the arc between them, around a jagged hole with a radius between 2 and 2.35."""
    w = wall("plane")
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    middle, across = -12 * normal, np.array([1.0, 0, 0.3]) / np.linalg.norm([1.0, 0, 0.3])
    kept = np.linalg.norm(w.vertices - middle, axis=1)[w.triangles].min(1) > 2
    holed = Wall(w.vertices, w.triangles[kept])
    found = path(holed, *on_wall(holed, np.stack([middle - 4 * across, middle + 4 * across])))
    shortest, longest = (2 * np.sqrt(16 - r**2) + r * (np.pi - 2 * np.arccos(r / 4)) for r in (2, 2.35))
    assert shortest < found.length < 1.01 * longest
    assert found.over_holes == 0 and found.straight == pytest.approx(8, rel=0.001)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run with the sphere as its only map, in map units."""
    scene = sphere(CAMERA)
    volume = TsdfVolume(0.35, FusionConfig())
    volume.integrate(surface_view(scene.prediction(), scene.frame().image, RectifyConfig()), np.eye(4))
    mesh = volume.extract_mesh()
    keyframe = Keyframe("000004.png", CAMERA, np.eye(4), np.zeros((0, 2)), np.zeros(0, int))
    submap = Submap(0, (keyframe,), np.arange(1), np.ones((1, 3)))
    parts = mesh.vertices, mesh.triangles, mesh.colors, (Alignment("000004.png"),), 0.35, "map units"
    folder = tmp_path_factory.mktemp("measure")
    DenseMap(submap, *parts, mesh.weights, mesh.views).write(folder / "map_000")
    (folder / "run.json").write_text(json.dumps({"unit": "map units"}))
    return folder


def test_the_verb_measures_between_places_in_millimetres_where_told(run, tmp_path, capsys):
    places = [tuple(on_sphere(0.2, 0)), tuple(on_sphere(0.8, 0))]
    measure(run, points=places, mm_per_unit=2.0, output=tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["length"] == pytest.approx(12, rel=0.005) and found["unit"] == "mm" and found["map"] == 0
    assert found["least_views"] == 1 and 0.3 < found["least_confidence"] <= 0.5
    said = capsys.readouterr().out
    assert "along the surface 12" in said and "mm" in said and "seen by 1 keyframes or more" in said
    assert list(tmp_path.iterdir()) == [tmp_path / "found.json"]


def test_the_verb_takes_pixels_of_a_keyframe_and_says_that_a_map_has_no_size(run, capsys):
    pixels, _ = CAMERA.project(np.stack([on_sphere(0.2, 0), on_sphere(0.8, 0)]))
    measure(run, frame=4, pixels=[tuple(p) for p in pixels.tolist()])
    assert (
        "along the surface 6" in (said := capsys.readouterr().out)
        and "map units" in said
        and "no size of its own" in said
    )


def test_the_verb_takes_the_folder_of_one_map_and_the_unit_of_its_run(run, capsys):
    measure(run / "map_000", points=[tuple(on_sphere(0.2, 0)), tuple(on_sphere(0.8, 0))])
    assert "along the surface 6" in (said := capsys.readouterr().out) and "map units" in said


def test_the_verb_measures_areas(run, capsys):
    measure(run, points=[(0, 0, 10.0)], radius=3.0)
    assert "area 28" in capsys.readouterr().out
    measure(run, points=[tuple(on_sphere(0.5, a)) for a in (0.3, 2.4, 4.5)])
    assert "outline" in capsys.readouterr().out


@pytest.mark.parametrize(
    "given, message",
    [
        ({}, "either by --points, or by --frame and --pixels"),
        ({"pixels": [(3, 3)]}, "either by --points, or by --frame and --pixels"),
        ({"points": [(0, 0, 10.0)]}, "places … 1 … one place with a radius"),
        ({"points": [(0, 0, 10.0)] * 2, "radius": 1.0}, "2 and a radius"),
        ({"points": [(0, 0, 10.0)], "radius": -1.0}, "--radius … -1.0"),
        ({"points": [(0, 0, np.nan)] * 2}, "expected finite numbers"),
        ({"points": [(0, 0, 10.0)] * 2, "map": 3}, "no map 3 … it has [0]"),
        ({"frame": 9, "pixels": [(3, 3)]}, "frame 9 is no keyframe of it … the nearest is 4"),
        ({"frame": 4, "pixels": [(300, 3), (3, 3)]}, "pixel [300.0, 3.0] is outside the image"),
        ({"points": [(0, 0, 10.0)] * 2, "mm_per_unit": 0.0}, "--mm-per-unit … 0.0"),
    ],
)
def test_the_verb_refuses_what_it_cannot_measure(run, given, message):
    with refused(message):
        measure(run, **given)
