"""Distance on any lens as depth of pinhole views."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import cylinder, slanted_plane, sphere

from densify.fusion import FusionConfig, TsdfVolume
from densify.rectify import PinholeView, RectifyConfig, pinhole_views
from lightdepth.camera import CameraModel, Pinhole
from lightdepth.prediction import DepthPrediction
from lightdepth.tube import lens

PINHOLE = Pinhole(120, 90, 70.0, 72.0, 58.0, 46.0)
FISHEYE = lens("fisheye", 240, 192)
C3VD = lens("c3vd", 200, 160)
KEEP_ALL = RectifyConfig(max_jump=np.inf, min_cosine=-1.0)


def grey(camera: CameraModel) -> np.ndarray:
    return np.full((camera.height, camera.width, 3), 0.5, np.float32)


def views(prediction: DepthPrediction, config: RectifyConfig = RectifyConfig(), **given) -> list[PinholeView]:
    return list(pinhole_views(prediction, grey(prediction.camera), config, **given))


def looked_up(view: PinholeView, rays: np.ndarray) -> np.ndarray:
    """Depth (n,) of the view's pixel that each ray (n, 3) in camera axes falls on, 0 where it falls on none."""
    in_view = rays @ view.view_from_cam[:3, :3].T
    height, width = view.depth.shape
    pixels = in_view @ view.matrix.T
    front = pixels[:, 2] > 1e-9
    column, row = np.floor(pixels[:, :2] / np.where(front, pixels[:, 2], 1)[:, None]).astype(int).T
    inside = front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(inside, view.depth[row.clip(0, height - 1), column.clip(0, width - 1)], 0)


def test_a_pinhole_image_passes_exactly():
    scene = slanted_plane(PINHOLE)
    (view,) = views(scene.prediction())
    distance, rays = scene.distance[0, 0].numpy(), scene.rays[0].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(view.matrix, PINHOLE.matrix)
    np.testing.assert_array_equal(view.view_from_cam, np.eye(4))
    valid = cv2.erode(scene.valid[0, 0].numpy().astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (view.depth[valid] > 0).mean() > 0.99
    known = view.depth > 0
    np.testing.assert_allclose(view.depth[known], (distance * rays[..., 2])[known], rtol=1e-5)


def test_colours_go_with_their_pixels():
    image = np.random.default_rng(0).random((90, 120, 3)).astype(np.float32)
    (view,) = pinhole_views(sphere(PINHOLE).prediction(), image, RectifyConfig())
    np.testing.assert_allclose(view.color, image, atol=2e-2)  # cv2 interpolates in steps of 1/32 pixel


def test_a_pinhole_finer_than_asked_is_reduced():
    camera = PINHOLE.resized(480, 360)
    (view,) = views(sphere(camera).prediction(), RectifyConfig(focal_px=70.0))
    assert view.depth.shape == pytest.approx((90, 120), abs=3)
    known = view.depth > 0
    rays = np.linalg.inv(view.matrix) @ np.array([0.5, 0.5, 1])
    assert known.all() and view.depth[0, 0] == pytest.approx(10 / np.linalg.norm(rays), rel=1e-3)


@pytest.mark.parametrize("camera", [FISHEYE, C3VD], ids=["fisheye", "c3vd"])
def test_every_valid_pixel_s_direction_is_known_in_exactly_one_face(camera):
    scene = sphere(camera)
    faces = views(scene.prediction())
    assert len(faces) == 5
    inner = cv2.erode(np.pad(scene.valid[0, 0].numpy().astype(np.uint8), 1), np.ones((5, 5), np.uint8))[1:-1, 1:-1] > 0
    rays = camera.rays()[0][inner]
    depths = np.stack([looked_up(face, rays) for face in faces])
    count = (depths > 0).sum(0)
    assert (count == 1).mean() >= 0.99
    assert (count > 1).mean() < 1e-3  # rounding, where a direction lies on the seam itself


@pytest.mark.parametrize("camera", [FISHEYE, C3VD], ids=["fisheye", "c3vd"])
@pytest.mark.parametrize("scene", [sphere, cylinder], ids=lambda s: s.__name__)
def test_depth_of_a_face_is_the_distance_of_the_scene_along_its_axis(camera, scene):
    for view in views(scene(camera).prediction(), KEEP_ALL):
        height, width = view.depth.shape
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.matrix).T
        norm = np.linalg.norm(rays, axis=-1)
        in_cam = rays @ view.view_from_cam[:3, :3] / norm[..., None]
        if scene is sphere:
            expected = np.full(norm.shape, 10.0)
        else:
            expected = 8.0 / np.linalg.norm(in_cam[..., :2], axis=-1).clip(min=1e-6)
        known = (view.depth > 0) & (expected < 40)
        assert known.sum() > 500
        np.testing.assert_allclose((view.depth * norm)[known], expected[known], rtol=0.02)


