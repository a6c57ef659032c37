"""The scene in a report holds the surface itself, without a word to anywhere, and is the same whenever it is made."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib.resources import files
from types import SimpleNamespace

import numpy as np
import pytest
from colons import colon, sequence, slam, truth

from densify.config import DensifyConfig
from densify.dense_map import DenseMap
from densify.evaluation.records import ErrorMesh
from densify.judging.verdict import Verdict
from densify.page import FILES, Gallery, _surfaces, densify_page
from densify.pipeline import SubmapResult, densify
from densify.scene import surface_of
from densify.thumbnails import PICTURES, Thumbnails, said
from lightdepth.reporting.figures import jpeg
from lightdepth.reporting.names import names_of
from lightdepth.reporting.report import Report
from lightdepth.reporting.scene import Cloud, Layer, Pose, Scene, Surface, thinned, unpacked

DRAWING = ("scene_surface.js", "scene_viewer.js")
PIXEL = jpeg(np.zeros((8, 8, 3), np.uint8))


@pytest.fixture(scope="module")
def made():
    frames = colon(0).frames[:4]
    found = slam(frames, maps=1).map
    gallery = Gallery(found)
    (result,) = densify(sequence(frames), found, truth, DensifyConfig(), gallery)
    return result, gallery


def scene_in(text: str) -> dict:
    (found,) = re.findall(r'<script type="application/json">(.*?)</script>', text)
    return json.loads(found)


def places(told: dict) -> np.ndarray:
    return np.array(told["low"]) + np.array(told["step"]) * unpacked({"uint16": told["uint16"]}).reshape(-1, 3)


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A wavy square of side x side vertices."""
    u, v = np.meshgrid(np.arange(side, dtype=float), np.arange(side, dtype=float), indexing="ij")
    vertices = np.stack([u, v, 3 * np.sin(u / 7) * np.cos(v / 9)], -1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    lower = np.stack([corner, corner + side, corner + 1], 1)
    return vertices, np.concatenate([lower, np.stack([corner + 1, corner + side, corner + side + 1], 1)])


def test_the_scene_of_a_report_has_the_surfaces_triangles_its_places_and_its_colours(made, tmp_path):
    result, gallery = made
    dense, page = result.dense, tmp_path / "report.html"
    scene = Scene.of([surface_of("map 0", result.dense)], gallery.thumbnails.found)
    report = Report("A surface")
    report.scene(replace(scene, most=len(dense.triangles)))
    report.write(page)
    (told,) = scene_in(page.read_text(encoding="utf-8"))["surfaces"]
    assert (unpacked(told["triangles"]).reshape(-1, 3) == dense.triangles).all()
    off = np.abs(places(told["vertices"]) - dense.vertices)
    assert (off <= 0.501 * np.array(told["vertices"]["step"])).all() and off.max() < 0.01 * dense.voxel
    assert told["triangles_made"] == len(dense.triangles)
    first, confidence = (next(x for x in told["layers"] if x["title"] == t) for t in ("Of the images", "Confidence"))
    assert np.abs(unpacked(first["values"]).reshape(-1, 3) / 255 - dense.colors).max() <= 0.5 / 255 + 1e-6
    assert np.abs(unpacked(confidence["values"]) / 255 - dense.confidence).max() <= 0.5 / 255 + 1e-6


def test_the_scene_begins_with_a_green_surface(made):
    (result, _), judged = made, []
    for number, colour in enumerate(("red", "amber", "green", "green")):
        submap = replace(result.dense.submap, id=number)
        verdict = SimpleNamespace(verdict=Verdict(colour, "as it is"))
        judged.append(replace(result, dense=replace(result.dense, submap=submap), judgement=verdict, coverage=None))
    assert [surface.title for surface in _surfaces(judged, None, [])] == ["map 2", "map 3", "map 0", "map 1"]
    unjudged = [replace(found, judgement=None) for found in judged]
    assert [surface.title for surface in _surfaces(unjudged, None, [])] == ["map 0", "map 1", "map 2", "map 3"]


def test_the_scene_has_the_cameras_of_the_path_the_points_by_kind_and_the_errors_that_are_known(made, tmp_path):
    result, gallery = made
    dense = result.dense
    errors = [ErrorMesh("map_000", dense.vertices, dense.triangles, np.linspace(0, 5, len(dense.vertices)))]
    page = densify_page("Maps", [result], gallery, [], errors=errors)
    page.write(tmp_path / "report.html")
    scene = scene_in((tmp_path / "report.html").read_text(encoding="utf-8"))
    (told,) = scene["surfaces"]
    keyframes = dense.submap.keyframes
    assert [pose["name"] for pose in told["poses"]] == [k.name for k in keyframes]
    assert np.allclose([pose["center"] for pose in told["poses"]], [k.center for k in keyframes])
    assert np.allclose([pose["axes"] for pose in told["poses"]], [k.cam_from_map[:3, :3] for k in keyframes], atol=1e-6)
    judged, inlier = dense.judged_points()
    counts = {cloud["title"]: len(places(cloud["points"])) for cloud in told["clouds"]}
    assert counts["Points used"] == (judged & inlier).sum() > 0
    assert counts["Points found wrong"] == (judged & ~inlier).sum() > 0
    titles = [layer["title"] for layer in told["layers"]]
    assert titles == ["Of the images", "Shape alone", "Confidence", "How well seen", "Error"]
    assert [picture["name"] for picture in scene["pictures"]] == [k.name for k in keyframes]
    shown = ("image", "distance", "residual")
    assert all(unpacked(p[kind])[:2].tolist() == [0xFF, 0xD8] for p in scene["pictures"] for kind in shown)
    assert not any("uncertainty" in p for p in scene["pictures"]) and scene["kinds"] == said()  # truth is never unsure


def test_joined_surfaces_come_first_and_submaps_that_are_in_none_after_them(made):
    (result, _), empty = made, DenseMap.empty(made[0].dense.submap, "nothing")

    def numbered(number: int, dense: DenseMap = result.dense) -> SubmapResult:
        return replace(result, dense=replace(dense, submap=replace(dense.submap, id=number)))

    merged = SimpleNamespace(results=[numbered(0), numbered(1, empty)], groups=[{2: None, 0: None}, {3: None, 4: None}])
    found = Scene.of(_surfaces([numbered(i) for i in range(5)], merged, []))
    assert [s.title for s in found.surfaces] == ["joined_000: maps 0, 2 as one", "map 1", "map 3", "map 4"]
    assert Scene.of(_surfaces([numbered(0, empty)], None, [])) is None


def test_a_report_with_a_scene_refers_to_nothing_outside_fits_a_phone_and_has_words_for_its_pictures(made, tmp_path):
    result, gallery = made
    (tmp_path / "map_000").mkdir()
    for name in ("mesh.ply", "keyframes.csv"):
        (tmp_path / "map_000" / name).write_text("")
    page = densify_page("Maps", [result], gallery, ["a note"])
    page.files(tmp_path, FILES)
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    without = re.sub(r'src="data:image/(png|jpeg|webp);base64,[^"]+"', "", text)
    assert not re.search(r"//|url\(|@import|\bimport\b|\beval\b|\bfetch\b|<link|<iframe|\ssrc=", without)
    links = re.findall(r'href="([^"]+)"', text)
    assert links == ["map_000/mesh.ply", "map_000/keyframes.csv", "config.yaml", "log.txt", "run.json"]
    assert "MeshLab, CloudCompare and Blender" in text
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in text
    assert "prefers-color-scheme: dark" in text and "default-src 'none'" in text and text.count("<main>") == 1
    assert all(re.search(r'alt="[^"]{10,}"', image) for image in re.findall("<img[^>]*>", text))
    assert '<figure class="scene-still"><img alt=' in text and "<noscript>" in text
    assert len(text) < 15e6 / 5  # of four frames


def test_a_report_that_is_made_twice_is_the_same_to_the_byte(made, tmp_path):
    result, gallery = made
    scene = replace(Scene.of([surface_of("map 0", result.dense)], gallery.thumbnails.found), most=1500)
    assert len(result.dense.triangles) > 2 * 1500
    assert scene.text() == scene.text() != replace(scene, most=1400).text()


def test_a_mesh_is_thinned_for_show_to_the_number_that_was_asked_for_and_keeps_its_shape():
    vertices, triangles = grid(101)
    for given in (vertices, vertices + 1e6):
        fewer, corners, rows = thinned(given, triangles, 3000)
        assert 2900 <= len(corners) <= 3000 and corners.max() == len(fewer) - 1
        u, v, w = (fewer - given[0]).T
        assert np.abs(w - 3 * np.sin(u / 7) * np.cos(v / 9)).max() < 0.25
        assert np.linalg.norm(given[rows] - fewer, axis=1).max() < 0.75
    kept = thinned(vertices, triangles, len(triangles))
    assert kept[0] is vertices and kept[1] is triangles and (kept[2] == np.arange(len(vertices))).all()


def test_a_mesh_far_too_large_is_thinned_in_two_steps_without_a_hole():
    vertices, triangles = grid(200)
    fewer, corners, _ = thinned(vertices, triangles, 2000)
    a, b, c = (fewer[corners[:, k], :2] for k in range(3))
    flat = np.abs(np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2]).sum() / 2
    assert 1900 <= len(corners) <= 2000 and (np.ptp(fewer, axis=0)[:2] > 0.97 * 199).all()
    assert flat == pytest.approx(np.prod(np.ptp(fewer, axis=0)[:2]), rel=0.01)


