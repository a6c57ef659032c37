"""Pictures of keyframes say what was predicted, how sure that is, and where it misses the map's points."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from colons import colon, sequence, slam, truth
from view_runs import CAMERA, dense_tube, write_run

from densify.aligned import AlignedKeyframe
from densify.alignment import Alignment
from densify.bending import Bend, BendingConfig
from densify.config import DensifyConfig
from densify.dense_map import KeyframeRow, read_dense_map
from densify.page import Gallery, densify_page
from densify.pipeline import SubmapResult, densify
from densify.predictions import SeenKeyframe
from densify.scene import KINDS, surface_of_files
from densify.thumbnails import OFF, Thumbnails, residual_picture, residuals
from densify.viewing.pictures import Pictures
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import SparseMap

PIXELS = np.array([[10.5, 24.5], [32.5, 24.5], [54.5, 24.5]])
IMAGE = np.full((48, 64, 3), 0.5, np.float32)


def aligned(mapped, predicted, scale: float, reason: str = "") -> AlignedKeyframe:
    """A keyframe that observed three points from left to right."""
    observed = ObservedDistances(np.arange(3), np.array(mapped), np.array(predicted), PIXELS, np.zeros((3, 3)))
    keyframe = dense_tube().submap.keyframes[0]
    return AlignedKeyframe(keyframe, Alignment(keyframe.name, scale, 0.1, 3, reason=reason), observed)


def predicted(uncertainty: np.ndarray | None) -> DepthPrediction:
    shape = (CAMERA.height, CAMERA.width)
    valid = np.ones(shape, bool)
    valid[0] = False
    return DepthPrediction("a", np.full(shape, 5, np.float32), valid, CAMERA, "test", uncertainty=uncertainty)


def test_a_point_is_white_where_the_depth_meets_it_red_where_that_is_too_far_and_blue_where_too_near():
    keyframe = aligned([10.0, 10.0, 10.0], [5.0, 5.0 * np.exp(OFF), 5.0 * np.exp(-2 * OFF)], 2.0)
    np.testing.assert_allclose(residuals(keyframe), [0, OFF, -2 * OFF], atol=1e-12)
    picture = residual_picture(keyframe, IMAGE)
    meets, far, near = (picture[round(v * 240 / 64 - 0.5), round(u * 240 / 64 - 0.5)].astype(int) for u, v in PIXELS)
    assert meets.min() > 245
    assert far[0] > 180 > 60 > far[2] and near[2] > 180 > 60 > near[0]
    assert np.ptp(picture[5, 5].astype(int)) == 0 and picture[5, 5, 0] < 100  # the image itself, in dark grey


def test_residuals_are_those_of_the_depth_as_it_was_bent():
    keyframe = aligned([10.0, 10.0, 10.0], [4.0, 5.0, 6.0], 2.0)
    bend = Bend(config := BendingConfig(), np.log(5), np.zeros(0), (CAMERA.width, CAMERA.height))
    count = bend.basis(np.zeros((1, 2)), np.zeros(1)).shape[1]
    bend = Bend(config, np.log(5), np.random.default_rng(0).normal(0, 0.1, count), (CAMERA.width, CAMERA.height))
    keyframe = replace(keyframe, alignment=replace(keyframe.alignment, bend=bend))
    distance = np.zeros((CAMERA.height, CAMERA.width), np.float32) + 5
    distance[24, 10], distance[24, 54] = 4, 6
    delivered = keyframe.alignment.applied(replace(predicted(None), distance=distance)).distance[24, [10, 32, 54]]
    np.testing.assert_allclose(residuals(keyframe), np.log(delivered / 10), atol=1e-3)
    assert np.abs(residuals(keyframe) - np.log(2 * np.array([4, 5, 6]) / 10)).max() > 0.05


@pytest.mark.parametrize("scale", [0.0, -1.0])
def test_a_keyframe_without_a_scale_or_a_point_has_no_residual(scale):
    assert residual_picture(aligned([1.0] * 3, [1.0] * 3, scale, "no"), IMAGE) is None
    keyframe = replace(aligned([1.0] * 3, [1.0] * 3, 1.0), observed=None)
    assert residual_picture(keyframe, IMAGE) is None


def test_every_keyframe_has_a_row_in_the_run_and_some_have_their_pictures_in_the_report(tmp_path):
    frames = colon(0).frames[:4]
    found = slam(frames, maps=1).map
    gallery = Gallery(found)
    gallery.thumbnails = Thumbnails(found, most=2)
    densify(sequence(frames), found, truth, DensifyConfig(), gallery)
    names = [k.name for k in found.submaps[0].keyframes]
    assert list(gallery.thumbnails.found) == [names[0], names[-1]]
    assert all(p.distance and p.residual and p.uncertainty is None for p in gallery.thumbnails.found.values())
    gallery.thumbnails.write(tmp_path)
    pictures = Pictures(None, tmp_path / "keyframes")
    for keyframe in found.submaps[0].keyframes:
        row = pictures.row(keyframe.number)
        assert row.shape[1] == 3 * 240 + 2 * 6 and row[:, :240].std() > 10 and row[:, -240:].std() > 10
        assert row[:, 252:480].max() < 12  # this model predicts no uncertainty
    assert pictures.row(999) is None and Pictures(None).row(0) is None


def test_a_row_that_cannot_be_read_is_no_row_and_a_run_without_images_has_none(tmp_path):
    (tmp_path / "000003.jpg").write_bytes(b"\xff\xd8nothing")
    assert Pictures(None, tmp_path).row(3) is None
    cv2.imwrite(str(tmp_path / "000004.jpg"), np.zeros((10, 732, 3), np.uint8))
    assert Pictures(None, tmp_path).row(4).shape == (10, 732, 3)
    submap = dense_tube().submap
    nothing = Thumbnails(SparseMap((submap,), "test"))
    nothing(AlignedKeyframe(submap.keyframes[0], Alignment("a", reason="no image")), SeenKeyframe(reason="no image"))
    nothing.write(tmp_path / "run")
    assert not (tmp_path / "run").exists() and not nothing.found


def test_how_well_each_vertex_was_seen_is_in_the_mesh_and_a_colour_of_what_is_read_back(tmp_path):
    dense = replace(dense_tube(), expected_error=np.full(len(dense_tube().vertices), 0.1))
    kinds = np.arange(len(dense.vertices)) % 3
    dense.write(tmp_path / "map_000", seen=kinds)
    read = read_dense_map(tmp_path / "map_000")
    rows = [KeyframeRow(k.name) for k in dense.submap.keyframes]
    layers = {layer.title: layer for layer in surface_of_files("map 0", read, rows).layers}
    assert np.array_equal(layers["How well seen"].values, kinds) and "Keyframes that saw it" in layers
    np.testing.assert_allclose(layers["How well seen"].colors()[:3], KINDS, atol=1 / 255)
    run = write_run(tmp_path / "old")  # as an earlier version wrote it
    old = read_dense_map(run / "map_000")
    assert old.seen is None and "How well seen" not in [x.title for x in surface_of_files("map 0", old, rows).layers]
    strange = replace(read, seen=kinds + 7)
    assert "How well seen" not in [x.title for x in surface_of_files("map 0", strange, rows).layers]


def test_of_many_maps_the_largest_alone_have_pictures_in_a_report(tmp_path, monkeypatch):
    """A screening has dozens of them, of half a megabyte each."""
    monkeypatch.setattr("densify.page.PICTURED", 1, raising=False)
    results = [SubmapResult(dense_tube(number)) for number in (0, 1)]
    small = replace(results[1].dense, triangles=results[1].dense.triangles[:2000])
    results[1] = replace(results[1], dense=small)
    page = densify_page("Many", results, Gallery(SparseMap(tuple(r.dense.submap for r in results), "test")), [])
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Surface of map 0 from outside" in text and "Surface of map 1 from outside" not in text
    assert "<h2>Map 1</h2>" in text and "Pictures are of the 1 largest maps" in text
