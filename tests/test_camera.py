"""Every lens maps its whole field both ways, and says where the field ends."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from raising import refused
from scenes import BROWN, C3VD, ENDOMAPPER, LENSES, PINHOLE

from lightdepth import native
from lightdepth.camera import (
    CAMERA_MODELS,
    Brown,
    CameraModel,
    FullBrown,
    KannalaBrandt,
    Pinhole,
    Scaramuzza,
    camera_from_params,
)
from lightdepth.camera.provenance import Provenance
from lightdepth.datasets.c3vd import C3VD_V2

# Strong enough for tangential terms to fold the image before radial ones would
STRONG = Brown(640, 480, 400.0, 408.0, 328.0, 236.8, -0.5, 0.12, 0.02, -0.015)
K3 = FullBrown(640, 480, 520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172, 0.0, 0.0, 0.0)
RATIONAL = FullBrown(640, 480, 400.0, 410.0, 322.0, 238.0, 0.3, 0.1, 0.001, 5e-4, 0.02, 0.5, 0.2, 0.01)
WAVY = KannalaBrandt(320, 240, 130.0, 133.0, 162.0, 118.0, 0.05, -0.03, 0.02, 0.03)
ALL = {**LENSES, "wavy fisheye": WAVY, "c3vd v2": C3VD_V2, "strong brown": STRONG, "k3": K3, "rational": RATIONAL}
VARIANTS = {
    "as published": lambda camera: camera,
    "resized": lambda camera: camera.resized(camera.width // 5, camera.height // 5),
    "resized unequally": lambda camera: camera.resized(camera.width // 2, camera.height),
    "cropped about the middle": lambda camera: camera.cropped(camera.width // 2 - 20, camera.height // 2 - 30, 64, 48),
    "cropped near the border": lambda camera: camera.cropped(10, camera.height // 2, 64, 48),
    "first pixel at (0, 0)": lambda camera: camera.with_pixel_center(0.0),
}


@pytest.fixture(params=ALL.values(), ids=ALL.keys())
def lens(request) -> CameraModel:
    return request.param


def pixels_inside(camera: CameraModel, n: int = 4000) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (n, 2)) * (camera.width, camera.height)


def all_around(n: int = 20_000) -> np.ndarray:
    rng = np.random.default_rng(1)
    special = np.array([[0, 0, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [1e-15, 0, 1], [1e-15, 0, -1]], float)
    return np.concatenate([special, rng.normal(size=(n, 3)) * rng.lognormal(0, 3, (n, 1))])


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS.keys())
def test_projecting_a_point_on_the_ray_of_a_pixel_returns_the_pixel(lens, variant):
    camera = variant(lens)
    pixels = pixels_inside(camera)
    rays, valid = camera.unproject(pixels)
    assert valid.mean() > (0.1 if lens is STRONG else 0.8)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)
    distance = np.random.default_rng(2).lognormal(0, 3, (len(pixels), 1))
    projected, seen = camera.project(rays * distance)
    np.testing.assert_array_equal(seen[valid], True)
    np.testing.assert_allclose(projected[valid], pixels[valid], rtol=0, atol=1e-6)


def test_rays_of_points_in_view_are_the_directions_of_the_points(lens):
    points = all_around()
    pixels, seen = lens.project(points)
    rays, valid = lens.unproject(pixels[seen])
    assert seen.sum() > 500
    assert valid.mean() > 0.999
    directions = points[seen] / np.linalg.norm(points[seen], axis=1, keepdims=True)
    np.testing.assert_allclose(rays[valid], directions[valid], atol=1e-8)


def test_rays_are_those_of_the_pixel_centres_and_cannot_be_written(lens):
    camera = lens.resized(16, 12)
    rays, valid = camera.rays()
    assert rays.shape == (12, 16, 3) and valid.shape == (12, 16)
    for row, column in [(0, 0), (3, 7), (11, 15)]:
        ray, ok = camera.unproject(np.array([column + 0.5, row + 0.5]))
        np.testing.assert_allclose(rays[row, column], ray, atol=1e-12)
        assert valid[row, column] == ok
    with pytest.raises(ValueError, match="read-only"):
        rays[0, 0] = 0


def test_everything_is_finite_wherever_one_asks(lens):
    pixels, _ = lens.project(all_around())
    assert np.isfinite(pixels).all()
    far = np.random.default_rng(3).uniform(-5, 6, (5000, 2)) * (lens.width, lens.height)
    rays, _ = lens.unproject(far)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)


def test_points_behind_the_camera_and_pixels_outside_the_image_are_not_seen(lens):
    points = all_around()
    pixels, seen = lens.project(points)
    assert not seen[points[:, 2] <= 0].any()
    inside = (pixels >= 0).all(1) & (pixels <= (lens.width, lens.height)).all(1)
    assert not seen[~inside].any()


def test_every_valid_ray_looks_ahead(lens):
    rays, valid = lens.resized(160, 120).rays()
    assert (rays[valid][:, 2] > 0).all()


def test_kannala_brandt_ends_at_90_degrees_just_before_it_turns_over():
    limit = ENDOMAPPER.max_theta()
    assert limit == pytest.approx(np.pi / 2)
    theta = np.radians([0, 45, 77.7, 89.9, 90.1, 90.6, 100, 135, 180])
    points = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)
    wide = ENDOMAPPER.cropped(-1000, -1000, 4000, 4000)  # so that only the model's field decides
    np.testing.assert_array_equal(wide.project(points)[1], theta < limit)
    # Without the limit of 90 degrees, the published polynomial stops growing at 90.5 (FORMATS, EndoMapper)
    fine = np.linspace(0, np.pi, 200_001)
    k1, k2, k3, k4 = ENDOMAPPER.params[4:]
    turn = fine[np.argmax(np.diff(fine + k1 * fine**3 + k2 * fine**5 + k3 * fine**7 + k4 * fine**9) <= 0)]
    assert np.degrees(turn) == pytest.approx(90.5, abs=0.1)


def test_kannala_brandt_that_turns_over_early_is_invalid_from_there_on():
    camera = KannalaBrandt(400, 400, 200.0, 200.0, 200.0, 200.0, -0.4, 0.0, 0.0, 0.0)
    turn = np.sqrt(1 / 1.2)
    assert camera.max_theta() == pytest.approx(turn)
    theta = np.array([turn - 1e-3, turn + 1e-3])
    seen = camera.project(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1))[1]
    np.testing.assert_array_equal(seen, [True, False])
    radius = 200 * (turn - 0.4 * turn**3)
    valid = camera.unproject(np.array([[200 + radius - 0.1, 200.0], [200 + radius + 0.1, 200.0]]))[1]
    np.testing.assert_array_equal(valid, [True, False])


@pytest.mark.parametrize("camera", [ENDOMAPPER, C3VD], ids=["endomapper", "c3vd"])
def test_black_corners_of_an_endoscope_have_no_ray(camera):
    valid = camera.resized(camera.width // 10, camera.height // 10).rays()[1]
    assert not valid[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert valid[valid.shape[0] // 2].all()
    assert 0.85 < valid.mean() < 1


def test_c3vd_field_angles_are_the_published_ones():
    left_and_top = np.array([[0.5, 543.5], [679.0, 0.5]])
    angles = np.degrees(np.arccos(C3VD.unproject(left_and_top)[0][:, 2]))
    np.testing.assert_allclose(angles, [63.6, 45.9], atol=0.05)


def test_brown_is_invalid_beyond_the_radius_where_it_folds():
    limit = BROWN._max_radius()
    fine = np.linspace(0, 3, 300_001)
    grows = np.diff(fine * (1 + BROWN.k1 * fine**2 + BROWN.k2 * fine**4)) > 0
    if not grows.all():
        assert limit == pytest.approx(fine[np.argmin(grows)], abs=1e-4)
    folding = Brown(800, 600, 400.0, 400.0, 400.0, 300.0, -0.5, 0.0, 0.0, 0.0)
    turn = np.sqrt(1 / 1.5)
    points = np.array([[turn - 1e-3, 0, 1], [turn + 1e-3, 0, 1], [3 * turn, 0, 1]])
    np.testing.assert_array_equal(folding.project(points)[1], [True, False, False])
    edge = 400 + 400 * (turn - 0.5 * turn**3)
    valid = folding.unproject(np.array([[edge - 0.1, 300.0], [edge + 0.1, 300.0]]))[1]
    np.testing.assert_array_equal(valid, [True, False])


def test_brown_is_invalid_from_where_tangential_terms_fold_it():
    """The slow reference: along every direction, the first place where the Jacobian's determinant is not positive."""
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 181), np.linspace(0.5, 1.5, 501), indexing="ij")
    plane = torch.tensor(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1), requires_grad=True)
    columns = [torch.autograd.grad(STRONG._distort(plane)[..., i].sum(), plane)[0] for i in (0, 1)]
    determinant = torch.linalg.det(torch.stack(columns, -2)).numpy()
    folds = radius[determinant <= 0].min()
    assert STRONG._max_radius() == pytest.approx(folds, abs=2e-3)
    assert folds < 1 < replace(STRONG, p1=0.0, p2=0.0)._max_radius()


