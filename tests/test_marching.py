"""The surface in patches: that of the whole volume, renewed only where it changed."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from colons import colon, slam, truth
from volumes import on_both, sums

from densify.fusion.marching_cubes import CORNERS, packed, unpacked
from densify.fusion.patches import BlockSurface, joined
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from lightdepth.camera import Pinhole
from lightdepth.prediction import DepthPrediction

kind = on_both(__name__)


def whole(volume: TsdfVolume) -> BlockSurface:
    surface = BlockSurface()
    surface.renew(volume, volume.places)
    return surface


def plane(z: float = 20.0, color: float = 0.5, first: int = 0):
    """A view of the plane at depth z; columns before `first` see nothing."""
    camera = Pinhole(120, 90, 100.0, 100.0, 60.0, 45.0)
    valid = np.ones((90, 120), bool)
    valid[:, :first] = False
    distance = (z / camera.rays()[0][..., 2]).astype(np.float32)
    prediction = DepthPrediction("0", distance, valid, camera, "plane")
    return surface_view(prediction, np.full((90, 120, 3), color, np.float32), RectifyConfig())


@cache
def views():
    """Views of four keyframes of a colon, their poses, and a voxel size."""
    frames = colon(0).frames[:4]
    found = slam(frames)
    scale = found.map_from_world[0][0]
    (submap,) = found.map.submaps
    made = [surface_view(truth(f).scaled(scale), f.image, RectifyConfig(), 40 * scale) for f in frames]
    return [(view, k.cam_from_map) for view, k in zip(made, submap.keyframes, strict=True)], 0.9 * scale


@pytest.fixture(scope="module")
def fused(kind) -> TsdfVolume:
    volume = TsdfVolume(views()[1], FusionConfig())
    for view, pose in views()[0]:
        volume.integrate(view, pose)
    return volume


def test_patches_joined_are_the_mesh_of_the_whole_volume(fused):
    vertices, triangles, colors = joined(whole(fused).patches.values())
    mesh = fused.extract_mesh()
    assert len(vertices) == len(mesh.vertices) > 1500 and len(triangles) == len(mesh.triangles)
    order, other = (np.lexsort(v.round(4).T) for v in (vertices / fused.voxel, mesh.vertices / fused.voxel))
    np.testing.assert_allclose(vertices[order], mesh.vertices[other], atol=1e-3 * fused.voxel)
    assert np.abs(colors[order] - mesh.colors[other]).max() < 1.01 / 255
    areas = []
    for points, faces in ((vertices, triangles), (mesh.vertices, mesh.triangles)):
        a, b, c = (points[faces[:, i]] for i in range(3))
        areas.append(np.cross(b - a, c - a).sum(0))
    np.testing.assert_allclose(*areas, rtol=1e-2)  # turned to the same side


def test_no_edge_has_more_than_two_triangles_and_both_turn_alike(fused):
    _, triangles, _ = joined(whole(fused).patches.values())
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert np.unique(np.sort(edges, 1), axis=0, return_counts=True)[1].max() == 2


def test_a_vertex_is_where_the_distance_is_zero_in_the_colour_between():
    volume = TsdfVolume(0.4, FusionConfig())
    volume.integrate(plane(20.1, color=0.25), np.eye(4))
    vertices, triangles, colors = joined(whole(volume).patches.values())
    assert np.abs(vertices[:, 2] - 20.1).max() < 2e-3
    assert np.abs(colors - 0.25).max() < 1.01 / 255
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0).mean() > 0.999  # they face the camera


def test_where_too_few_have_looked_there_is_no_surface():
    volume = TsdfVolume(0.4, FusionConfig(min_views=2))
    volume.integrate(plane(), np.eye(4))
    assert not whole(volume).patches
    volume.integrate(plane(first=60), np.eye(4))
    vertices, _, _ = joined(whole(volume).patches.values())
    assert len(vertices) > 300 and vertices[:, 0].min() > -0.5


def test_a_patch_is_one_piece_of_memory_for_all_that_it_holds(fused):
    for patch in whole(fused).patches.values():
        assert len(patch.data) - (23 * patch.n + 6 * patch.m) in range(8)
        assert [len(a) for a in (patch.vertices, patch.colors, patch.edges, patch.triangles)] == [patch.n] * 3 + [
            patch.m
        ]
        assert patch.triangles.max() == patch.n - 1 and patch.m > 0 and len(np.unique(patch.edges)) == patch.n
        place = unpacked(patch.edges // 3)
        off = patch.vertices / fused.voxel - place
        assert off.min() > -1e-2 and off.max() < 1.01


def equal(one: BlockSurface, other: BlockSurface) -> bool:
    return one.patches.keys() == other.patches.keys() and all(
        np.array_equal(getattr(one.patches[k], name), getattr(other.patches[k], name))
        for k in one.patches
        for name in ("vertices", "triangles", "colors", "edges")
    )


def test_a_surface_renewed_view_by_view_is_the_one_made_at_once():
    volume, surface = TsdfVolume(views()[1], FusionConfig()), BlockSurface()
    for view, pose in views()[0]:
        surface.renew(volume, volume.integrate(view, pose))
        assert equal(surface, whole(volume))
    for view, pose in views()[0]:
        surface.renew(volume, volume.remove(view, pose))
        assert equal(surface, whole(volume))
    assert not surface.patches and not len(volume.places)


def test_only_blocks_beside_a_change_are_made_again():
    volume, surface = TsdfVolume(0.4, FusionConfig()), BlockSurface()
    surface.renew(volume, volume.integrate(plane(), np.eye(4)))
    before = dict(surface.patches)
    surface.renew(volume, volume.integrate(plane(first=105), np.eye(4)))
    touched = {code for code in before if before[code] is not surface.patches.get(code)}
    assert touched and touched <= set(surface.renewed.tolist())
    assert len(touched) < 0.5 * len(before)


def test_the_blocks_below_a_change_are_among_those_that_may_have_changed():
    volume = TsdfVolume(0.4, FusionConfig())
    volume.integrate(plane(), np.eye(4))
    before = distances(volume)
    told = set(volume.integrate(plane(first=105), np.eye(4)).tolist())
    after = distances(volume)
    changed = [code for code in after if not np.array_equal(before.get(code), after[code])]
    below = packed((unpacked(np.array(changed))[:, None] - CORNERS).reshape(-1, 3))
    assert changed and told >= set(below.tolist()) & after.keys() and len(told) < 0.5 * len(after)


def distances(volume: TsdfVolume) -> dict[int, np.ndarray]:
    """Sums of distances of each block, by its packed place."""
    return dict(zip(volume.places.tolist(), sums(volume)["distance"].copy(), strict=True))
