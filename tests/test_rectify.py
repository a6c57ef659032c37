"""Distance on any lens as what fusion takes: planes with weights, each direction in one pixel."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from raising import refused
from scenes import Scene, cylinder, slanted_plane, sphere

from densify.fusion.rectify import (
    FULL,
    DirectionTable,
    RectifyConfig,
    SurfaceView,
    _merge,
    light_weight,
    surface_view,
)
from lightdepth.camera import CameraModel, Pinhole
from lightdepth.prediction import DepthPrediction
from lightdepth.tube import lens

PINHOLE = Pinhole(120, 90, 70.0, 72.0, 58.0, 46.0)
FISHEYE = lens("fisheye", 120, 96)
C3VD = lens("c3vd", 100, 80)
LENSES = pytest.mark.parametrize("camera", [PINHOLE, FISHEYE, C3VD], ids=["pinhole", "fisheye", "c3vd"])


STEEP = RectifyConfig(max_slope=20, feather=0.0)


def view_of(prediction: DepthPrediction, config: RectifyConfig = RectifyConfig(), **given) -> SurfaceView:
    camera = prediction.camera
    return surface_view(prediction, np.full((camera.height, camera.width, 3), 0.5, np.float32), config, **given)


def weights(view: SurfaceView, camera: CameraModel) -> np.ndarray:
    return view.weights[:-1].reshape(camera.height, camera.width)


def pixels_of(table: DirectionTable, rays: np.ndarray) -> np.ndarray:
    return table.look_up(rays.astype(np.float32), np.zeros((3, 1), np.float32))[:, 0]


@cache
def directions(camera: CameraModel, count: int = 100_000) -> np.ndarray:
    """Unit rays through places drawn anywhere in the image, (n, 3), with the pixel of each (n,)."""
    places = np.random.default_rng(0).random((count, 2)) * (camera.width, camera.height)
    rays, valid = camera.unproject(places)
    column, row = places[valid].astype(int).T
    return rays[valid], row * camera.width + column


@LENSES
def test_every_valid_pixel_of_any_lens_enters_the_fusion_once(camera):
    prediction = sphere(camera).prediction()
    view = view_of(prediction)
    entered = np.unique(view.table.cells)
    entered = entered[entered != view.table.outside]
    valid = np.flatnonzero(prediction.valid)
    print(f"{camera.name}: {np.isin(valid, entered).mean():.2%} of the valid pixels enter")
    assert np.isin(valid, entered).mean() >= 0.99
    assert (view.weights[valid] > 0).all()


@LENSES
def test_a_direction_finds_its_pixel_or_the_one_beside_it_up_to_the_rim(camera):
    """A cell is half a pixel wide: so nowhere is a direction further off than half a pixel and half a cell."""
    rays, pixel = directions(camera)
    found = pixels_of(view_of(sphere(camera).prediction()).table, rays)
    inside = found != camera.width * camera.height
    assert inside.mean() > 0.995  # but for half a cell around the image
    off = np.abs(np.stack(np.divmod(found[inside], camera.width)) - np.divmod(pixel[inside], camera.width))
    assert off.max() <= 1 and (off.sum(0) == 0).mean() > 0.7


@LENSES
def test_a_direction_outside_the_image_finds_nothing(camera):
    view = view_of(sphere(camera).prediction())
    outside = np.array([[0, 0, -1.0], [0.1, 0, -1], [1, 1, -0.1], [-1, 0.5, -0.2]])
    assert (pixels_of(view.table, outside) == view.table.outside).all()
    assert view.weights[view.table.outside] == 0


def test_rays_beyond_90_degrees_have_their_pixels():
    """A table over directions ends at the back, not at a half space; here for a lens that sees 120 degrees aside."""

    class Wide(type(FISHEYE)):
        def unproject(self, pixels):
            x, y = (np.asarray(pixels, float) / (self.width, self.height) * 2 - 1)[..., 0], pixels[..., 1] * 0
            theta = np.radians(120) * x
            return np.stack([np.sin(theta), y, np.cos(theta)], -1), np.ones(theta.shape, bool)

        def project(self, points):
            theta = np.degrees(np.arctan2(points[..., 0], points[..., 2])) / 120
            side = np.abs(points[..., 1]) < 0.1
            u = (theta + 1) / 2 * self.width
            return np.stack([u, np.full_like(u, 0.5)], -1), (np.abs(theta) < 1) & side

    camera = Wide(60, 1, *FISHEYE.params)
    rays = camera.unproject(np.stack([np.arange(60) + 0.5, np.full(60, 0.5)], -1))[0]
    found = view_of(DepthPrediction("1", np.ones((1, 60), np.float32), np.ones((1, 60), bool), camera, "wide")).table
    assert rays[:, 2].min() < -0.45
    np.testing.assert_array_equal(pixels_of(found, rays), np.arange(60))


@LENSES
def test_the_plane_of_a_pixel_is_that_of_the_scene(camera):
    scene = slanted_plane(camera)
    view = view_of(scene.prediction())
    known = view.weights > 0
    normal = -np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    assert known.sum() > 0.95 * scene.prediction().valid.sum()
    assert np.quantile(np.abs(view.planes[known] - [*normal, 12.0]).max(1), 0.99) < 1e-3


@pytest.mark.parametrize("scene", [sphere, cylinder], ids=lambda s: s.__name__)
def test_normals_point_away_from_the_camera_and_points_lie_on_the_scene(scene):
    seen = scene(FISHEYE)
    view = view_of(seen.prediction())
    known = np.flatnonzero(view.weights)
    normals = -seen.normals[0].reshape(3, -1).numpy()[:, known]
    assert np.median(np.abs(view.planes[known, :3].T - normals).max(0)) < 5e-3
    expected = (seen.rays * seen.distance)[0].reshape(3, -1).numpy()[:, known]
    np.testing.assert_allclose(view.points[:, known], expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose((view.planes[known, :3].T * expected).sum(0), view.planes[known, 3], rtol=1e-4)


def test_colours_go_with_their_pixels():
    image = np.random.default_rng(0).random((90, 120, 3)).astype(np.float32)
    view = surface_view(sphere(PINHOLE).prediction(), image, RectifyConfig())
    np.testing.assert_allclose(view.colors[:-1, :3].reshape(90, 120, 3) / 255, image, atol=2.1e-3)


@LENSES
def test_a_finer_image_is_merged_and_no_pixel_is_lost_by_it(camera):
    fine = camera.resized(3 * camera.width + 1, 3 * camera.height + 2)
    scene = slanted_plane(fine)
    view = view_of(scene.prediction(), RectifyConfig(focal_px=fine.focal_length / 3, max_slope=20))
    assert len(view.weights) == (camera.width + 1) * (camera.height + 1) + 1
    known = view.weights > 0
    normal = -np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    assert np.quantile(np.abs(view.points[:, known].T @ normal - 12), 0.99) < 0.01  # halved at the rim, still on it
    rows, columns = np.nonzero(scene.prediction().valid)
    of_pixel = rows // 3 * (camera.width + 1) + columns // 3
    assert np.isin(of_pixel, view.table.cells).mean() > 0.99 and known[of_pixel].mean() > 0.98


def means_by_numpy(values: np.ndarray, valid: np.ndarray, size: int) -> np.ndarray:
    """Sums of blocks by NumPy alone, along rows and then along columns."""
    total, count = np.where(valid, values, 0).astype(np.float32), valid.astype(np.float32)
    for axis in (0, 1):
        starts = np.arange(0, valid.shape[axis], size)
        total, count = (np.add.reduceat(a, starts, axis) for a in (total, count))
    return total / np.maximum(count, 1)


@pytest.mark.parametrize("size", [2, 3, 5, 8])
@pytest.mark.parametrize("shape", [(57, 83), (64, 64), (3, 100)])
def test_pixels_are_merged_in_the_order_of_numpy_s_sums_to_the_last_bit(size, shape):
    rng = np.random.default_rng(size)
    valid = rng.random(shape) < 0.7
    valid[:size, :size] = False
    colours = rng.random((*shape, 3)).astype(np.float32)
    for values in (rng.normal(size=shape), colours[..., 1], rng.random(shape) < 0.5):
        assert np.array_equal(_merge(values, valid, size), means_by_numpy(values, valid, size))
    assert _merge(colours[..., 1], valid, size)[0, 0] == 0


def test_a_pinhole_field_crops_a_fisheye_and_leaves_a_pinhole_whole():
    def share(camera: CameraModel, field: str) -> float:
        prediction = sphere(camera).prediction()
        view = view_of(prediction, RectifyConfig(field=field))
        return (view.weights > 0).sum() / prediction.valid.sum()

    assert share(FISHEYE, "whole") == 1 and 0.4 < share(FISHEYE, "pinhole") < 0.7
    assert share(PINHOLE, "pinhole") == 1
    rays = FISHEYE.rays()[0]
    kept = weights(view_of(sphere(FISHEYE).prediction(), RectifyConfig(field="pinhole")), FISHEYE) > 0
    assert (rays[kept][:, 0] / rays[kept][:, 2]).max() == pytest.approx(60 / FISHEYE.focal_length, rel=0.05)


def test_a_field_that_is_none_is_refused():

    with refused(where="field", found="'half'"):
        RectifyConfig(field="half")


def test_nothing_beyond_the_given_distance_is_known():
    prediction = cylinder(FISHEYE).prediction()
    near = view_of(prediction, max_distance=20.0)
    known = near.weights > 0
    assert 19 < np.linalg.norm(near.points[:, known], axis=0).max() <= 20.001
    assert not view_of(prediction, max_distance=1.0).weights.any()


def test_what_is_not_valid_is_not_known_and_bends_no_plane_beside_it():
    prediction = sphere(FISHEYE).prediction()
    distance, valid = prediction.distance.copy(), prediction.valid.copy()
    valid[30:50, 50:75] = False
    distance[30:50, 50:75] = np.nan
    holed, whole = view_of(replace(prediction, distance=distance, valid=valid)), view_of(prediction)
    known = holed.weights > 0
    np.testing.assert_array_equal(known[:-1].reshape(valid.shape), valid)
    np.testing.assert_allclose(holed.planes[known], whole.planes[known], atol=1e-2)
    assert np.isfinite(holed.planes).all()
    assert not view_of(replace(prediction, valid=np.zeros_like(valid))).weights.any()


def step(camera: CameraModel, near: float = 10.0, far: float = 16.0) -> DepthPrediction:
    """Two planes that face the camera, the nearer on the left half."""
    rays, valid = camera.rays()
    valid = valid & (rays[..., 2] > 0.5)
    depth = np.where(np.arange(camera.width) < camera.width // 2, near, far)
    distance = np.where(valid, depth / np.where(valid, rays[..., 2], 1), 1).astype(np.float32)
    return DepthPrediction("1", distance, valid, camera, "step")


def test_both_sides_of_an_edge_are_left_out_and_nothing_else():
    weight = weights(view_of(step(PINHOLE)), PINHOLE)
    assert not weight[5:-5, 59:61].any()
    assert (weight[5:-5, 5:59] > 0).all() and (weight[5:-5, 61:-5] > 0).all()
    kept = view_of(step(PINHOLE), RectifyConfig(max_slope=1e9))
    assert (weights(kept, PINHOLE)[5:-5, 5:-5] > 0).all()


def test_an_edge_bends_no_plane_beside_it():
    view = view_of(step(PINHOLE))
    known = view.weights > 0
    np.testing.assert_allclose(view.planes[known, 2], 1, atol=1e-5)


def test_an_edge_is_the_same_edge_at_any_image_size():
    for camera in (PINHOLE.resized(60, 44), PINHOLE, PINHOLE.resized(240, 180)):
        weight = weights(view_of(step(camera), STEEP), camera)
        middle = camera.width // 2
        assert not weight[10:-10, middle - 1 : middle + 1].any()
        gentle = slanted_plane(camera, (1.0, 0.0, -0.2)).prediction()
        assert weights(view_of(gentle, STEEP), camera)[gentle.valid].min() > 0


def test_the_weight_falls_with_the_slant():
    scene: Scene = slanted_plane(PINHOLE, normal=(1.0, 0.0, -0.35))
    cosine = -(scene.normals * scene.rays)[0].sum(0).numpy()
    valid = scene.prediction().valid
    found = weights(view_of(scene.prediction(), STEEP), PINHOLE)
    np.testing.assert_allclose(found[valid], FULL * cosine[valid], atol=1.0)


def test_weights_rise_from_nothing_at_the_border_of_what_the_image_shows_to_full_within_the_feather():
    facing = replace(sphere(PINHOLE).prediction(), valid=np.arange(120)[None] < np.full((90, 1), 100))
    weight = weights(view_of(facing, RectifyConfig(feather=0.2)), PINHOLE) / FULL  # over 18 pixels
    middle = weight[45]
    assert 0 < middle[0] < 0.1 and middle[20:80].min() > 0.99 and 0 < middle[99] < 0.1 and not middle[100:].any()
    assert np.abs(np.diff(middle[:100])).max() < 0.07  # no step
    assert weights(view_of(facing, RectifyConfig(feather=0.0)), PINHOLE)[45, :100].min() > 0.99 * FULL


def test_a_pixel_that_keeps_none_of_its_weight_is_not_fused_and_one_that_keeps_half_weighs_half():
    share = np.repeat(np.float32([[0.0, 0.5, 1.0]]), 40, 1).repeat(90, 0)
    config = RectifyConfig(feather=0.0)
    weight = weights(view_of(sphere(PINHOLE).prediction(), config, share=share), PINHOLE) / FULL
    assert not weight[:, :40].any()
    np.testing.assert_allclose(weight[:, 41:80], 0.5, atol=0.01)
    np.testing.assert_allclose(weight[:, 81:], 1.0, atol=0.01)


def test_a_wall_seen_at_less_than_six_degrees_is_left_out():
    scene: Scene = slanted_plane(PINHOLE, normal=(1.0, 0.0, -0.35))
    cosine = -(scene.normals * scene.rays)[0].sum(0).numpy()
    prediction = scene.prediction()
    kept = weights(view_of(prediction), PINHOLE) > 0
    # log distance per radian is cos / sin of the angle between ray and wall, all of it along u here
    assert not kept[prediction.valid & (cosine < 0.09)].any() and kept[prediction.valid & (cosine > 0.11)].all()


def test_dark_saturated_and_uncertain_pixels_weigh_little_and_are_not_lost():
    prediction = sphere(PINHOLE).prediction()
    image = np.full((90, 120, 3), 0.5, np.float32)
    image[:, :30], image[:, 30:60] = 0.004, (1.0, 0.3, 0.2)
    uncertain = np.full((90, 120), 1e-3, np.float32)
    uncertain[:, 90:] = 0.15
    view = surface_view(replace(prediction, uncertainty=uncertain), image, RectifyConfig(feather=0.0))
    weight = weights(view, PINHOLE) / FULL
    assert weight[:, 60:90].min() > 0.99
    assert weight[:, :30].min() > 0 and weight[:, :30].max() < 0.7
    np.testing.assert_allclose(weight[:, 30:60], 0.5, atol=0.01)
    np.testing.assert_allclose(weight[:, 90:], 0.5, atol=0.01)


def test_the_light_s_weight_is_whole_between_its_limits():
    config = RectifyConfig(dark=0.1, bright=0.9, unlit=0.2, feather=0.0)
    np.testing.assert_allclose(
        light_weight(np.array([0, 0.05, 0.1, 0.5, 0.9, 0.95, 1]), config), [0.2, 0.6, 1, 1, 1, 0.6, 0.2]
    )