def test_names_of_files_end_no_element_of_the_page_and_names_of_inputs_change_no_number(tmp_path):
    vertices, triangles = grid(3)
    evil = "</script><b>\u202eabc"
    layers = (Layer("Plain", None, np.zeros((1, 3), np.uint8)),)
    rng = np.random.default_rng(0)
    cloud = Cloud("Points used", rng.uniform(size=(9000, 3)), (0, 0, 0))
    surface = Surface("map 0", vertices, triangles, layers, (cloud,), (Pose(evil, np.eye(4)),))
    page = Report("x")
    page.scene(Scene((surface,), PIXEL))
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert text.count("</script>") == 2 and "\u202e" not in text and "<b>" not in text
    before = scene_in(text)["surfaces"][0]
    assert before["poses"][0]["name"].startswith("</script><b>")
    strange = [tmp_path / name for name in ("canvas", "WebGL", "uint16", "Xy7", before["clouds"][0]["title"], "Smith")]
    for path in strange:
        path.mkdir()
    names = names_of({f"option{i}": path for i, path in enumerate(strange)}, (tmp_path / "run", tmp_path))
    page.text("Smith was here")
    page.write(tmp_path / "report.html")
    names.hide_below(tmp_path)
    after = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Smith" not in after
    for name in DRAWING:
        assert files("lightdepth.reporting").joinpath(name).read_text(encoding="utf-8") in after
    (told,) = scene_in(after)["surfaces"]
    assert told["vertices"] == before["vertices"] and told["clouds"][0]["points"] == before["clouds"][0]["points"]


def test_pictures_of_keyframes_are_spread_over_all_maps_and_no_more_than_a_page_can_hold():
    def of(number: int) -> SimpleNamespace:
        return SimpleNamespace(keyframes=[SimpleNamespace(name=f"{number}_{k}") for k in range(40)])

    chosen = Thumbnails(SimpleNamespace(submaps=[of(0), of(1)]))._chosen
    assert len(chosen) == PICTURES and {"0_0", "1_39"} <= chosen
    assert sum(name.startswith("0") for name in chosen) == PICTURES // 2


def test_of_many_points_some_are_shown_and_that_is_said():
    vertices, triangles = grid(3)
    cloud = Cloud("Points used", np.zeros((1000, 3)), (0, 0, 0))
    scene = Scene((Surface("map 0", vertices, triangles, (), (cloud,)),), PIXEL, most_points=300)
    (told,) = json.loads(scene.text())["surfaces"]
    assert told["points_of"] == 4 and len(places(told["clouds"][0]["points"])) == 250
