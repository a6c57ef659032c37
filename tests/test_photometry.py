"""Image formation under a light that travels with the camera."""

from __future__ import annotations

import colorsys
import math

import numpy as np
import pytest
import torch
from raising import refused
from scenes import C3VD, ENDOMAPPER, LENSES, cylinder, ray_tensors, slanted_plane, sphere

from lightdepth.camera import Pinhole
from lightdepth.photometry import (
    PhotometricCalibration,
    bent,
    brightness,
    decode,
    encode,
    hue_saturation_albedo,
    irradiance,
    light_distance,
    render,
    straightened,
)

SMALL = Pinhole(5, 4, 4.0, 4.5, 2.6, 1.9)
ENDOSCOPE = PhotometricCalibration(
    gamma=2.2, mu=2.767302, position_mm=(-0.061, -1.135, -3.612), direction=(0.011092, 0.0, 0.999938), gain=90.0
)


def random_albedo(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(1, 3, height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def slow_pixel(
    distance, ray, normal, albedo, light: PhotometricCalibration, indirect=0.0, exponent=1.0, ambient=0.0, shoulder=1.0
) -> float:
    """One pixel, one channel, with scalars only, as the module's docstring writes it."""
    x = [distance * r for r in ray]
    towards = [a - p for a, p in zip(x, light.position_mm, strict=True)]
    length = math.sqrt(sum(v * v for v in towards))
    towards = [v / length for v in towards]
    aligned = sum(a * b for a, b in zip(towards, light.direction, strict=True))
    cosine = max(0.0, -sum(a * b for a, b in zip(towards, normal, strict=True)))
    direct = math.exp(-light.mu * (1 - aligned)) * cosine**exponent / length**2
    code = max(0.0, light.gain * (albedo * (direct + indirect) + ambient)) ** (1 / light.gamma)
    if code <= shoulder or shoulder == 1:
        return code
    return shoulder + 1.15 * (1 - shoulder) * (1 - math.exp(-(code - shoulder) / (1 - shoulder)))


@pytest.mark.parametrize("light", [PhotometricCalibration(gain=50.0), ENDOSCOPE], ids=["co-located", "offset"])
@pytest.mark.parametrize("exponent", [1.0, 0.7])
def test_rendering_agrees_with_a_slow_scalar_reference(light, exponent):
    scene = slanted_plane(ENDOMAPPER.resized(9, 7))
    albedo = random_albedo(7, 9)
    image = render(scene.distance, scene.normals, scene.rays, albedo, light.terms(torch.float64), 0.002, exponent)
    for row in range(7):
        for column in range(9):
            here = (0, slice(None), row, column)
            args = float(scene.distance[0, 0, row, column]), scene.rays[here].tolist(), scene.normals[here].tolist()
            expected = [slow_pixel(*args, float(a), light, 0.002, exponent) for a in albedo[here]]
            np.testing.assert_allclose(image[here], expected, rtol=1e-5 if exponent != 1 else 1e-10)


def test_stray_light_the_shoulder_and_white_agree_with_the_slow_reference():
    scene, albedo, light = slanted_plane(SMALL), random_albedo(4, 5), PhotometricCalibration(gain=6000.0)
    parts = scene.distance, scene.normals, scene.rays, albedo, light.terms(torch.float64), 0.0, 1.0, 2e-5
    image, clipped = render(*parts, shoulder=0.6), render(*parts, shoulder=0.6, saturate=True)
    assert image.min() < 0.6 and image.max() > 1  # or this would prove nothing
    assert torch.equal(clipped, image.clamp(max=1)) and not torch.allclose(image, render(*parts))
    for row in range(4):
        for column in range(5):
            here = (0, slice(None), row, column)
            args = float(scene.distance[0, 0, row, column]), scene.rays[here].tolist(), scene.normals[here].tolist()
            expected = [slow_pixel(*args, float(a), light, 0.0, 1.0, 2e-5, 0.6) for a in albedo[here]]
            np.testing.assert_allclose(image[here], expected, rtol=1e-10)


def test_a_tone_curve_is_straightened_again_and_has_gradients_everywhere():
    code = torch.linspace(0, 1.4, 57, dtype=torch.float64).requires_grad_()
    curved = bent(code, 0.7)
    assert torch.equal(curved[code <= 0.7], code[code <= 0.7]) and (curved.diff() > 0).all()
    assert curved.max() < 0.7 + 1.15 * 0.3
    torch.testing.assert_close(straightened(curved, 0.7), code)
    assert torch.equal(bent(code, 1.0), code) and torch.equal(straightened(code, 1.0), code)
    assert straightened(torch.tensor([2.0]), 0.7).isfinite().all()
    slope = torch.autograd.grad(bent(code, 0.7).sum() + straightened(curved, 0.7).sum(), code)[0]
    assert slope.isfinite().all() and (slope > 0).all()


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("scene_of", [sphere, slanted_plane, cylinder])
def test_doubling_the_distance_quarters_the_radiance(name, scene_of):
    scene = scene_of(LENSES[name].resized(40, 32))
    light = PhotometricCalibration().terms(torch.float64)
    albedo = random_albedo(32, 40)
    near = render(scene.distance, scene.normals, scene.rays, albedo, light)
    far = render(2 * scene.distance, scene.normals, scene.rays, albedo, light)
    torch.testing.assert_close(decode(far, 2.2) * 4, decode(near, 2.2))


def test_a_white_wall_facing_the_light_on_its_axis_is_white_at_distance_one():
    scene = sphere(Pinhole(1, 1, 100.0, 100.0, 0.5, 0.5), radius=1)
    torch.testing.assert_close(scene.image(PhotometricCalibration()), torch.ones(1, 3, 1, 1, dtype=torch.float64))


def test_the_wall_gets_darker_by_the_spread_of_the_light_away_from_its_axis():
    scene = sphere(ENDOMAPPER.resized(72, 54), radius=1)
    linear = scene.image(PhotometricCalibration(gamma=1.0, mu=2.767))
    expected = torch.exp(-2.767 * (1 - scene.rays[:, 2:])).expand(-1, 3, -1, -1)
    torch.testing.assert_close(linear, expected * scene.valid)
    assert (scene.image(PhotometricCalibration(gamma=1.0, mu=0.0))[scene.valid.expand(1, 3, -1, -1)] > 0.999).all()


def test_gain_and_albedo_multiply_linear_radiance():
    scene = slanted_plane(C3VD.resized(20, 16))
    one, nine = (decode(scene.image(PhotometricCalibration(gain=g)), 2.2) for g in (1.0, 9.0))
    torch.testing.assert_close(nine, 9 * one)
    torch.testing.assert_close(decode(scene.image(PhotometricCalibration(), 0.25), 2.2), 0.25 * one)


def test_light_offset_matters_near_and_vanishes_far():
    def change(radius: float) -> float:
        scene = slanted_plane(ENDOMAPPER.resized(36, 27), height=radius)
        terms = ENDOSCOPE.terms(torch.float64)
        args = scene.distance, scene.normals, scene.rays
        ratio = irradiance(*args, terms) / irradiance(*args, terms.co_located())
        return float((ratio[scene.valid].log() - ratio[scene.valid].log().mean()).abs().max())

    assert change(5.0) > 0.2
    assert change(5000.0) < 0.03


def test_surfaces_turned_away_from_the_light_get_none_of_it():
    scene = slanted_plane(SMALL)
    light = PhotometricCalibration().terms(torch.float64)
    assert (irradiance(scene.distance, -scene.normals, scene.rays, light) == 0).all()
    assert (irradiance(scene.distance, -scene.normals, scene.rays, light, cosine_floor=0.03) > 0).all()


def test_distance_to_a_light_at_the_camera_is_the_distance():
    scene = slanted_plane(SMALL)
    length, towards = light_distance(scene.distance, scene.rays, PhotometricCalibration().terms(torch.float64))
    torch.testing.assert_close(length, scene.distance)
    torch.testing.assert_close(towards, scene.rays)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.6, 2.2, 3.2])