def field_points(n: int = 3000, widest: float = 60.0) -> np.ndarray:
    rng = np.random.default_rng(4)
    theta, phi = np.radians(rng.uniform(0, widest, n)), rng.uniform(0, 2 * np.pi, n)
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return unit * rng.uniform(1, 100, (n, 1))


@pytest.mark.parametrize("camera", [PINHOLE, BROWN, STRONG], ids=["pinhole", "brown", "strong brown"])
def test_pinhole_and_brown_agree_with_opencv(camera):
    points = field_points(widest=40)
    expected = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.params[4:] or [0.0] * 4)
    )[0]
    np.testing.assert_allclose(camera._pixels(points)[0], expected[:, 0], atol=1e-9)


def test_kannala_brandt_agrees_with_opencv():
    points = field_points(widest=85)
    expected = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), ENDOMAPPER.matrix, np.array(ENDOMAPPER.params[4:])
    )[0]
    np.testing.assert_allclose(ENDOMAPPER._pixels(points)[0], expected[:, 0], atol=1e-9)


COLMAP_CAMERAS = {
    "PINHOLE": PINHOLE.params,
    "OPENCV": BROWN.params,
    "OPENCV_FISHEYE": ENDOMAPPER.params,
    "SIMPLE_PINHOLE": (700.0, 660.0, 540.0),
    "SIMPLE_RADIAL": (700.0, 660.0, 540.0, -0.1),
    "RADIAL": (700.0, 660.0, 540.0, -0.1, 0.02),
    "SIMPLE_RADIAL_FISHEYE": (700.0, 660.0, 540.0, -0.05),
    "RADIAL_FISHEYE": (700.0, 660.0, 540.0, -0.05, 0.003),
}


