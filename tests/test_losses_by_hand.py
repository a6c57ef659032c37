"""Each term of the loss on random images, against its words in plain NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from raising import refused
from test_losses import LAMBERT, spoilt, tube_batch

from lightdepth.losses import (
    LossConfig,
    brightness_residual,
    chroma_loss,
    facing_loss,
    log_error,
    photometric_loss,
    rendered_log_brightness,
    saturated_loss,
    self_supervised_loss,
    smoothness_loss,
    specular_loss,
    supervised_loss,
    uncertainty_loss,
)
from lightdepth.losses.masked import masked_median, masked_std, mean_over_images
from lightdepth.losses.surface import albedo_loss, smoothness_guide, steps
from lightdepth.photometry import LightTerms, PhotometricCalibration, hue_saturation_albedo, irradiance

RNG = np.random.default_rng(7)
SHAPE = (2, 1, 9, 8)
MASK = torch.from_numpy(RNG.random(SHAPE) < 0.8)
VALUES = torch.from_numpy(RNG.normal(size=SHAPE))
OTHERS = torch.from_numpy(RNG.normal(size=SHAPE))
NORMALS, RAYS = (torch.nn.functional.normalize(torch.from_numpy(RNG.normal(size=(2, 3, 9, 8))), dim=1) for _ in "nr")
ALBEDO = torch.from_numpy(RNG.random((2, 2, 9, 8)))
LIGHT = LightTerms(*(t.expand(2, *t.shape[1:]) for t in PhotometricCalibration(gamma=1.8).terms(torch.float64)))


def inside(values: torch.Tensor, mask: torch.Tensor = MASK) -> float:
    """The mean over images of the mean inside each one's mask."""
    pairs = zip(values.numpy(), mask.expand_as(values).numpy(), strict=True)
    return float(np.mean([v[m].mean() if m.any() else 0.0 for v, m in pairs]))


