"""Depth in closed form from the decline of the light."""

from __future__ import annotations

import math

import pytest
import torch
from scenes import C3VD, LENSES, PINHOLE, cylinder, slanted_plane, sphere

from lightdepth.camera import Pinhole
from lightdepth.decline import V_FLOOR, informative, log_closed_form, masked_blur
from lightdepth.photometry import PhotometricCalibration, hue_saturation_albedo

LIGHT = PhotometricCalibration(gain=60.0)
SMALL = Pinhole(5, 4, 4.0, 4.5, 2.6, 1.9)


def solved(scene, light=LIGHT, assumed=None, blur=0.0, albedo=1.0) -> torch.Tensor:
    terms = (assumed or light).terms(torch.float64)
    return log_closed_form(scene.image(light, albedo), scene.valid, scene.rays, terms, blur)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_distance_of_a_facing_sphere_is_exact(name, gamma):
    scene = sphere(LENSES[name].resized(60, 48), radius=10)
    light = PhotometricCalibration(gain=60.0, gamma=gamma)
    torch.testing.assert_close(
        solved(scene, light)[scene.valid].exp(), torch.full((int(scene.valid.sum()),), 10.0, dtype=torch.float64)
    )


def test_blur_costs_nothing_where_the_image_is_even():
    scene = sphere(C3VD.resized(90, 72), radius=10)
    even = PhotometricCalibration(gain=60.0, mu=0.0)
    torch.testing.assert_close(solved(scene, even, blur=0.05)[scene.valid], solved(scene, even)[scene.valid])


def test_the_unknown_cosine_makes_slanted_walls_look_farther_by_its_root():
    scene = slanted_plane(PINHOLE.resized(60, 45))
    cosine = -(scene.normals * scene.rays).sum(1, keepdim=True)
    expected = scene.distance.log() - 0.5 * cosine.log()
    torch.testing.assert_close(solved(scene)[scene.valid], expected[scene.valid])


def test_albedo_of_value_one_does_not_matter():
    scene = cylinder(C3VD.resized(60, 48), farthest=30)
    hue_saturation = torch.rand(1, 2, 48, 60, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    coloured = solved(scene, albedo=hue_saturation_albedo(hue_saturation))
    torch.testing.assert_close(coloured[scene.valid], solved(scene)[scene.valid])


@pytest.mark.parametrize("blur", [0.0, 0.018])
def test_a_gain_that_nobody_told_changes_only_the_scale(blur):
    scene = cylinder(C3VD.resized(90, 72), farthest=25)
    brighter = PhotometricCalibration(gain=240.0)
    shift = (solved(scene, brighter, LIGHT, blur) - solved(scene, LIGHT, LIGHT, blur))[scene.valid]
    torch.testing.assert_close(shift, torch.full_like(shift, -0.5 * math.log(4)))


def test_a_gain_that_is_known_changes_nothing():
    scene = cylinder(C3VD.resized(90, 72), farthest=25)
    brighter = solved(scene, PhotometricCalibration(gain=240.0))
    torch.testing.assert_close(brighter[scene.valid], solved(scene)[scene.valid])


def test_the_offset_of_the_light_is_ignored_for_it_has_a_length():
    scene = slanted_plane(C3VD.resized(30, 24))
    offset = PhotometricCalibration(gain=60.0, position_mm=(3.0, -2.0, 1.0), direction=(0.1, 0, 1))
    torch.testing.assert_close(solved(scene, LIGHT, offset), solved(scene))


def test_black_pixels_are_finite_and_said_to_be_uninformative():
    scene = sphere(SMALL)
    image = torch.zeros(1, 3, 4, 5, dtype=torch.float64)
    image[..., 0, 0] = 0.5
    image[..., 0, 1] = V_FLOOR / 2
    log_distance = log_closed_form(image, scene.valid, scene.rays, LIGHT.terms(torch.float64), 0.0)
    assert torch.isfinite(log_distance).all()
    expected = torch.zeros(1, 1, 4, 5, dtype=torch.bool)
    expected[..., 0, 0] = True
    assert torch.equal(informative(image, scene.valid), expected)
    assert not informative(image, torch.zeros_like(scene.valid)).any()


def half_mask(height: int = 40, width: int = 50) -> torch.Tensor:
    mask = torch.zeros(1, 1, height, width, dtype=torch.bool)
    mask[..., 5:30, 8:33] = True
    return mask


@pytest.mark.parametrize("outside", [0.0, 1e9, -1e9, math.inf, math.nan], ids=str)
def test_what_lies_outside_the_mask_never_leaks_in(outside):
    mask = half_mask()
    values = torch.rand(1, 1, 40, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    clean = masked_blur(values, mask, 3.0)
    assert torch.equal(masked_blur(torch.where(mask, values, outside), mask, 3.0)[mask], clean[mask])


def test_blur_keeps_a_constant_to_the_edge_of_the_mask_and_the_values_outside():
    mask = half_mask()
    values = torch.where(mask, 7.0, -3.0).double()
    torch.testing.assert_close(masked_blur(values, mask, 4.0), values)


def test_blur_agrees_with_a_slow_normalised_gaussian():
    mask, sigma = half_mask(), 2.0
    values = torch.rand(1, 1, 40, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    found = masked_blur(values, mask, sigma)
    for row, column in [(5, 8), (29, 32), (17, 20), (5, 20)]:
        total = weight = 0.0
        for y in range(row - 6, row + 7):
            for x in range(column - 6, column + 7):
                if 0 <= y < 40 and 0 <= x < 50 and mask[0, 0, y, x]:
                    w = math.exp(-((y - row) ** 2 + (x - column) ** 2) / (2 * sigma**2))
                    total, weight = total + w * float(values[0, 0, y, x]), weight + w
        assert float(found[0, 0, row, column]) == pytest.approx(total / weight, rel=1e-9)


def test_blur_of_width_zero_does_nothing_and_one_larger_than_the_image_still_works():
    values = torch.rand(1, 1, 4, 5, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(1, 1, 4, 5, dtype=torch.bool)
    assert masked_blur(values, mask, 0.0) is values
    wide = masked_blur(values, mask, 20.0)
    assert torch.isfinite(wide).all() and wide.std() < values.std()


def test_an_empty_mask_gives_finite_numbers():
    scene = sphere(SMALL)
    empty = torch.zeros_like(scene.valid)
    assert torch.isfinite(log_closed_form(scene.image(LIGHT), empty, scene.rays, LIGHT.terms(torch.float64), 0.5)).all()


@pytest.mark.parametrize("blur", [0.0, 0.25])
def test_gradient_of_the_closed_form(blur):
    scene = sphere(SMALL)
    # Channels apart from one another, so that the largest one is the same after a small step
    generator = torch.Generator().manual_seed(0)
    image = 0.2 + 0.1 * torch.rand(1, 3, 4, 5, dtype=torch.float64, generator=generator)
    image = (image + torch.tensor([0.4, 0.2, 0.0]).reshape(3, 1, 1)).requires_grad_()
    mask = scene.valid.clone()
    mask[..., 0, 0] = False
    terms = LIGHT.terms(torch.float64)
    assert torch.autograd.gradcheck(lambda i: log_closed_form(i, mask, scene.rays, terms, blur), image)
