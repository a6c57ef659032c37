"""What lenses are calculated with: roots, tables, radii and planes, for arrays and tensors alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from raising import refused

from lightdepth.camera import Brown, FullBrown, Pinhole, Scaramuzza, camera_from_params
from lightdepth.camera.arrays import (
    angle_from_axis,
    at_radius,
    detached,
    first_positive_root,
    floating,
    interpolated,
    length,
    rays_through_plane,
    scaled,
    to_plane,
    unit,
)
from lightdepth.camera.params import opencv_camera

POINTS = np.random.default_rng(0).normal(size=(30, 3))
KINDS = pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor], ids=["array", "tensor"])


@pytest.mark.parametrize(
    ("coefficients", "root"),
    [
        ((1.0, -3.0, 2.0), 1.0),
        ((1.0, 3.0, 2.0), np.inf),
        ((1.0, 0.0, 1.0), np.inf),
        ((-1e-3, 0.0, 1e-9), 1e-3),
        ((1.0, -2001.0, 2000.0), 1.0),
        ((1.0, 0.0, 0.0), np.inf),
        ((0.0, 0.0, 2.0), np.inf),
        ((1.0, -5.0, 8.0, -6.0), 3.0),
    ],
)
def test_the_smallest_positive_real_root_is_found_or_there_is_none(coefficients, root):
    assert first_positive_root(*coefficients) == pytest.approx(root)


@KINDS
def test_tables_are_read_between_their_knots_and_held_beyond_them(kind):
    knots, values = np.array([0.0, 1.0, 3.0]), np.array([2.0, 4.0, 3.0])
    at = kind(np.array([-1.0, 0.0, 0.25, 1.0, 2.0, 3.0, 9.0]))
    assert interpolated(at, knots, values).tolist() == [2, 2, 2.5, 4, 3.5, 3, 3]


@KINDS
def test_lengths_and_units_and_scaled_points(kind):
    x, y, points = kind(np.array([3.0, 0.0, -5.0])), kind(np.array([4.0, 0.0, 12.0])), kind(POINTS)
    assert length(x, y).tolist() == [5, 0, 13]
    np.testing.assert_allclose(unit(points), POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True))
    np.testing.assert_allclose(scaled(points[:, :2], (2.0, -3.0), (0.5, 0.25)), POINTS[:, :2] * (2, -3) + (0.5, 0.25))
    plane = rays_through_plane(kind(POINTS[:, :2]))
    np.testing.assert_allclose(plane[:, :2] / plane[:, 2:], POINTS[:, :2])
    np.testing.assert_allclose(np.linalg.norm(plane, axis=1), 1)


def test_a_length_of_nothing_has_no_gradient():
    x = torch.tensor([0.0, 0.0, 3.0], requires_grad=True)
    length(x, torch.tensor([0.0, 2.0, 4.0])).sum().backward()
    assert x.grad is not None and x.grad.tolist() == pytest.approx([0, 0, 0.6])
    assert not detached(x).requires_grad and detached(POINTS) is POINTS


@KINDS
def test_points_are_before_the_camera_or_their_place_on_the_plane_is_finite(kind):
    points = kind(np.array([[2.0, -4.0, 2.0], [1.0, 1.0, -1.0], [1.0, 0.0, 0.0], [3.0, 4.0, 5e-4], [3.0, 4.0, 1e-5]]))
    plane, front = to_plane(points)
    assert front.tolist() == [True, False, False, True, False]
    aside = kind(np.array([[5.0, 0.0, 6e-5], [5.0, 0.0, 4e-5], [0.0, -5.0, 6e-5], [0.0, -5.0, 4e-5]]))
    assert to_plane(aside)[1].tolist() == [True, False, True, False]
    assert plane[0].tolist() == [1, -2] and plane[1].tolist() == [1, 1] and np.isfinite(np.asarray(plane)).all()


@KINDS
def test_angles_from_the_axis_go_to_half_a_turn_and_there_is_none_at_the_centre(kind):
    points = kind(np.array([[0.0, 0.0, 2.0], [0.0, 3.0, 3.0], [4.0, 3.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))
    theta, side, exists = angle_from_axis(points)
    np.testing.assert_allclose(theta, [0, np.pi / 4, np.pi / 2, np.pi, 0])
    assert side.tolist() == [0, 3, 5, 0, 0] and exists.tolist() == [True, True, True, True, False]


@KINDS
def test_points_are_moved_to_their_radius_and_near_the_axis_by_the_focal_length(kind):
    points = kind(np.array([[3.0, 4.0, 5.0], [1e-9, 0.0, 2.0], [0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [-6.0, 8.0, 0.0]]))
    moved = at_radius(points, length(points[:, 0], points[:, 1]), kind(np.array([10.0, 9.0, 9.0, 9.0, 1.0])), 7.0)
    np.testing.assert_allclose(moved, [[6, 8], [3.5e-9, 0], [0, 0], [0, 0], [-0.6, 0.8]])


def test_arrays_are_doubles_and_tensors_stay_as_they_are():
    assert floating(np.array([1, 2])).dtype == np.float64 and floating([1.0]).dtype == np.float64
    for dtype in (torch.float32, torch.float64):
        assert floating(torch.zeros(1, dtype=dtype)).dtype == dtype
    with pytest.raises(TypeError):
        floating(torch.zeros(1, dtype=torch.int64))


@pytest.mark.parametrize(
    ("terms", "name", "last"),
    [
        ([], "PINHOLE", 8.0),
        ([0.0] * 12, "PINHOLE", 8.0),
        ([0.1, 0.0, 0.0, 0.0], "OPENCV", 0.0),
        ([0.0, 0.0, 0.0, 0.2], "OPENCV", 0.2),
        ([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], "OPENCV", 0.0),
        ([0.0, 0.0, 0.0, 0.0, 0.3], "FULL_OPENCV", 0.0),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3], "FULL_OPENCV", 0.3),
    ],
)
def test_opencv_s_numbers_become_the_shortest_lens_that_holds_them(terms, name, last):
    found = opencv_camera(20, 16, [9.0, 9.5, 10.0, 8.0, *terms])
    assert (found.name, found.width, found.height) == (name, 20, 16)
    assert found.params[:4] == (9, 9.5, 10, 8) and found.params[-1] == last  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("model", "numbers", "ours", "params"),
    [
        ("SIMPLE_PINHOLE", [9, 5, 4], "PINHOLE", (9, 9, 5, 4)),
        ("SIMPLE_RADIAL", [9, 5, 4, 0.1], "OPENCV", (9, 9, 5, 4, 0.1, 0, 0, 0)),
        ("RADIAL", [9, 5, 4, 0.1, 0.2], "OPENCV", (9, 9, 5, 4, 0.1, 0.2, 0, 0)),
        ("FISHEYE", [9, 8, 5, 4], "OPENCV_FISHEYE", (9, 8, 5, 4, 0, 0, 0, 0)),
        ("SIMPLE_FISHEYE", [9, 5, 4], "OPENCV_FISHEYE", (9, 9, 5, 4, 0, 0, 0, 0)),
        ("RADIAL_FISHEYE", [9, 5, 4, 0.1, 0.2], "OPENCV_FISHEYE", (9, 9, 5, 4, 0.1, 0.2, 0, 0)),
        ("THIN_PRISM_FISHEYE", [9, 8, 5, 4, 0.1, 0.2, 0, 0, 0.3, 0.4, 0, 0], "OPENCV_FISHEYE",
         (9, 8, 5, 4, 0.1, 0.2, 0.3, 0.4)),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [9, 8, 5, 4, 0.1, 0.2, 0.3, 0.4, *[0] * 8], "OPENCV_FISHEYE",
         (9, 8, 5, 4, 0.1, 0.2, 0.3, 0.4)),
        ("FOV", [9, 8, 5, 4, 0.0], "PINHOLE", (9, 8, 5, 4)),
        ("DIVISION", [9, 8, 5, 4, 0.0], "PINHOLE", (9, 8, 5, 4)),
        ("SIMPLE_DIVISION", [9, 5, 4, 0.0], "PINHOLE", (9, 9, 5, 4)),
        ("EUCM", [9, 8, 5, 4, 0.0, 1.5], "PINHOLE", (9, 8, 5, 4)),
    ],
)  # fmt: skip
def test_a_model_of_others_without_what_is_its_own_is_one_of_ours(model, numbers, ours, params):
    found = camera_from_params(model, 10, 8, numbers)
    assert (found.name, found.params) == (ours, params)


def test_a_scaramuzza_lens_that_never_bends_back_ends_at_a_right_angle_and_one_that_does_ends_there():
    straight = Scaramuzza(400, 300, 200.0, 150.0, 100.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    assert straight.max_theta() == pytest.approx(np.arctan(2 * 250 / 100)) and straight.focal_length == 100
    part = straight.cropped(200, 150, 200, 150)  # whose axis is in its corner
    assert part.max_theta() == straight.max_theta() and part.unproject(np.array([200.0, 150.0]))[1]
    small = straight.cropped(190, 145, 20, 10)  # twice as far as its corners is nothing: by the lens
    assert small.max_theta() == pytest.approx(np.arctan(4))
    bending = Scaramuzza(400, 300, 200.0, 150.0, 100.0, 0.0, -4e-3, 0.0, 0.0, 1.0, 0.0, 0.0)
    assert np.degrees(bending.max_theta()) == pytest.approx(90, abs=0.2)
    # theta turns over where rho h' = h: at rho = sqrt(a0 / a2), 45 degrees
    turning = Scaramuzza(400, 300, 200.0, 150.0, 100.0, 0.0, 2.5e-3, 0.0, 0.0, 1.0, 0.0, 0.0)
    assert np.degrees(turning.max_theta()) == pytest.approx(45, abs=0.01)
    rays, valid = turning.unproject(np.array([[200 + 199.0, 150], [200 + 201.0, 150], [200, 150]]))
    assert valid.tolist() == [True, False, True] and rays[2].tolist() == [0, 0, 1]


def test_an_image_ends_with_its_last_pixel_s_far_corner():
    camera = Pinhole(8, 6, 2.0, 0.5, 4.0, 3.0)
    corners = np.array([[0.0, 0], [8, 0], [0, 6], [8, 6]])
    beside = corners + np.array([[-0.01, 0], [0.01, 0], [0, 0.01], [0.01, 0.01]])
    for pixels, inside in ((corners, True), (beside, False), (corners[:1] - (0, 0.01), False)):
        rays = np.concatenate([(pixels - (4, 3)) / (2, 0.5), np.ones((len(pixels), 1))], 1)
        found, seen = camera.project(rays)
        np.testing.assert_allclose(found, pixels)
        assert (seen == inside).all()


def test_the_numbers_that_a_model_wants_are_named_where_it_is_one_of_ours():
    for model, cure in (("PINHOLE", "expected 4: fx fy cx cy"), ("OPENCV", "expected 8: fx fy cx cy k1 k2 p1 p2")):
        with refused(cure=cure):
            camera_from_params(model, 9, 9, [1.0])
    with refused(cure="expected 3") as raised:
        camera_from_params("SIMPLE_PINHOLE", 9, 9, [1.0])
    assert "fx" not in raised.value.cure
    with refused(where="camera size"):
        Scaramuzza(0, 300, 200.0, 150.0, 100.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)


@pytest.mark.parametrize("terms", [(-0.5, 0.12, 0.02, -0.015), (0.0, 0.0, 0.15, 0.1), (-0.1, 0.05, -0.2, 0.0)])
def test_brown_ends_where_its_jacobian_is_first_singular_in_any_direction(terms):
    k1, k2, p1, p2 = terms
    angle = np.linspace(0, 2 * np.pi, 721)[:, None]
    r = np.linspace(0, 3, 6001)[None]
    x, y = r * np.cos(angle), r * np.sin(angle)
    radial, slope = 1 + k1 * r**2 + k2 * r**4, 2 * k1 + 4 * k2 * r**2
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    first = r[0, ((xx * yy - xy * xy) <= 0).any(0).argmax()]
    assert 0.1 < first < 2.9
    camera = Brown(640, 480, 400.0, 408.0, 328.0, 236.8, *terms)
    assert camera._max_radius() == pytest.approx(first, abs=2e-3)
    longer = FullBrown(640, 480, 400.0, 408.0, 328.0, 236.8, *terms, 0.0, 0.0, 0.0, 0.0)
    assert longer._max_radius() == pytest.approx(first, abs=2e-3)


@pytest.mark.parametrize("p", [(0.3, 0.0), (0.0, -0.55), (-0.4, 0.38)])
def test_a_lens_whose_resolution_grows_faster_than_its_decentring_takes_away_never_folds(p):
    """Along the decentring 1 + 3 k1 r² - 6 p r has no root where 3 p² < k1; no other direction is the first to fold."""
    for camera in (
        Brown(64, 48, 40.0, 40.0, 32.0, 24.0, 1.0, 0.0, *p),
        FullBrown(64, 48, 40.0, 40.0, 32.0, 24.0, 1.0, 0.0, *p, 0.0, 0.0, 0.0, 0.0),
    ):
        assert camera._max_radius() == np.inf
    folding = Brown(64, 48, 40.0, 40.0, 32.0, 24.0, 0.3 * (p[0] ** 2 + p[1] ** 2), 0.0, *p)
    assert np.isfinite(folding._max_radius())