def test_encode_and_decode_invert_each_other(gamma):
    linear = torch.linspace(0, 2, 401, dtype=torch.float64)
    torch.testing.assert_close(decode(encode(linear, gamma), gamma), linear)
    per_image = torch.full((2, 1, 1, 1), gamma, dtype=torch.float64)
    image = torch.rand(2, 3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(encode(decode(image, per_image), per_image), image)


def test_negative_radiance_is_black():
    assert encode(torch.tensor([-1.0, 0.0]), 2.2).tolist() == [0, 0]
    assert decode(torch.tensor([-1.0, 0.0]), 2.2).tolist() == [0, 0]


def test_albedo_agrees_with_colorsys_and_has_value_one():
    grid = torch.rand(1, 2, 30, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    grid[0, :, 0, :4] = torch.tensor([[0.0, 1.0, 0.5, 0.5], [1.0, 1.0, 1.0, 0.0]])
    albedo = hue_saturation_albedo(grid)[0].permute(1, 2, 0)
    expected = [
        [colorsys.hsv_to_rgb((h + 0.5) % 1, s, 1.0) for h, s in zip(*row, strict=True)]
        for row in grid[0].permute(1, 0, 2).tolist()
    ]
    np.testing.assert_allclose(albedo, expected, atol=1e-12)
    torch.testing.assert_close(brightness(hue_saturation_albedo(grid)), torch.ones(1, 1, 30, 40, dtype=torch.float64))


def test_red_sits_in_the_middle_of_the_hue_channel():
    red = hue_saturation_albedo(torch.tensor([0.5, 1.0]).reshape(1, 2, 1, 1))
    assert red.flatten().tolist() == pytest.approx([1, 0, 0], abs=1e-6)
    around = hue_saturation_albedo(torch.tensor([[0.49, 0.51], [0.8, 0.8]]).reshape(1, 2, 1, 2))
    assert (around[0, 0] == 1).all() and (around[0, 1:].amax(0) < 0.3).all()


def test_brightness_carries_no_albedo_whose_value_is_one():
    scene, light = slanted_plane(C3VD.resized(30, 24)), PhotometricCalibration(gain=90.0)
    albedo = hue_saturation_albedo(random_albedo(24, 30)[:, :2])
    torch.testing.assert_close(brightness(scene.image(light, albedo)), brightness(scene.image(light)))


def test_gradient_of_irradiance():
    scene, light = slanted_plane(SMALL), ENDOSCOPE.terms(torch.float64)
    distance, normals = scene.distance.clone().requires_grad_(), scene.normals.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda d, n: irradiance(d, n, scene.rays, light), (distance, normals))
    assert torch.autograd.gradcheck(lambda d, n: irradiance(d, n, scene.rays, light, 0.7, 0.03), (distance, normals))


def test_gradient_of_the_rendered_image():
    scene, light = slanted_plane(SMALL), ENDOSCOPE.terms(torch.float64)
    inputs = [t.clone().requires_grad_() for t in (scene.distance, scene.normals, random_albedo(4, 5) + 0.1)]
    assert torch.autograd.gradcheck(lambda d, n, a: render(d, n, scene.rays, a, light), inputs)


def test_gradient_is_finite_where_the_image_is_black():
    scene, light = slanted_plane(SMALL), PhotometricCalibration().terms(torch.float64)
    distance, normals = scene.distance.clone().requires_grad_(), (-scene.normals).clone().requires_grad_()
    albedo = torch.zeros(1, 3, 4, 5, dtype=torch.float64, requires_grad=True)
    render(distance, normals, scene.rays, albedo, light).sum().backward()
    assert all(torch.isfinite(t.grad).all() for t in (distance, normals, albedo))


def test_light_terms_broadcast_over_a_batch():
    rays = ray_tensors(SMALL)[0]
    light = PhotometricCalibration(gain=3.0).terms(torch.float64)
    batch = type(light)(*(torch.cat([t, t]) for t in light))
    scene = slanted_plane(SMALL)
    twice = [t.expand(2, -1, -1, -1) for t in (scene.distance, scene.normals, rays, random_albedo(4, 5))]
    image = render(*twice, batch)
    torch.testing.assert_close(image[0], image[1])
    torch.testing.assert_close(image[:1], render(scene.distance, scene.normals, rays, random_albedo(4, 5), light))


def test_direction_is_normalised_at_birth():
    light = PhotometricCalibration(direction=(0, 3, 4))
    assert light.direction == pytest.approx((0, 0.6, 0.8))
    assert light.terms().direction.shape == (1, 3, 1, 1) and light.terms().gamma.shape == (1, 1, 1, 1)


def test_a_co_located_light_sits_at_the_camera_and_looks_along_the_axis():
    light = ENDOSCOPE.co_located()
    assert (light.position_mm, light.direction, light.mu) == ((0, 0, 0), (0, 0, 1), ENDOSCOPE.mu)
    for ours, theirs in zip(light.terms(), ENDOSCOPE.terms().co_located(), strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gamma": 0.0}, "gamma 0.0"),
        ({"gamma": 22.0}, "gamma 22.0"),
        ({"mu": -1.0}, "mu -1.0"),
        ({"gain": 0.0}, "gain 0.0"),
        ({"reflectance": 1.0}, "reflectance 1.0"),
        ({"reflectance": -0.1}, "reflectance -0.1"),
        ({"direction": (0, 0, 0)}, "direction is zero"),
        ({"gamma": math.nan}, "not finite"),
        ({"position_mm": (0, math.inf, 0)}, "not finite"),
        ({"position_mm": (0, 0)}, "3 numbers"),
        ({"direction": (0, 1)}, "3 numbers"),
    ],
    ids=lambda x: str(x) if isinstance(x, dict) else "",
)
def test_a_light_that_cannot_be_is_refused(wrong, message):
    with refused(message):
        PhotometricCalibration(**wrong)


@pytest.mark.parametrize(
    "limits",
    [{"gamma": 0.2}, {"gamma": 10.0}, {"mu": 0.0}, {"gain": 1e-3}, {"reflectance": 0.0}, {"reflectance": 0.99}],
)
def test_a_light_at_its_limits_is_taken(limits):
    light = PhotometricCalibration(**limits)
    assert {name: getattr(light, name) for name in limits} == limits and light.assumed
    assert not PhotometricCalibration(source="given").assumed