def test_means_medians_and_deviations_are_each_image_s_own_and_an_empty_one_counts_as_0():
    half = MASK.clone()
    half[1] = False
    assert float(mean_over_images(VALUES, MASK)) == pytest.approx(inside(VALUES))
    assert float(mean_over_images(VALUES, half)) == pytest.approx(inside(VALUES, half))
    for mask in (MASK, half):
        for found, numbers in ((masked_median, "median"), (masked_std, "std")):
            for i, got in enumerate(found(VALUES, mask).flatten().tolist()):
                kept = np.sort(VALUES[i][mask[i]].numpy())
                expected = {"median": lambda k: k[(len(k) - 1) // 2], "std": np.std}[numbers](kept) if len(kept) else 0
                assert got == pytest.approx(expected)
    assert masked_median(VALUES, MASK).shape == masked_std(VALUES, MASK).shape == (2, 1, 1, 1)


def test_steps_are_differences_of_neighbours_both_inside_at_112_rows():
    for axis in (-1, -2):
        step = VALUES.diff(dim=axis).abs() * (9 / 112)
        both = MASK.narrow(axis, 1, SHAPE[axis] - 1) & MASK.narrow(axis, 0, SHAPE[axis] - 1)
        assert float(steps(VALUES, MASK, axis)) == pytest.approx(inside(step, both))
    assert float(steps(VALUES[..., :1], MASK[..., :1], -1)) == 0
    albedo = hue_saturation_albedo(ALBEDO)
    found = [steps(albedo, MASK, axis) for axis in (-1, -2)]
    assert float(albedo_loss(ALBEDO, MASK)) == pytest.approx(float(sum(found)) / 2)


def test_smoothness_is_of_second_differences_less_at_edges_of_the_guide():
    rows, total = 9 / 112, 0.0
    for axis in (-1, -2):
        n = SHAPE[axis] - 2
        second = VALUES.diff(n=2, dim=axis).abs() * rows**2
        edge = (OTHERS.narrow(axis, 2, n) - OTHERS.narrow(axis, 0, n)).abs() / 2
        three = MASK.narrow(axis, 0, n) & MASK.narrow(axis, 1, n) & MASK.narrow(axis, 2, n)
        total += inside(second * torch.exp(-5 * rows * edge), three) / 2
    assert float(smoothness_loss(VALUES, OTHERS, MASK)) == pytest.approx(total)
    thin = [t[..., :2] for t in (VALUES, OTHERS, MASK)]
    rows_alone = float(smoothness_loss(*thin))
    assert rows_alone > 0 and float(smoothness_loss(*(t[..., :2, :] for t in thin))) == 0
    even = torch.full(SHAPE, 0.7, dtype=torch.float64)
    torch.testing.assert_close(smoothness_guide(even, torch.ones_like(MASK)), even)


def test_walls_face_the_camera_and_highlights_the_light():
    cosine = -(NORMALS * RAYS).sum(1, keepdim=True)
    assert float(facing_loss(NORMALS, RAYS, MASK, 0.2)) == pytest.approx(inside((0.2 - cosine).clamp(min=0)))
    assert float(specular_loss(NORMALS, RAYS, MASK)) == pytest.approx(inside(1 - cosine))


@pytest.mark.parametrize("huber", [0.0, 0.4])
def test_residuals_count_by_huber_over_its_width_and_on_white_pixels_only_darker_ones(huber):
    def cost(x: torch.Tensor) -> torch.Tensor:
        size = x.abs()
        return torch.where(size < huber, size**2 / (2 * max(huber, 1e-9)), size - huber / 2)

    assert float(photometric_loss(VALUES, MASK, huber)) == pytest.approx(inside(cost(VALUES)))
    usable = torch.zeros_like(MASK)
    usable[0, 0, 0, 0] = True  # in the second image nothing is known of the gain
    expected = inside(cost(VALUES.clamp(min=0)), MASK & torch.tensor([True, False]).reshape(2, 1, 1, 1))
    assert float(saturated_loss(VALUES, MASK, usable, huber)) == pytest.approx(expected)
    residual = brightness_residual(VALUES, OTHERS, MASK)
    torch.testing.assert_close(residual, VALUES - OTHERS - masked_median(VALUES - OTHERS, MASK))


def test_errors_against_truth_have_no_scale():
    distance, truth = VALUES.exp(), OTHERS.exp()
    error = VALUES - OTHERS
    found = supervised_loss(distance, truth, MASK)
    mean = torch.tensor([e[m].mean() for e, m in zip(error, MASK, strict=True)]).reshape(2, 1, 1, 1)
    assert float(found["supervised"]) == pytest.approx(3 * inside((error - mean).abs()))
    gradient = sum(float(steps(torch.where(MASK, error, 0.0), MASK, axis)) for axis in (-1, -2))
    assert float(found["supervised_gradient"]) == pytest.approx(3 * gradient)
    middle = torch.where(MASK, error - masked_median(error, MASK), 0.0)
    torch.testing.assert_close(log_error(distance, truth, MASK), middle)
    likelihood = np.sqrt(2) * error.abs() * torch.exp(-VALUES) + VALUES
    assert float(uncertainty_loss(VALUES, error, MASK)) == pytest.approx(inside(likelihood))
    nothing = torch.zeros_like(distance)
    assert np.isfinite(float(supervised_loss(nothing, nothing, MASK)["supervised"]))


def test_chroma_is_the_distance_of_the_image_s_own_hue_and_saturation_where_there_is_light():
    image = torch.from_numpy(RNG.random((2, 3, 9, 8)))
    image[:, :, :2] *= 0.1  # colour is noise below a tenth
    v = image.amax(1, keepdim=True)
    off = ((image / v) ** 1.8 - hue_saturation_albedo(ALBEDO)).abs()
    assert float(chroma_loss(ALBEDO, image, LIGHT, MASK)) == pytest.approx(inside(off, MASK & (v > 0.1)))


@pytest.mark.parametrize("ambient", [0.0, 0.3])
def test_rendered_brightness_is_the_light_with_a_share_of_its_mean_by_the_response(ambient):
    distance, indirect = VALUES.exp(), OTHERS.exp() * 0.1
    config = LossConfig(ambient=ambient, cosine_exponent=0.7, cosine_floor=0.05)
    found = rendered_log_brightness(distance, NORMALS, RAYS, MASK, LIGHT, indirect, config)
    lit = irradiance(distance, NORMALS, RAYS, LIGHT, 0.7, 0.05) + indirect
    mean = torch.tensor([v[m].mean() for v, m in zip(lit, MASK, strict=True)]).reshape(2, 1, 1, 1)
    torch.testing.assert_close(found, (lit + ambient * mean).log() / 1.8)


def test_structure_is_compared_in_log_space_too_where_it_has_a_weight():
    batch, albedo = tube_batch()
    _, terms = self_supervised_loss(spoilt(batch.true_distance), albedo, batch, replace(LAMBERT, ssim=0.7))
    assert float(terms["ssim"]) > 1e-4
    with refused(where="loss"):
        self_supervised_loss(batch.true_distance, None, batch, replace(LAMBERT, ssim=0.1))
    with refused(where="loss"):
        self_supervised_loss(batch.true_distance, None, batch, replace(LAMBERT, space="linear"))
