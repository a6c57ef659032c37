"""What tiny views and patches are made of, looked at from the side that fusion does not look from."""

from __future__ import annotations

import numpy as np
import pytest
from test_fusion import shifted
from test_tiny_fusion import VOXEL, fused, looks

from densify.fusion.marching_cubes import REACH, one_vertex_an_edge, packed, unpacked
from densify.fusion.patches import BlockSurface, joined
from densify.fusion.volume import FusionConfig, TsdfVolume


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
    slots = volume.slots(volume.places)
    inner = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), -1)
    points = (8 * unpacked(volume.places)[:, None] + inner) * VOXEL
    behind = points @ np.array([0.25, -0.35, 0.9]) - 2.0
    known = volume._weight[slots] > 0
    size = np.linalg.norm([0.25, -0.35, 0.9])
    assert behind[known].max() / size < truncation * VOXEL < behind[known].max() / size + 0.6 * VOXEL
    share = volume._distance[slots][known] / volume._weight[slots][known] / 2048
    expected = np.clip(-behind[known] / size / (truncation * VOXEL), -1, 1)
    assert np.abs(share - expected).max() < 2e-3
