"""Views in, one surface out: exact depth gives an exact surface."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import cylinder, sphere

from densify.fusion import FusionConfig, TsdfVolume
from densify.rectify import PinholeView, RectifyConfig, pinhole_views
from lightdepth.errors import InputError
from lightdepth.tube import lens

FOCAL, WIDTH, HEIGHT = 100.0, 120, 90


def plane(z: float = 20.0, color: float = 0.5) -> PinholeView:
    matrix = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    depth = np.full((HEIGHT, WIDTH), z, np.float32)
    return PinholeView(depth, np.full((HEIGHT, WIDTH, 3), color, np.float32), matrix, np.eye(4))


def with_depth(view: PinholeView, depth: np.ndarray) -> PinholeView:
    return PinholeView(depth.astype(np.float32), view.color, view.matrix, view.view_from_cam)


def fused(views, poses=None, voxel: float = 0.4, **config):
    volume = TsdfVolume(voxel, FusionConfig(**config))
    for view, pose in zip(views, poses or [np.eye(4)] * len(views), strict=True):
        volume.integrate(view, pose)
    return volume.extract_mesh()


def test_a_plane_is_where_it_was_seen_in_its_colour():
    vertices, triangles, colors = fused([plane(color=0.25)], voxel=0.37)
    assert len(vertices) > 1000 and len(triangles) > 1000
    assert np.abs(vertices[:, 2] - 20).max() < 0.37
    assert (np.abs(colors - 0.25) < 1e-3).all(1).mean() > 0.97  # Open3D darkens one rim: unseen voxels are black
    reach = np.abs(vertices[:, :2]).max(0)
    np.testing.assert_allclose(reach, [20 * WIDTH / 2 / FOCAL, 20 * HEIGHT / 2 / FOCAL], atol=2.0)


def test_the_pose_carries_the_surface_into_the_map():
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # the camera looks along the map's x
    pose[:3, 3] = [0, 0, -5.0]
    vertices, _, _ = fused([plane()], [pose])
    assert np.abs(vertices[:, 0] - 25).max() < 0.4


def test_the_unit_of_the_map_does_not_matter():
    """A map whose distances are thousandths, or thousands, fuses alike."""
    for unit in (1e-3, 1e3):
        vertices, _, _ = fused([with_depth(plane(), plane().depth * unit)], voxel=0.4 * unit)
        assert len(vertices) == pytest.approx(len(fused([plane()])[0]), rel=0.03)
        assert np.abs(vertices[:, 2] / unit - 20).max() < 0.4


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -3.0])
def test_depth_that_is_not_known_does_no_harm(bad):
    depth = plane().depth.copy()
    depth[:, :60] = 0
    expected = fused([with_depth(plane(), depth)])[0]
    depth[:, :60] = bad
    vertices = fused([with_depth(plane(), depth)])[0]
    assert len(vertices) == len(expected) > 500
    assert np.abs(vertices[:, 2] - 20).max() < 0.4


@pytest.mark.parametrize("value", [0.0, np.nan, -1.0])
def test_a_view_without_any_depth_is_no_view(value):
    volume = TsdfVolume(0.4, FusionConfig())
    volume.integrate(with_depth(plane(), np.full((HEIGHT, WIDTH), value)), np.eye(4))
    assert volume.views == 0
    assert [a.shape for a in volume.extract_mesh()] == [(0, 3)] * 3


def test_an_empty_volume_gives_an_empty_mesh():
    vertices, triangles, colors = TsdfVolume(1.0, FusionConfig()).extract_mesh()
    assert vertices.shape == triangles.shape == colors.shape == (0, 3) and triangles.dtype.kind == "i"


def test_what_one_view_saw_is_kept_unless_more_are_wanted():
    left = plane().depth.copy()
    left[:, 70:] = 0
    views = [plane(), with_depth(plane(), left)]
    whole, shared, none = (fused(views, min_views=n)[0] for n in (1, 2, 3))
    assert whole[:, 0].max() > 10 and len(whole) > 1000
    assert shared[:, 0].max() < 4 and 0.4 * len(whole) < len(shared) < 0.8 * len(whole)
    assert len(none) == 0


def test_two_views_that_disagree_meet_in_the_middle():
    vertices, _, _ = fused([plane(20.0), plane(20.6)])
    assert np.median(vertices[:, 2]) == pytest.approx(20.3, abs=0.1)


@pytest.mark.parametrize("name", ["pinhole", "fisheye", "c3vd"])
@pytest.mark.parametrize("scene", [sphere, cylinder], ids=lambda s: s.__name__)
def test_exact_depth_gives_a_surface_good_to_a_small_part_of_a_voxel(scene, name):
    seen = scene(lens(name, 320, 256))
    voxel, far = 0.25, 25.0
    views = list(pinhole_views(seen.prediction(), seen.frame().image, RectifyConfig(), far))
    vertices, triangles, _ = fused(views, voxel=voxel)
    radius = np.linalg.norm(vertices if scene is sphere else vertices[:, :2], axis=1)
    error = np.abs(radius - (10 if scene is sphere else 8)) / voxel
    assert len(triangles) > 5000
    # Seen over the lenses: sphere 0.015 to 0.021, tube 0.045 and 0.047, 0.065 through the pinhole (it sees only afar).
    assert np.median(error) <= (0.08 if name == "pinhole" else 0.06)
    assert np.quantile(error, 0.95) <= 0.6


@pytest.mark.parametrize("voxel", [0.0, -1.0, np.nan, np.inf])
def test_a_voxel_without_size_is_refused(voxel):
    with pytest.raises(InputError, match="expected a positive length in map units"):
        TsdfVolume(voxel, FusionConfig())