@pytest.mark.parametrize("model", COLMAP_CAMERAS)
def test_colmap_models_agree_with_pycolmap_pixel_for_pixel(model):
    params = list(COLMAP_CAMERAS[model])
    ours = camera_from_params(model, 1440, 1080, params)
    theirs = native.pycolmap().Camera(model=model, width=1440, height=1080, params=params)
    points = field_points(500, widest=40)
    np.testing.assert_allclose(ours._pixels(points)[0], theirs.img_from_cam(points), atol=1e-8)


@pytest.mark.parametrize("camera", [PINHOLE, BROWN, ENDOMAPPER], ids=lambda c: c.name)
def test_rays_agree_with_pycolmap(camera):
    """Its own root finding, which ends at 1e-8 or so, and for a fisheye at 90 degrees."""
    theirs = native.pycolmap().Camera(
        model=camera.name, width=camera.width, height=camera.height, params=list(camera.params)
    )
    pixels = camera.project(field_points(500, widest=35))[0]
    plane = theirs.cam_from_img(pixels)
    rays, valid = camera.unproject(pixels)
    assert valid.all()
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, atol=1e-7)


def test_scaramuzza_agrees_with_the_roots_of_its_polynomial():
    stretch = np.array([[C3VD.c, C3VD.d], [C3VD.e, 1.0]])
    for point in field_points(200, widest=85):
        side = np.hypot(point[0], point[1])
        roots = np.roots([C3VD.a4, C3VD.a3, C3VD.a2, C3VD.a1 - point[2] / side, C3VD.a0])
        rho = min(roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real)
        expected = stretch @ (rho * point[:2] / side) + (C3VD.cx, C3VD.cy)
        np.testing.assert_allclose(C3VD._pixels(point)[0], expected, atol=1e-6)


