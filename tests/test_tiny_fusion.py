"""Views of a few pixels and volumes of a few blocks, each compared with what plain NumPy makes of the same words."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from raising import refused
from test_fusion import by_hand, shifted
from volumes import on_both, sums, sums_at

from densify.fusion.marching_cubes import CORNERS, REACH, packed, unpacked
from densify.fusion.patches import BlockSurface, joined
from densify.fusion.rectify import FULL, RectifyConfig, SurfaceView, _lens, _table, light_weight, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from lightdepth.camera import CameraModel, KannalaBrandt, Pinhole
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, Submap, typical_distance

CAMERA = Pinhole(14, 11, 14.0, 15.0, 6.2, 5.9)
VOXEL = 0.16
Loops = TsdfVolume
kind = on_both(__name__)


def predicted(distance: np.ndarray, valid: np.ndarray | None = None, camera: CameraModel = CAMERA) -> DepthPrediction:
    known = np.ones(distance.shape, bool) if valid is None else valid
    return DepthPrediction("1", distance.astype(np.float32), known, camera, "closed form")


def slanted(camera: CameraModel = CAMERA) -> np.ndarray:
    """The distance (H, W) to a plane that is seen at a slant."""
    found: np.ndarray = 2.0 / (camera.rays()[0] @ np.array([0.25, -0.35, 0.9]))
    return found


def colours(camera: CameraModel = CAMERA) -> np.ndarray:
    return np.random.default_rng(3).uniform(0.1, 0.9, (camera.height, camera.width, 3)).astype(np.float32)


@cache
def looks() -> list[tuple[SurfaceView, np.ndarray]]:
    """Two views of about the same wall, and their poses; of the second, some pixels know nothing."""
    turned = shifted(0.3, -0.2, 0.1)
    turned[:3, :3] = np.linalg.qr(np.array([[1, 0.2, -0.1], [-0.2, 1, 0.15], [0.1, -0.15, 1.0]]))[0]
    turned[:3, :3] *= np.sign(np.diag(turned[:3, :3]))
    known = np.random.default_rng(0).random((11, 14)) < 0.9
    return [
        (surface_view(predicted(slanted()), colours(), RectifyConfig(feather=0.0)), np.eye(4)),
        (surface_view(predicted(slanted() + 0.05, known), 1 - colours(), RectifyConfig(feather=0.0)), turned),
    ]


def fused(count: int = 2, **config) -> TsdfVolume:
    volume = TsdfVolume(VOXEL, FusionConfig(**config))
    for view, pose in looks()[:count]:
        volume.integrate(view, pose)
    return volume


# Blocks


def blocks_of(view: SurfaceView, pose: np.ndarray) -> np.ndarray:
    """Packed places of the blocks that every fourth known pixel, the ends of its ray's truncation, and its two sides
    fall into."""
    map_from_cam = np.linalg.inv(pose)
    found = []
    for pixel in np.flatnonzero(view.weights)[::4]:
        point, normal = view.points[:, pixel], view.planes[pixel, :3]
        ray = point / np.linalg.norm(point) * 6 * VOXEL
        for place in (point, point + ray, point - ray, point + 2 * VOXEL * normal, point - 2 * VOXEL * normal):
            found.append(np.floor((map_from_cam[:3, :3] @ place + map_from_cam[:3, 3]) / (8 * VOXEL)))
    return np.unique(packed(np.array(found)))


@pytest.mark.parametrize("which", [0, 1])
def test_a_view_opens_the_blocks_along_its_rays_and_holds_those_it_says_something_of(which):
    view, pose = looks()[which]
    volume = TsdfVolume(VOXEL, FusionConfig())
    changed = volume.integrate(view, pose)
    opened = blocks_of(view, pose)
    said = by_hand(view, pose, VOXEL, unpacked(opened))["seen"].any(1)
    assert np.array_equal(volume.places, opened[said]) and len(volume.places) > 5
    assert np.isin(opened, changed).all()
    for name, expected in by_hand(view, pose, VOXEL, unpacked(volume.places)).items():
        off = np.abs(sums(volume)[name] - expected)
        assert off.max() <= (1 if name != "distance" else 4 * FULL) and (off > 0).mean() < 2e-3, name
    signs = np.packbits(sums(volume)["weight"] > 0, axis=1, bitorder="little")
    assert np.array_equal(sums(volume)["known"], signs)


def test_sums_of_two_views_are_the_sums_of_their_sums_and_one_taken_out_leaves_the_other():
    both = fused()
    parts = [TsdfVolume(VOXEL, FusionConfig()) for _ in looks()]
    for part, look in zip(parts, looks(), strict=True):
        part.integrate(*look)
    together: dict[str, dict[int, np.ndarray]] = {"weight": {}, "distance": {}, "seen": {}, "color": {}}
    for part in parts:
        for name, values in together.items():
            for code, value in zip(part.places.tolist(), sums(part)[name], strict=True):
                values[code] = values.get(code, 0) + value
    for name, values in together.items():
        assert np.array_equal(sums(both)[name], [values[code] for code in both.places.tolist()]), name
    both.remove(*looks()[0])
    assert np.array_equal(both.places, parts[1].places) and both.views == 1
    assert all(np.array_equal(sums(both)[name], sums(parts[1])[name]) for name in together)
    both.remove(*looks()[1])
    assert both.views == len(both.places) == 0 and len(both.extract_mesh().vertices) == 0


def test_a_voxel_is_known_once_enough_views_have_seen_it():
    volume = fused(min_views=2)
    held = sums(volume)
    assert np.array_equal(held["known"], np.packbits(held["seen"] >= 2, axis=1, bitorder="little"))
    assert 0 < (held["seen"] >= 2).sum() < (held["seen"] >= 1).sum()


def test_a_volume_that_outgrows_its_memory_keeps_what_it_holds_and_who_is_beside_whom():
    volume, places = Loops(VOXEL), np.stack(np.meshgrid(*[np.arange(-4, 4)] * 3), -1).reshape(-1, 3)
    codes = np.random.default_rng(0).permutation(packed(places))
    first = volume._hold(codes[:200])
    volume._weight[first] = np.arange(200)[:, None]
    volume._release(volume._hold(codes[100:120]))
    slots = volume._hold(codes)
    kept = np.r_[0:100, 120:200]
    assert np.array_equal(slots[kept], first[kept]) and np.array_equal(volume._weight[slots[kept], 7], kept)
    assert len(np.unique(slots)) == 512 and np.array_equal(volume._codes[slots], codes) and (slots >= 0).all()
    assert np.array_equal(volume.places, np.sort(codes)) and np.array_equal(volume.slots(codes), slots)
    volume._release(volume.slots(codes[:64]))
    left = volume.places
    assert np.array_equal(left, np.sort(codes[64:])) and (volume.slots(codes[:64]) == -1).all()
    at = volume.slots(left)
    for corner, step in enumerate(CORNERS):
        assert np.array_equal(volume._above[at, corner], volume.slots(packed(unpacked(left) + step)))
        assert np.array_equal(volume._below[at, corner], volume.slots(packed(unpacked(left) - step)))


def test_a_view_that_knows_nothing_changes_nothing_and_no_volume_is_too_fine():
    volume, blind = (
        TsdfVolume(VOXEL),
        surface_view(predicted(slanted(), np.zeros((11, 14), bool)), colours(), RectifyConfig()),
    )
    assert volume.integrate(blind, np.eye(4)).shape == (0,) and volume.views == 0
    assert Loops(VOXEL)._touched(blind, np.eye(4)).shape == (0, 3) and not len(volume.places)
    mesh = volume.extract_mesh()
    assert mesh.vertices.shape == mesh.triangles.shape == (0, 3)
    for voxel in (0.0, -1.0, np.nan, np.inf):
        with refused(where="voxel size", found=f"{voxel}"):
            TsdfVolume(voxel)
    view = looks()[0][0]
    with refused(where="voxel size", found="blocks of 8 voxels"):
        TsdfVolume(0.0003).integrate(view, np.eye(4))
    far = shifted(VOXEL * (REACH - 10))
    with refused(where="voxel size", found="voxels from the map's origin"):
        TsdfVolume(VOXEL).integrate(view, far)
    assert len(TsdfVolume(VOXEL).integrate(view, shifted(VOXEL * (REACH - 400))))


def test_a_voxel_s_size_is_the_one_given_or_a_share_of_the_submap_s_typical_distance():
    points = np.array([[0, 0, 5.0], [0, 1, 7], [1, 0, 9]])
    keyframe = Keyframe("000001.png", CAMERA, np.eye(4), np.full((3, 2), 5.0), np.arange(3))
    submap = Submap(0, (keyframe,), np.arange(3), points)
    typical = typical_distance(submap)
    assert FusionConfig().voxel_for(submap) == pytest.approx(typical / 52) and 5 < typical < 9.2
    assert FusionConfig(voxels_per_distance=10).voxel_for(submap) == pytest.approx(typical / 10)
    assert FusionConfig(voxel=0.5).voxel_for(submap) == 0.5


# The surface


def test_vertices_lie_on_the_wall_with_the_colours_weights_and_views_of_the_voxels_beside_them():
    volume = fused(1)
    mesh = volume.extract_mesh()
    off = mesh.vertices @ np.array([0.25, -0.35, 0.9]) - 2.0
    assert len(mesh.vertices) > 50 and np.abs(off).max() < 0.02 * VOXEL and mesh.views.tolist() == [1] * len(off)
    found = volume.cut(volume.slots(volume.places))
    order = np.argsort(found.names)
    names, first = np.unique(found.names, return_index=True)
    assert len(names) == len(mesh.vertices) and len(order) > len(first)
    near, far, share = found.near[first], found.far[first], found.share[first]
    one, two = (sums_at(volume, "weight", voxels) for voxels in (near, far))
    np.testing.assert_allclose(mesh.weights, (one * (1 - share) + two * share) / 255)
    one, two = (sums_at(volume, "color", voxels) for voxels in (near, far))
    mean = one * (1 - share)[:, None] + two * share[:, None]
    np.testing.assert_allclose(mesh.colors, mean[:, :3] / mean[:, 3:] / 255, atol=1e-6)
    assert mesh.colors.min() > 0.05 and mesh.colors.max() < 0.95


def test_patches_hold_the_mesh_whatever_was_renewed_before():
    volume, surface = TsdfVolume(VOXEL, FusionConfig()), BlockSurface()
    assert not len(surface.renewed) and not len(surface.places)
    for view, pose in looks():
        surface.renew(volume, volume.integrate(view, pose))
    vertices, triangles, colors = joined(surface.patches.values())
    mesh = volume.extract_mesh()
    order, other = np.lexsort(vertices.round(5).T), np.lexsort(mesh.vertices.round(5).T)
    np.testing.assert_allclose(vertices[order], mesh.vertices[other], atol=1e-5)
    np.testing.assert_allclose(colors[order], mesh.colors[other], atol=0.51 / 255)
    ranks, others = np.argsort(order), np.argsort(other)
    assert {tuple(t) for t in ranks[triangles].tolist()} == {tuple(t) for t in others[mesh.triangles].tolist()}
    assert np.array_equal(np.sort(surface.places), [c for c in volume.places if c in surface.patches])
    for view, pose in looks():
        surface.renew(volume, volume.remove(view, pose))
    assert not surface.patches


def test_no_patches_together_are_an_empty_mesh():
    vertices, triangles, colors = joined([])
    assert vertices.shape == triangles.shape == colors.shape == (0, 3) and triangles.dtype.kind == "i"


# Views


def planes_by_hand(distance: np.ndarray, valid: np.ndarray, camera: CameraModel, max_slope: float = 10.0):
    """Normals (H, W, 3) away from the camera, and which pixels are beside an edge: by differences to both sides."""
    rays = camera.rays()[0]
    points, shape = rays * distance[..., None], distance.shape
    normals, edge = np.zeros(points.shape), np.zeros(shape, bool)
    for row, column in np.ndindex(*shape):
        along = []
        for step in ((0, 1), (1, 0)):
            total = np.zeros(3)
            for way in (-1, 1):
                r, c = row + way * step[0], column + way * step[1]
                if not (0 <= r < shape[0] and 0 <= c < shape[1] and valid[r, c]):
                    continue
                gap = np.linalg.norm(rays[r, c] - rays[row, column])
                least = min(distance[r, c], distance[row, column])
                if abs(distance[r, c] - distance[row, column]) > max_slope * gap * least:
                    edge[row, column] = True
                else:
                    total += way * (points[r, c] - points[row, column])
            along.append(total)
        normal = np.cross(*along)
        size = np.linalg.norm(normal)
        normals[row, column] = normal / size if size > 0 else rays[row, column]
    return normals, edge


def bumpy(camera: CameraModel = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """A wavy wall with a step in it, (H, W), and which of its pixels are known: at some, none beside them is."""
    v, u = np.mgrid[: camera.height, : camera.width]
    distance = 3 + 0.2 * np.sin(u) + 0.15 * np.cos(1.3 * v) + 6.0 * (u > 9)
    valid = np.random.default_rng(5).random(distance.shape) < 0.85
    valid[0, :4], valid[1, :4], valid[0, 1] = False, False, True
    return distance, valid


@pytest.mark.parametrize("way_round", [False, True])
def test_the_plane_of_a_pixel_is_that_through_it_and_its_neighbours_and_weighs_its_slant(way_round):
    distance, valid = bumpy()
    image, camera = colours(), CAMERA
    if way_round:  # rows for columns
        distance, valid, image = distance.T, valid.T, image.transpose(1, 0, 2)
        camera = Pinhole(11, 14, 15.0, 14.0, 5.9, 6.2)
    view = surface_view(predicted(distance, valid, camera), image, RectifyConfig(feather=0.0))
    normals, edge = planes_by_hand(distance, valid, camera)
    rays, known = camera.rays()[0], valid & ~edge
    shape = distance.shape
    planes = view.planes[:-1].reshape(*shape, 4)
    assert 20 < known.sum() < valid.sum() and (edge & valid).any()
    np.testing.assert_allclose(planes[known][:, :3], normals[known], atol=2e-3)
    through = (normals * rays).sum(-1) * distance
    np.testing.assert_allclose(planes[known][:, 3], through[known], rtol=2e-3)
    weight = np.clip(np.rint(255 * (normals * rays).sum(-1)), 1, 255) * known
    assert np.abs(view.weights[:-1].reshape(shape).astype(int) - weight).max() <= 1
    assert np.array_equal(view.weights[:-1].reshape(shape) > 0, known)
    np.testing.assert_allclose(view.colors[:-1, :3].reshape(*shape, 3), image * 255, atol=0.51)
    np.testing.assert_allclose(
        view.points[:, :-1].T.reshape(*shape, 3)[known], (rays * distance[..., None])[known], rtol=1e-5
    )
    assert (view.colors[:, 3] == 1).all() and not view.weights[-1] and not view.planes[-1].any()


def test_a_finer_image_is_averaged_in_whole_squares_over_what_is_known():
    """Of 5 x 4 pixels at twice the resolution that is fused: the last column of squares is half a square wide."""
    camera = Pinhole(5, 4, 30.0, 30.0, 2.4, 2.1)
    rng = np.random.default_rng(0)
    distance, image = 3 + 0.01 * rng.random((4, 5)), rng.uniform(0.2, 0.8, (4, 5, 3)).astype(np.float32)
    valid = np.ones((4, 5), bool)
    valid[0, 0] = valid[2:, 4] = valid[2, 2:4] = valid[3, 2] = False  # three, none and one of a square are left
    view = surface_view(predicted(distance, valid, camera), image, RectifyConfig(focal_px=15.0, feather=0.0))
    points = camera.rays()[0] * distance[..., None]
    for k, (rows, columns) in enumerate(
        (np.s_[2 * r : 2 * r + 2], np.s_[2 * c : 2 * c + 2]) for r, c in np.ndindex(2, 3)
    ):
        part = valid[rows, columns]
        if not part.any():
            assert view.weights[k] == 0
            continue
        np.testing.assert_allclose(view.points[:, k], points[rows, columns][part].mean(0), rtol=1e-5)
        np.testing.assert_allclose(view.colors[k, :3], 255 * image[rows, columns][part].mean(0), atol=0.51)
        assert view.weights[k] > 200
    assert len(view.weights) == 7


def test_directions_find_the_pixel_that_they_fall_into_and_none_outside_the_image():
    view = looks()[0][0]
    u, v = np.meshgrid((np.arange(14 * 4) + 0.5) / 4, (np.arange(11 * 4) + 0.5) / 4)
    places = np.stack([u, v], -1).reshape(-1, 2)
    inner = (np.abs(places - places.round()) > 0.2).all(1)  # not within a cell of the next pixel
    rays = CAMERA.unproject(places)[0].astype(np.float32)
    found = view.table.look_up(rays * np.float32(0.3), np.zeros((3, 1), np.float32))[:, 0]
    expected = places[:, 1].astype(int) * 14 + places[:, 0].astype(int)
    assert (found[inner] == expected[inner]).mean() > 0.97 and inner.sum() > 200
    ahead, centred = np.array([[0, 0, 2.0]], np.float32), _table(Pinhole(14, 11, 14.0, 15.0, 6.5, 5.5), 1)
    assert centred.look_up(ahead, np.zeros((3, 1), np.float32)).tolist() == [[5 * 14 + 6]]
    outside = CAMERA.unproject(np.array([[-1.0, 5], [15, 5], [7, -1], [7, 12], [-40, 5], [7, 60]]))[0]
    away = np.concatenate([outside, -rays[:4], [[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]]).astype(np.float32)
    lost = view.table.look_up(away[:, :] * np.float32(7), np.zeros((3, 1), np.float32))
    assert (lost == view.table.outside).all() and view.table.outside == 14 * 11


WIDE = KannalaBrandt(31, 23, 9.0, 9.5, 15.2, 11.8, 0.02, -0.01, 0.0, 0.0)


@pytest.mark.parametrize("merged", [1, 3])
@pytest.mark.parametrize("camera", [CAMERA, WIDE, WIDE.cropped(9, 7, 20, 14)])
def test_every_cell_of_the_table_has_the_pixel_that_its_middle_is_seen_in(camera, merged):
    table = _table(camera, merged)
    size = len(table.cells)
    width, height = -(-camera.width // merged), -(-camera.height // merged)
    place = (np.arange(size) + 0.5 - size / 2) / table.scale
    p, q = np.meshgrid(place, place)
    pixels, seen = camera.project(np.stack([2 * p, 2 * q, 1 - p * p - q * q], -1))
    column, row = np.minimum(pixels // merged, (width - 1, height - 1)).astype(int).transpose(2, 0, 1)
    expected = np.where(seen, row * width + column, width * height)
    assert table.outside == width * height and size % 4 == 0 and table.cells.max() == table.outside
    assert ((table.cells == table.outside) == ~seen).all()
    assert (table.cells == expected).mean() > 0.99
    assert len(np.unique(table.cells[seen])) >= 0.95 * len(np.unique(expected[seen]))
    border = np.concatenate([seen[[0, -1]].ravel(), seen[:, [0, -1]].ravel()])
    assert not border.any()


@pytest.mark.parametrize("camera", [CAMERA, WIDE])
def test_a_lens_on_merged_pixels_has_their_rays_and_the_angles_between_them(camera):
    lens = _lens(camera, 2)
    u, v = np.meshgrid(np.arange(1, camera.width + 1, 2), np.arange(1, camera.height + 1, 2))
    rays = camera.unproject(np.stack([u, v], -1) * 1.0)[0]
    np.testing.assert_allclose(lens.rays, np.moveaxis(rays, -1, 0), atol=1e-6)
    for found, axis in zip(lens.gaps, (1, 0), strict=True):
        np.testing.assert_allclose(found, np.linalg.norm(np.diff(rays, axis=axis), axis=-1), atol=1e-6)


@pytest.mark.parametrize(
    "camera", [CAMERA, Pinhole(14, 11, 14.0, 40.0, 6.2, 5.9), Pinhole(14, 11, 40.0, 14.0, 6.2, 5.9)]
)
def test_cells_of_directions_are_six_tenths_of_the_least_way_between_pixels(camera):
    table = _table(camera, 1)
    rays = camera.rays()[0]
    place = rays[..., :2] / (1 + rays[..., 2:])
    ways = [np.linalg.norm(np.diff(place, axis=axis), axis=-1).min() for axis in (0, 1)]
    assert 0.57 < 1 / table.scale / min(ways) < 0.6
    assert (
        np.abs(place).max() + 0.4 * min(ways) < len(table.cells) / table.scale / 2 < np.abs(place).max() + 2 * max(ways)
    )


def test_of_a_fisheye_a_pinhole_field_keeps_what_an_undistorted_image_of_its_size_would_hold():
    fisheye = KannalaBrandt(30, 22, 12.0, 12.5, 16.0, 10.0, 0.01, 0.0, 0.0, 0.0)
    rays = fisheye.rays()[0]
    place = np.sqrt(12 * 12.5) * rays[..., :2] / rays[..., 2:] + (16, 10)
    kept = (rays[..., 2] > 0) & (place >= 0).all(-1) & (place[..., 0] <= 30) & (place[..., 1] <= 22)
    distance, config = np.full((22, 30), 3.0), RectifyConfig(field="pinhole", max_slope=100)
    view = surface_view(predicted(distance, fisheye.rays()[1], fisheye), colours(fisheye), config)
    assert np.array_equal(view.weights[:-1].reshape(22, 30) > 0, kept) and 50 < kept.sum() < 600
    assert (
        surface_view(predicted(slanted()), colours(), RectifyConfig(field="pinhole", feather=0.0)).weights[:-1] > 0
    ).all()
    with refused(where="field"):
        RectifyConfig(field="fisheye")


@pytest.mark.parametrize("channel", range(3))
def test_dark_and_bright_pixels_weigh_less_and_unsure_ones_by_their_sigma(channel):
    config = RectifyConfig(dark=0.1, bright=0.8, unlit=0.4, sigma=0.2, feather=0.0)
    value = np.array([0.0, 0.05, 0.1, 0.5, 0.8, 0.9, 1.0, 1.3])
    np.testing.assert_allclose(light_weight(value, config), [0.4, 0.7, 1, 1, 1, 0.7, 0.4, 0.4])
    image = np.full((11, 14, 3), 0.2, np.float32)
    image[:, 7:, channel] = 0.9  # the brightest channel counts
    sigma = np.full((11, 14), 0.2, np.float32)
    sigma[6:] = 0.0
    facing = 2.0 / CAMERA.rays()[0][..., 2]
    weights = surface_view(replace(predicted(facing), uncertainty=sigma), image, config).weights[:-1].reshape(11, 14)
    lit = np.where(np.arange(14) < 7, 1.0, 0.7) / np.where(np.arange(11) < 6, 2.0, 1.0)[:, None]
    np.testing.assert_allclose(weights, 255 * lit * CAMERA.rays()[0][..., 2], atol=1.01)


def test_a_view_is_in_single_precision_and_so_is_the_lens_that_is_kept_for_the_next():
    view, rays = looks()[1][0], _lens(CAMERA, 1).rays
    assert [a.dtype for a in (rays, view.points, view.planes)] == [np.float32] * 3
    assert [a.dtype for a in (view.weights, view.colors, view.table.cells)] == [np.uint8, np.uint8, np.int32]
    assert all(a.flags.c_contiguous for a in (rays, view.points, view.planes, view.weights, view.colors))


def test_averaged_pixels_end_with_those_whose_points_are_beyond_the_given_distance():
    fine = Pinhole(28, 22, 28.0, 30.0, 12.4, 11.8)
    facing, config = 2.0 / fine.rays()[0][..., 2], RectifyConfig(focal_px=14.5, feather=0.0)
    whole, near = (surface_view(predicted(facing, camera=fine), colours(fine), config, most) for most in (np.inf, 2.1))
    far = np.linalg.norm(whole.points[:, :-1], axis=0) > 2.1
    assert len(far) == 14 * 11 and 20 < far.sum() < 120 and np.array_equal(near.weights[:-1] == 0, far)


def test_beyond_the_given_distance_nothing_is_known_but_bends_the_planes_beside_it_as_it_should():
    facing = 2.0 / CAMERA.rays()[0][..., 2]
    whole = surface_view(predicted(facing), colours(), RectifyConfig())
    near = surface_view(predicted(facing), colours(), RectifyConfig(), 2.1)
    known = facing.ravel().astype(np.float32) <= 2.1
    assert 20 < known.sum() < 150 and np.array_equal(near.weights[:-1] > 0, known)
    np.testing.assert_array_equal(near.planes[:-1][known], whole.planes[:-1][known])
