"""The error that is expected of bent depth: what it grows with, and what of it is fused and counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import PINHOLE, slanted_plane, sphere

from densify.alignment import Alignment
from densify.config import DensifyConfig
from densify.densified import unsure
from densify.expected import expected_share
from densify.fusers import sure
from densify.fusion.volume import FusionConfig

BALL = sphere(PINHOLE).prediction()
GREY = np.full((*BALL.distance.shape, 3), 0.5, np.float32)
REACH = float(BALL.distance[BALL.valid].max())


def of(uncertainty: float | None = None, reach: float = REACH, image: np.ndarray = GREY) -> np.ndarray:
    sigma = None if uncertainty is None else np.full(BALL.distance.shape, uncertainty, np.float32)
    return expected_share(replace(BALL, uncertainty=sigma), reach, image)


def test_facing_lit_wall_that_the_map_reaches_errs_by_what_the_formula_says():
    np.testing.assert_allclose(of(), 0.04, rtol=0.01)
    np.testing.assert_allclose(of(0.09), 0.04, rtol=0.01)
    np.testing.assert_allclose(of(0.135), 0.04 * 1.5**0.5, rtol=0.01)
    np.testing.assert_allclose(of(reach=REACH / 2), 0.04 * np.exp(0.22), rtol=0.02)
    np.testing.assert_allclose(of(image=0 * GREY), 0.04 * 1.08, rtol=0.01)
    np.testing.assert_allclose(of(image=2 * GREY), 0.04 * 1.08, rtol=0.01)


def test_an_uncertainty_of_another_scale_is_believed_within_bounds():
    np.testing.assert_allclose(of(5.0), of(0.18), rtol=1e-6)
    np.testing.assert_allclose(of(1e-4), of(0.054), rtol=1e-6)


def test_a_network_that_says_honestly_how_unsure_it_is_loses_no_wall_by_it_that_faces_the_camera_and_the_map_reaches():
    """With the power 2.7 that stood here a third of such a network's pixels was left out."""
    assert (of(0.2)[BALL.valid] < FusionConfig().max_error / 100).all()


def test_slanted_wall_is_expected_to_err_more_the_more_it_slants():
    scene = slanted_plane(PINHOLE, (1.0, 0.0, -0.35))
    prediction = scene.prediction()
    error = expected_share(prediction, float(prediction.distance.max()), GREY)
    cosine = -(scene.normals * scene.rays)[0].sum(0).numpy()
    row = prediction.valid[45]
    order = np.argsort(cosine[45][row])[::-1]
    assert (np.diff(error[45][row][order][2:-2]) > -1e-3).all() and error[45][row].max() > 0.1


def test_what_is_expected_to_err_by_more_than_asked_is_left_out_and_the_rest_stays():
    sigma = np.full(BALL.distance.shape, 0.09, np.float32)
    sigma[:, 60:] = 0.16
    prediction = replace(BALL, uncertainty=sigma)
    applied = Alignment("1", scale=2.0).applied(prediction)
    for most, kept in ((5.0, slice(60)), (3.0, slice(0)), (30.0, slice(None))):
        found = sure(applied, 2 * REACH, GREY, FusionConfig(max_error=most))
        expected = np.zeros_like(BALL.valid)
        expected[:, kept] = BALL.valid[:, kept]
        assert np.array_equal(found.valid, expected)
        np.testing.assert_allclose(found.distance, 2 * BALL.distance)


def test_what_is_left_out_is_told_with_the_limit():
    assert unsure(0.123, DensifyConfig()) == "12% of the pixels are left out, each expected to be over 12 % off"
    assert unsure(0.0, DensifyConfig(fusion=FusionConfig(max_error=5.5))).endswith("5.5 % off")
    with pytest.raises(Exception, match="max_error"):
        FusionConfig(max_error=0.0)