SPECIAL = torch.tensor(
    [[0, 0, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [1e-15, 0, 1], [1e-15, 0, -1], [1, 1, 1e-20], [3, 4, -5]], dtype=float
)


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float64, 1e-12), (torch.float32, 1e-5)], ids=str)
def test_tensors_give_what_arrays_give(lens, dtype, relative):
    """In their own type, to `relative` of the largest coordinate."""
    points = torch.tensor(all_around()).to(dtype)
    pixels = torch.rand((5, 999, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)
    pixels = pixels * torch.tensor([lens.width, lens.height])
    for function, given in ((lens.project, points), (lens.unproject, pixels)):
        found, valid = function(given)
        expected, expected_valid = function(given.double().numpy())
        assert found.dtype == dtype and valid.dtype == torch.bool
        assert found.shape == expected.shape and valid.shape == expected_valid.shape
        assert (valid.numpy() != expected_valid).mean() <= (0 if dtype == torch.float64 else 1e-3)
        both = valid.numpy() & expected_valid
        assert both.mean() > 0.02
        scale = np.abs(expected[both]).max()
        np.testing.assert_allclose(found.numpy()[both], expected[both], rtol=0, atol=relative * scale)


def test_tensors_project_back_to_their_pixels_in_both_types(lens):
    pixels = torch.tensor(pixels_inside(lens))
    for dtype, tolerance in ((torch.float64, 1e-6), (torch.float32, 0.02)):
        rays, valid = lens.unproject(pixels.to(dtype))
        projected, seen = lens.project(rays * 7)
        assert valid.float().mean() > 0.55 and seen[valid].float().mean() > 0.999
        assert (projected - pixels).norm(dim=-1)[valid & seen].max() < tolerance


def test_projection_has_the_gradient_of_finite_differences(lens):
    points = torch.tensor([[0.1, -0.2, 1.0], [0.3, 0.25, 0.7], [-0.5, 0.1, 0.9], [0, 0, 1.0], [0, 0, 3.0]]).double()
    assert lens.project(points)[1].all()
    assert torch.autograd.gradcheck(lambda p: lens.project(p)[0], points.requires_grad_(), eps=1e-5, rtol=1e-5)


def test_rays_have_the_gradient_of_finite_differences(lens):
    centre = lens.project(np.array([0, 0, 1.0]))[0]
    pixels = torch.tensor(centre + np.array([[0, 0], [50, 20], [-80, 31], [9, -150]]))
    assert lens.unproject(pixels)[1].all()
    assert torch.autograd.gradcheck(
        lambda p: lens.unproject(p)[0], pixels.requires_grad_(), eps=1e-3, atol=1e-8, rtol=1e-5
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_gradients_are_finite_where_nothing_is_valid_and_on_the_axis(lens, dtype):
    points = torch.cat([SPECIAL, torch.tensor(all_around())]).to(dtype).requires_grad_()
    pixels, seen = lens.project(points)
    (gradient,) = torch.autograd.grad(torch.where(seen[:, None], pixels, 0.0).sum(), points)
    assert not seen.all() and torch.isfinite(gradient).all()
    assert (gradient[~seen] == 0).all()
    far = torch.tensor(np.random.default_rng(3).uniform(-5, 6, (5000, 2)) * (lens.width, lens.height))
    far = torch.cat([torch.tensor([[lens.cx, lens.cy]]), far]).to(dtype).requires_grad_()
    rays, valid = lens.unproject(far)
    assert torch.isfinite(rays).all() and valid[0]
    (gradient,) = torch.autograd.grad(rays.sum(), far)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.int64], ids=str)
def test_tensors_too_coarse_for_pixels_are_refused(dtype):
    with pytest.raises(TypeError, match=r"tensor of torch\.\w+; expected float32 or float64"):
        PINHOLE.project(torch.ones((2, 3), dtype=dtype))


