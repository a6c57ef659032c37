"""Each formula of another program's lens, against the equation that defines it, solved or written out here."""

from __future__ import annotations

import numpy as np
import pytest
from raising import refused

from lightdepth.camera.foreign import (
    division_bend,
    double_sphere_bend,
    eucm_bend,
    fisheye_prism_bend,
    fisheye_radtan_prism_bend,
    fov_bend,
    omni_bend,
    opencv_bend,
    radial_bend,
)

RAYS = np.random.default_rng(0).normal(0, 0.5, (40, 3)) + (0, 0, 1.6)
RAYS /= np.linalg.norm(RAYS, axis=1, keepdims=True)
AXIS = np.array([[0, 0, 1.0]])
PLANE = RAYS[:, :2] / RAYS[:, 2:]
R2 = (PLANE**2).sum(1)
THETA = np.arccos(RAYS[:, 2])
EQUIDISTANT = PLANE / np.sqrt(R2)[:, None] * THETA[:, None]


def tangential(point: np.ndarray, p1: float, p2: float) -> np.ndarray:
    """Brown's decentring, as OpenCV has it."""
    (x, y), r2 = point.T, (point**2).sum(1)
    return np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], 1)


def prism(point: np.ndarray, s1: float, s2: float, s3: float, s4: float) -> np.ndarray:
    r2 = (point**2).sum(1)
    return np.stack([s1 * r2 + s2 * r2**2, s3 * r2 + s4 * r2**2], 1)


def test_opencv_s_distortion_is_a_ratio_of_polynomials_with_decentring_and_prism():
    k1, k2, p1, p2, k3, k4, k5, k6 = -0.2, 0.05, 0.01, -0.02, 0.003, 0.1, 0.02, 0.004
    radial = (1 + k1 * R2 + k2 * R2**2 + k3 * R2**3) / (1 + k4 * R2 + k5 * R2**2 + k6 * R2**3)
    terms = (0.01, 0.02, 0.03, 0.04)
    found = opencv_bend((k1, k2, p1, p2, k3, k4, k5, k6, *terms))(RAYS)
    np.testing.assert_allclose(found, PLANE * radial[:, None] + tangential(PLANE, p1, p2) + prism(PLANE, *terms))
    short = PLANE * (1 + k1 * R2 + k2 * R2**2)[:, None] + tangential(PLANE, p1, p2)
    np.testing.assert_allclose(opencv_bend((k1, k2, p1, p2))(RAYS), short)


def test_a_radial_polynomial_has_as_many_terms_as_are_given():
    radial = 1 + 0.1 * R2 - 0.2 * R2**2 + 0.03 * R2**3 - 0.004 * R2**4
    found = radial_bend(0.1, -0.2, 0.03, -0.004, p1=0.01, p2=-0.03)(RAYS)
    np.testing.assert_allclose(found, PLANE * radial[:, None] + tangential(PLANE, 0.01, -0.03))
    np.testing.assert_allclose(radial_bend(0.1)(RAYS), PLANE * (1 + 0.1 * R2)[:, None])


@pytest.mark.parametrize("k", [-0.3, 0.08])
def test_a_point_divided_by_its_own_radius_squared_is_the_plane_s(k):
    rays = RAYS[R2 < 0.8]
    found = division_bend(k)(rays)
    np.testing.assert_allclose(found / (1 + k * (found**2).sum(1))[:, None], rays[:, :2] / rays[:, 2:])


@pytest.mark.parametrize("omega", [0.9, -0.9, 1e-12])
def test_a_field_of_view_lens_is_even_in_angle_by_its_width(omega):
    found = np.linalg.norm(fov_bend(omega)(RAYS), axis=1)
    expected = np.arctan(2 * np.sqrt(R2) * np.tan(omega / 2)) / omega if abs(omega) > 1e-9 else np.sqrt(R2)
    np.testing.assert_allclose(found, expected)
    assert (np.sign(fov_bend(omega)(RAYS)) == np.sign(PLANE)).all() and not fov_bend(omega)(AXIS).any()
    np.testing.assert_allclose(fov_bend(0.9)(np.array([[1, 0, 0.0]])), [[np.pi / 1.8, 0]])
    for wrong in (np.pi, -4.0, np.nan):
        with refused(where="FOV lens"):
            fov_bend(wrong)


def test_unified_lenses_project_from_behind_their_surfaces():
    x, y, z = RAYS.T
    alpha, beta, xi = 0.6, 1.2, -0.2
    d = np.sqrt(beta * (x * x + y * y) + z * z)
    np.testing.assert_allclose(eucm_bend(alpha, beta)(RAYS), RAYS[:, :2] / (alpha * d + (1 - alpha) * z)[:, None])
    np.testing.assert_allclose(eucm_bend(0.0, 5.0)(RAYS), PLANE)
    second = np.sqrt(x * x + y * y + (xi + z) ** 2)
    by_hand = RAYS[:, :2] / (alpha * second + (1 - alpha) * (xi + z))[:, None]
    np.testing.assert_allclose(double_sphere_bend(xi, alpha)(RAYS), by_hand)
    np.testing.assert_allclose(double_sphere_bend(0.0, 0.0)(RAYS), PLANE)
    point = RAYS[:, :2] / (z + 0.8)[:, None]
    radial = 1 - 0.1 * (point**2).sum(1)
    np.testing.assert_allclose(omni_bend(0.8, (-0.1, 0.0, 0.0, 0.0))(RAYS), point * radial[:, None])
    for bend in (lambda a: eucm_bend(a, 1.0), lambda a: double_sphere_bend(0.0, a)):
        bend(0.0), bend(1.0)
        for wrong in (-0.1, 1.1):
            with refused(found=f"alpha {wrong}"):
                bend(wrong)


def test_colmap_s_fisheyes_act_on_the_angle_from_the_axis():
    k = (0.1, -0.02, 0.003, -0.0004)
    t2 = THETA**2
    radial = 1 + k[0] * t2 + k[1] * t2**2 + k[2] * t2**3 + k[3] * t2**4
    thin = fisheye_prism_bend(k, 0.01, -0.02, (0.03, 0.04))(RAYS)
    sides = prism(EQUIDISTANT, 0.03, 0.0, 0.04, 0.0)
    np.testing.assert_allclose(thin, EQUIDISTANT * radial[:, None] + tangential(EQUIDISTANT, 0.01, -0.02) + sides)
    bent = EQUIDISTANT * radial[:, None]
    found = fisheye_radtan_prism_bend(k, 0.01, -0.02, (0.03, 0.04, 0.05, 0.06))(RAYS)
    # COLMAP counts the two decentring terms the other way round than OpenCV.
    np.testing.assert_allclose(found, bent + tangential(bent, -0.02, 0.01) + prism(bent, 0.03, 0.04, 0.05, 0.06))
    assert not fisheye_prism_bend(k, 0.0, 0.0, (0.0, 0.0))(AXIS).any()
