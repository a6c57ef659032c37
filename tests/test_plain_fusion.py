"""The paper's undistorted image: what it shows is where the lens saw it."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import BROWN, ENDOMAPPER, slanted_plane

from densify.fusion.plain import undistorted
from lightdepth.camera import CameraModel

NORMAL, HEIGHT = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0]), 12.0


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