@pytest.mark.parametrize("size", [(270, 216), (337, 270), (2000, 500), (100, 900)], ids=str)
def test_resizing_is_exact_the_same_relative_place_has_the_same_ray(lens, size):
    resized = lens.resized(*size)
    assert (resized.width, resized.height) == size
    place = np.random.default_rng(5).uniform(0, 1, (2000, 2))
    rays, valid = lens.unproject(place * (lens.width, lens.height))
    again, valid_again = resized.unproject(place * size)
    assert (valid != valid_again).mean() < 0.002
    both = valid & valid_again
    np.testing.assert_allclose(again[both], rays[both], atol=1e-9)


def test_resizing_and_back_gives_the_same_numbers(lens):
    back = lens.resized(123, 456).resized(lens.width, lens.height)
    np.testing.assert_allclose(back.params, lens.params, rtol=1e-12, atol=1e-15)


def test_scaramuzza_resized_unequally_puts_the_stretch_into_c_and_d():
    resized = C3VD.resized(675, 270)  # half and a quarter
    assert resized.a0 == pytest.approx(C3VD.a0 / 4)
    assert resized.a2 == pytest.approx(C3VD.a2 * 4)
    assert resized.a4 == pytest.approx(C3VD.a4 * 64)
    assert (resized.c, resized.d, resized.e) == pytest.approx((2 * C3VD.c, 2 * C3VD.d, C3VD.e))


@pytest.mark.parametrize("corner", [(0, 0), (300, 200), (420, 260)], ids=str)
def test_a_crop_keeps_the_rays_of_its_pixels_wherever_it_lies(lens, corner):
    x, y = corner
    place = np.random.default_rng(6).uniform(0, 1, (500, 2)) * (64, 48)
    rays, valid = lens.unproject(place + corner)
    again, valid_again = lens.cropped(x, y, 64, 48).unproject(place)
    np.testing.assert_array_equal(valid, valid_again)
    np.testing.assert_allclose(again, rays, atol=1e-9)


@pytest.mark.parametrize(("found", "shift"), [(0.0, 0.5), (0.5, 0.0), (1.0, -0.5)])
def test_pixel_center_moves_the_principal_point_by_what_the_file_lacks(lens, found, shift):
    moved = lens.with_pixel_center(found)
    assert (moved.cx, moved.cy) == pytest.approx((lens.cx + shift, lens.cy + shift))
    assert (moved.width, moved.height) == (lens.width, lens.height)


def test_focal_length_is_pixels_per_radian_on_the_axis(lens):
    angle = 1e-5
    pixels = lens._pixels(np.array([[angle, 0, 1.0], [-angle, 0, 1.0], [0, angle, 1.0], [0, -angle, 1.0]]))[0]
    across = np.linalg.norm(pixels[0] - pixels[1]), np.linalg.norm(pixels[2] - pixels[3])
    assert lens.focal_length == pytest.approx(np.sqrt(across[0] * across[1]) / (2 * angle), rel=1e-3)


def test_cameras_survive_their_file_form(lens):
    again = camera_from_params(lens.name, lens.width, lens.height, list(lens.params))
    assert again == lens and type(again) is CAMERA_MODELS[lens.name]


