"""The paper's undistorted image: what it shows is where the lens saw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import BROWN, ENDOMAPPER, slanted_plane

from densify.fusion.plain import PlainTsdf, undistorted, undistorted_camera
from lightdepth.camera import Brown, CameraModel, Pinhole

NORMAL, HEIGHT = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0]), 12.0
FOLDING = Brown(135, 108, 80.0, 80.0, 67.0, 54.0, -0.4, 0.0, 0.0, 0.0)  # at 42 degrees, within the image


@pytest.mark.parametrize("camera", [BROWN.resized(135, 108), ENDOMAPPER.resized(144, 108)], ids=lambda c: c.name)
def test_the_undistorted_image_of_a_slanted_plane_has_the_plane_s_depth_and_the_lens_s_colours(camera: CameraModel):
    """Where the colours are the place in the lens's image. Half a pixel beside it, both would be off by half a step."""
    scene = slanted_plane(camera)
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    depth, color, pinhole = undistorted(scene.prediction(), np.stack([u, v, u], -1))
    rays, _ = pinhole.rays()
    known = depth > 0
    assert known.mean() > 0.5
    expected = -HEIGHT / (rays @ NORMAL) * rays[..., 2]
    off = depth[known] / expected[known] - 1
    # Half a pixel of f 75 px is up to half a percent of this plane's depth.
    assert abs(off.mean()) < 2e-4 and np.quantile(np.abs(off), 0.99) < 1e-3
    seen_at, _ = camera.project(rays[known])
    np.testing.assert_allclose(color[known][:, :2], seen_at, atol=0.01)


def test_what_is_beyond_the_greatest_distance_along_its_ray_has_no_depth():
    scene = slanted_plane(BROWN.resized(135, 108))
    whole, _, pinhole = undistorted(scene.prediction(), np.zeros((108, 135, 3)))
    near, _, _ = undistorted(scene.prediction(), np.zeros((108, 135, 3)), max_distance=14.0)
    distance = whole / pinhole.rays()[0][..., 2]
    np.testing.assert_array_equal(near > 0, (whole > 0) & (distance <= 14.0))
    assert 0.1 < (near > 0).sum() / (whole > 0).sum() < 0.9


@pytest.mark.parametrize("camera", [ENDOMAPPER.resized(144, 108), FOLDING], ids=lambda c: c.name)
def test_beside_what_the_model_does_not_know_and_beyond_the_lens_s_field_there_is_no_depth(camera: CameraModel):
    """Neither a mixture of depth and nothing, nor what the middle shows, into which a lens projects beyond its fold."""
    prediction = slanted_plane(camera).prediction()
    valid = prediction.valid.copy()
    valid[24:40, 84:104] = False
    depth, _, pinhole = undistorted(replace(prediction, valid=valid), np.zeros((108, camera.width, 3)))
    rays, _ = pinhole.rays()
    pixels, seen = camera.project(rays)
    known = depth > 0
    np.testing.assert_allclose(depth[known], (-HEIGHT / (rays @ NORMAL) * rays[..., 2])[known], rtol=0.02)
    assert seen[known].all() and 0.5 < known.mean() < 0.98
    column, row = np.floor(pixels[known] - 0.5).astype(int).T  # the first of the four that it lies between
    inner = (column >= 0) & (row >= 0) & (column < camera.width - 1) & (row < 107)
    around = [valid[row[inner] + r, column[inner] + c] for r in (0, 1) for c in (0, 1)]
    assert np.mean(around) > 0.999


def test_the_undistorted_camera_has_the_lens_s_focal_length_and_principal_point():
    lens = ENDOMAPPER.resized(144, 108)
    found = undistorted_camera(lens)
    f = np.sqrt(lens.fx * lens.fy)
    np.testing.assert_allclose(found.params, (f, f, lens.cx, lens.cy))
    assert (found.width, found.height) == (144, 108) and undistorted_camera(found) is found


def test_the_paper_s_volume_has_the_plane_where_it_was_seen_in_its_colour():
    camera, pose = Pinhole(60, 40, 50.0, 50.0, 30.0, 20.0), np.eye(4)
    pose[:3, 3] = 0.5, -0.2, 1.0
    depth, color = np.full((40, 60), 4.0, np.float32), np.full((40, 60, 3), 0.25, np.float32)
    depth[:, 40:] = np.nan
    depth[0, 0] = 6.0
    volume = PlainTsdf(0.1, 6.0)
    assert [len(part) for part in volume.extract_mesh()] == [0, 0, 0]
    volume.integrate(np.full((40, 60), np.nan, np.float32), color, camera, pose)
    assert [part.shape for part in volume.extract_mesh()] == [(0, 3)] * 3  # nothing is known: nothing is seen
    volume.integrate(depth, color, camera, pose)
    vertices, triangles, colors = volume.extract_mesh()
    wall = np.abs(vertices[:, 2] - 3) < 0.02
    assert wall.mean() > 0.9 and len(vertices) > 300 and triangles.max() == len(vertices) - 1
    assert (np.abs(colors - 0.25) < 0.01).mean() > 0.95  # not at the rim
    # Columns 0 to 40 of 60 at depth 4, seen from (-0.5, 0.2, -1).
    np.testing.assert_allclose(vertices[wall].min(0)[:2], (-2.4 - 0.5, -1.6 + 0.2), atol=0.35)
    np.testing.assert_allclose(vertices[wall].max(0)[:2], (0.8 - 0.5, 1.6 + 0.2), atol=0.35)