def test_nothing_beyond_the_given_distance_is_known():
    scene = cylinder(FISHEYE)
    near, far = (views(scene.prediction(), max_distance=m) for m in (20.0, np.inf))

    def most(found):
        return max(v.depth.max() for v in found)

    assert most(near) <= 20 < most(far)
    assert views(scene.prediction(), max_distance=1.0) == []


def test_what_is_not_valid_reaches_no_view_and_does_not_leak_into_others():
    prediction = sphere(FISHEYE).prediction()
    distance, valid = prediction.distance.copy(), prediction.valid.copy()
    valid[60:100, 100:150] = False
    distance[60:100, 100:150] = np.nan
    known = np.concatenate([v.depth[v.depth > 0] for v in views(replace(prediction, distance=distance, valid=valid))])
    whole = np.concatenate([v.depth[v.depth > 0] for v in views(prediction)])
    assert np.isfinite(known).all() and 0.9 * len(whole) < len(known) < len(whole)
    assert views(replace(prediction, valid=np.zeros_like(valid))) == []


def step(camera: CameraModel, near: float = 10.0, far: float = 16.0) -> DepthPrediction:
    """Two planes that face the camera, the nearer on the left half."""
    rays, valid = camera.rays()
    valid = valid & (rays[..., 2] > 0.5)
    depth = np.where(np.arange(camera.width) < camera.width // 2, near, far)
    distance = np.where(valid, depth / np.where(valid, rays[..., 2], 1), 1).astype(np.float32)
    return DepthPrediction("1", distance, valid, camera, "step")


def test_both_sides_of_an_edge_are_left_out_and_nothing_else():
    (view,) = views(step(PINHOLE), RectifyConfig(min_cosine=0.0))
    assert not view.depth[5:-5, 59:61].any()
    assert (view.depth[5:-5, 5:58] > 0).all() and (view.depth[5:-5, 62:-5] > 0).all()
    (kept,) = views(step(PINHOLE), KEEP_ALL)
    assert (kept.depth[5:-5, 5:-5] > 0).all()


def test_grazing_pixels_are_left_out():
    scene = slanted_plane(PINHOLE, normal=(1.0, 0.0, -0.35))
    rays = scene.rays[0].permute(1, 2, 0).numpy()
    cosine = -(scene.normals[0].permute(1, 2, 0).numpy() * rays).sum(-1)
    (view,) = views(scene.prediction(), RectifyConfig(min_cosine=0.5, max_jump=np.inf))
    inner = cv2.erode(scene.valid[0, 0].numpy().astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert inner[cosine < 0.48].sum() > 300 and inner[cosine > 0.52].sum() > 300  # or this would prove nothing
    assert not view.depth[cosine < 0.48].any()
    assert (view.depth[inner & (cosine > 0.52)] > 0).mean() > 0.99


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_there_is_no_curtain_between_two_planes(camera):
    def between(config: RectifyConfig) -> float:
        volume = TsdfVolume(0.25, FusionConfig())
        for view in views(step(camera), config):
            volume.integrate(view, np.eye(4))
        z = volume.extract_mesh()[0][:, 2]
        assert ((np.abs(z - 10) < 0.5).sum() > 500) and ((np.abs(z - 16) < 0.5).sum() > 500)
        return float(((z > 11.5) & (z < 14.5)).mean())

    assert between(RectifyConfig()) == 0