BAD = {
    "size … 0x480": lambda: Pinhole(0, 480, 1.0, 1.0, 0.0, 0.0),
    "fy not finite": lambda: Pinhole(640, 480, 1.0, np.nan, 0.0, 0.0),
    "focal lengths -5": lambda: KannalaBrandt(640, 480, -5.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "a0 = -769": lambda: Scaramuzza(640, 480, 0.0, 0.0, -769.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
    "singular": lambda: Scaramuzza(640, 480, 0.0, 0.0, 769.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "[[c, d], [e, 1]]": lambda: Scaramuzza(640, 480, 0.0, 0.0, 769.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 2.0),
    "my.json … unknown camera model 'MEI'": lambda: camera_from_params("MEI", 640, 480, [1.0], "my.json"),
    "my.json … 3 parameters of PINHOLE": lambda: camera_from_params("PINHOLE", 9, 9, [1.0] * 3, "my.json"),
    "my.json: PINHOLE camera … focal": lambda: camera_from_params("PINHOLE", 9, 9, [-1.0] * 4, "my.json"),
}


@pytest.mark.parametrize("message", BAD)
def test_a_camera_that_cannot_be_is_refused_by_name(message):
    with refused(message):
        BAD[message]()


def test_a_stretch_is_singular_by_its_determinant_and_not_by_the_size_of_its_shear():
    sheared = Scaramuzza(640, 480, 320.0, 240.0, 300.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, -1.0)
    pixel = sheared.project(sheared.unproject(np.array([350.0, 260.0]))[0])[0]
    np.testing.assert_allclose(pixel, [350, 260])


@pytest.mark.parametrize(
    ("source", "deviation", "short"),
    [
        ("measured", None, ""),
        ("published", 0.5, ""),
        ("given", None, ""),
        ("self-calibrated", 0.015, ""),
        ("self-calibrated", 0.016, "the camera is self-calibrated, its focal length known to 1.6 % only"),
        ("self-calibrated", None, "the camera is self-calibrated, nobody knows how well"),
        ("assumed", None, "the camera is assumed, not calibrated"),
    ],
)
def test_a_camera_that_nobody_calibrated_is_doubted_in_its_note_s_words_or_in_ours(source, deviation, short):
    assert Provenance(source, deviation).in_short == short
    assert Provenance(source, deviation).doubt == (short and f"{short}: lengths and shapes may be wrong")
    assert Provenance(source, deviation, "ask who guessed it").doubt == (short and "ask who guessed it")


def test_a_twentieth_of_a_pixel_beyond_the_fold_there_is_no_ray_and_within_there_is():
    camera = Brown(1350, 1080, 802.0, 801.0, 668.0, 547.0, -0.3, 0.0, 0.0, 0.0)
    fold = 1 / np.sqrt(0.9)  # where r - 0.3 r^3 turns over
    azimuth = np.linspace(0, 2 * np.pi, 100)
    for step, valid in ((-0.05, True), (0.05, False)):
        radius = fold - 0.3 * fold**3 + step / 802
        pixels = np.stack([radius * np.cos(azimuth) * 802 + 668, radius * np.sin(azimuth) * 801 + 547], -1)
        assert (camera.unproject(pixels)[1] == valid).all()


def test_the_matrix_of_a_pinhole_projects_as_it_does():
    point = np.array([0.3, -0.2, 2.0])
    found = PINHOLE.matrix @ point
    np.testing.assert_allclose(found[:2] / 2, PINHOLE.project(point)[0])
    assert found[2] == 2 and PINHOLE.focal_length == pytest.approx(np.sqrt(500 * 505))


@pytest.mark.parametrize("camera", [STRONG, replace(STRONG, k1=-0.3, k2=0.0), replace(BROWN, k1=-0.3, k2=0.02)])
def test_the_longer_form_of_brown_folds_where_brown_does(camera):
    longer = FullBrown(camera.width, camera.height, *camera.params, 0.0, 0.0, 0.0, 0.0)
    assert longer._max_radius() == pytest.approx(camera._max_radius(), abs=1.5e-3)
    points = np.random.default_rng(0).normal(0, 0.6, (500, 3)) + (0, 0, 1.5)
    close = np.abs(np.hypot(points[:, 0], points[:, 1]) / points[:, 2] - camera._max_radius()) < 2e-3
    (pixels, seen), (others, also) = camera.project(points[~close]), longer.project(points[~close])
    assert np.array_equal(seen, also) and 50 < seen.sum() < 450
    np.testing.assert_allclose(pixels[seen], others[seen])


def test_the_smallest_image_has_one_pixel_and_one_ray():
    rays, valid = Pinhole(1, 1, 2.0, 4.0, 0.5, 0.5).rays()
    assert rays.tolist() == [[[0, 0, 1]]] and valid.all()
    for size in ((0, 1), (1, 0)):
        with refused(where="camera size"):
            Pinhole(*size, 2.0, 4.0, 0.5, 0.5)
    for focal in ((0.0, 1.0), (1.0, 0.0)):
        with refused(where="PINHOLE camera", found="focal lengths"):
            Pinhole(1, 1, *focal, 0.5, 0.5)
