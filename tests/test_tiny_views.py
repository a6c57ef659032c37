"""What tiny views and patches are made of, looked at from the side that fusion does not look from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_fusion import shifted
from test_tiny_fusion import VOXEL, fused, looks, predicted
from volumes import on_both, sums

from densify.fusion.marching_cubes import REACH, one_vertex_an_edge, packed, unpacked
from densify.fusion.patches import BlockSurface, joined
from densify.fusion.posed import block_origins, voxel_offsets
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from lightdepth.camera import Pinhole

kind = on_both(__name__, "test_tiny_fusion")


def test_a_direction_is_that_of_the_sum_of_its_two_parts():
    table, rng = looks()[0][0].table, np.random.default_rng(1)
    origins = (rng.normal(0, 0.3, (12, 3)) + (0, 0, 2)).astype(np.float32)
    offsets = rng.normal(0, 0.4, (3, 20)).astype(np.float32)
    found = table.look_up(origins, offsets)
    whole = (origins[:, None] + offsets.T[None]).reshape(-1, 3)
    assert found.shape == (12, 20) and len(np.unique(found)) > 40
    assert np.array_equal(found.ravel(), table.look_up(whole, np.zeros((3, 1), np.float32))[:, 0])
    # The length of a direction does not matter.
    assert (table.look_up(whole * 5, np.zeros((3, 1), np.float32))[:, 0] == found.ravel()).mean() > 0.99


def test_a_patch_takes_no_more_memory_than_its_numbers():
    volume, surface = fused(), BlockSurface()
    surface.renew(volume, volume.places)
    assert len(surface.patches) > 3
    for patch in surface.patches.values():
        assert 0 <= len(patch.data) - (23 * patch.n + 6 * patch.m) < 8
        assert patch.triangles.max() == patch.n - 1 and np.isfinite(patch.vertices).all()
        assert len(np.unique(patch.edges)) == patch.n == len(patch.colors) == len(patch.vertices)


def test_patches_renewed_one_by_one_are_those_renewed_together():
    volume, whole, parts = fused(), BlockSurface(), BlockSurface()
    whole.renew(volume, volume.places)
    for code in np.random.default_rng(0).permutation(volume.places):
        parts.renew(volume, np.array([code, code]))
        assert parts.renewed.tolist() == [code]
    assert parts.patches == whole.patches and sorted(parts.places) == sorted(whole.places)
    parts.renew(volume, np.zeros(0, np.int64))
    assert parts.patches == whole.patches
    vertices, triangles, _ = joined([])
    assert len(vertices) == len(triangles) == 0


def test_places_keep_their_order_to_the_ends_of_what_has_a_name():
    ends = np.array([-REACH, -1, 0, 1, REACH - 1])
    places = np.stack(np.meshgrid(ends, ends, ends, indexing="ij"), -1).reshape(-1, 3)
    codes = packed(places)
    assert np.array_equal(unpacked(codes), places) and (np.diff(codes) > 0).all() and codes.dtype == np.int64


def test_vertices_of_one_name_are_one_and_triangles_count_them():
    names = np.array([7, 3, 7, 9, 3])
    first, triangles = one_vertex_an_edge(names, np.array([[0, 1, 3], [2, 4, 3]]))
    assert names[first].tolist() == [3, 7, 9] and triangles.tolist() == [[1, 0, 2], [1, 0, 2]]


@pytest.mark.parametrize("truncation", [3.0, 8.0])
def test_the_truncation_is_how_far_behind_the_wall_a_voxel_is_known(truncation):
    view, pose = looks()[0]
    volume = TsdfVolume(VOXEL, FusionConfig(truncation=truncation))
    volume.integrate(view, shifted() @ pose)
    inner = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), -1)
    points = (8 * unpacked(volume.places)[:, None] + inner) * VOXEL
    behind = points @ np.array([0.25, -0.35, 0.9]) - 2.0
    held = sums(volume)
    known = held["weight"] > 0
    size = np.linalg.norm([0.25, -0.35, 0.9])
    assert behind[known].max() / size < truncation * VOXEL < behind[known].max() / size + 0.6 * VOXEL
    share = held["distance"][known] / held["weight"][known] / 2048
    expected = np.clip(-behind[known] / size / (truncation * VOXEL), -1, 1)
    assert np.abs(share - expected).max() < 2e-3


def test_a_square_with_a_step_inside_is_left_out_and_light_and_doubt_are_averaged():
    """Of 2 x 2 pixels, at twice the resolution that is fused: a step of a tenth is still a slope, one to double is an
    edge."""
    camera = Pinhole(12, 8, 30.0, 30.0, 6.0, 4.0)
    distance, image = 3 / camera.rays()[0][..., 2], np.full((8, 12, 3), 0.5, np.float32)
    for column, step in ((2, 1.1), (8, 2.2)):
        distance[:2, column + 1 :] *= step  # inside the square of columns 2 and 3, and of 8 and 9
    image[4:, 0], image[4:, 1], image[6:, 4:6] = 0.0, 0.04, [[[1.0] * 3]]
    sigma = np.zeros((8, 12), np.float32)
    sigma[4:, 8:] = 0.3
    sigma[4:, 9] = 0.0
    given = replace(predicted(distance, camera=camera), uncertainty=sigma)
    view = surface_view(given, image, RectifyConfig(focal_px=15.0, sigma=0.15, feather=0.0))
    weights = view.weights[:-1].reshape(4, 6)
    lens = Pinhole(6, 4, 15.0, 15.0, 3.0, 2.0)
    assert weights[0].tolist()[1] > 0 and weights[0, 4] == 0 and (weights[2:] > 0).all()
    # Dark squares average .02, which is whole; white ones weigh half; doubt averages .15, which halves.
    expected = 255 * lens.rays()[0][..., 2]
    expected[3, 2] /= 2
    expected[2:, 4] /= 2
    rest = np.ones((4, 6), bool)
    rest[:2] = False
    rest[2:, 5] = False
    np.testing.assert_allclose(weights[rest], expected[rest], atol=3)


def test_a_pixel_is_as_fine_as_the_focal_length_asks_for_and_no_finer():
    camera = Pinhole(12, 8, 30.0, 30.0, 6.0, 4.0)
    distance = 3 / camera.rays()[0][..., 2]
    image = np.full((8, 12, 3), 0.5, np.float32)
    for focal, count in ((31.0, 96), (30.0, 96), (29.8, 96), (29.0, 24), (15.0, 24), (14.0, 12), (7.0, 6)):
        view = surface_view(predicted(distance, camera=camera), image, RectifyConfig(focal_px=focal))
        assert len(view.weights) == count + 1 == view.table.outside + 1


def test_a_merged_square_is_an_edge_where_its_own_pixels_differ_by_more_than_the_slope_allows():
    """Ten per radian over half of 2 / 30 is the largest deviation of the logarithm: a step of 1.9 is not more than
    that, and one of 2.0 is; to the squares beside it either is a slope."""
    camera = Pinhole(12, 4, 30.0, 30.0, 6.0, 2.0)
    image = np.full((4, 12, 3), 0.5, np.float32)
    for step, left_out in ((1.9, False), (2.0, True)):
        distance = 3 / camera.rays()[0][..., 2]
        distance[:, 7:] *= step  # inside the squares of columns 6 and 7
        weights = surface_view(predicted(distance, camera=camera), image, RectifyConfig(focal_px=15.0)).weights
        assert ((weights[:-1].reshape(2, 6) == 0) == [False, False, False, left_out, False, False]).all()


def test_colours_end_at_black_and_at_white():
    image = np.full((8, 12, 3), 0.5, np.float32)
    image[0, 0], image[0, 1], image[0, 2] = -0.3, 1.4, 0.001
    camera = Pinhole(12, 8, 30.0, 30.0, 6.0, 4.0)
    view = surface_view(predicted(3 / camera.rays()[0][..., 2], camera=camera), image, RectifyConfig())
    assert view.colors[:4, 0].tolist() == [0, 255, 0, 128]


def test_places_in_camera_axes_are_added_up_in_one_order_and_rounded_after_each_step():
    """As a library of matrices need not do, which may fuse a product into a sum on one processor and not on another."""
    pose, places = looks()[1][1], np.random.default_rng(0).integers(-900, 900, (200, 3))
    offsets, origins = voxel_offsets(0.37, pose), block_origins(places, 8 * 0.37, pose)
    assert offsets.dtype == origins.dtype == np.float32
    for v, inner in enumerate(np.ndindex(8, 8, 8)):
        x, y, z = (np.float32(n * 0.37) for n in inner)
        rows = pose[:3, :3].astype(np.float32)
        assert [r[0] * x + r[1] * y + r[2] * z for r in rows] == offsets[:, v].tolist(), inner
    for place, origin in zip(places.tolist(), origins, strict=True):
        x, y, z = (n * (8 * 0.37) for n in place)
        assert [np.float32(a * x + b * y + c * z + t) for a, b, c, t in pose[:3].tolist()] == origin.tolist()
