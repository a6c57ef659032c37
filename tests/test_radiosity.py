"""Light that reaches the wall from the wall."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scenes import C3VD, ENDOMAPPER, PINHOLE, Scene, cylinder, ray_tensors, slanted_plane, sphere

from lightdepth.camera import Pinhole
from lightdepth.frame import to_batch
from lightdepth.geometry import pixel_solid_angle
from lightdepth.photometry import PhotometricCalibration
from lightdepth.radiosity import form_factors, indirect_irradiance

CAMERA = C3VD.resized(135, 108)


def lit(reflectance: float, mu: float = 2.767):
    return PhotometricCalibration(reflectance=reflectance, mu=mu).terms(torch.float64)


def indirect(scene, reflectance: float = 0.6, mu: float = 2.767, **options) -> torch.Tensor:
    return indirect_irradiance(scene.distance, scene.rays, scene.valid, lit(reflectance, mu), **options)


def sphere_from(aside: float, radius: float = 10.0) -> Scene:
    """The inside of a sphere whose centre is that far beside the camera."""
    rays, valid = ray_tensors(CAMERA)
    middle = torch.tensor([aside, 0.0, 0.0], dtype=torch.float64).reshape(1, 3, 1, 1)
    along = (rays * middle).sum(1, keepdim=True)
    distance = along + (along.square() + radius**2 - aside**2).sqrt()
    return Scene(CAMERA, rays, valid, torch.where(valid, distance, 1.0), (middle - distance * rays) / radius)


def fibonacci_sphere(n: int) -> torch.Tensor:
    """Points (n, 3) spread evenly over the unit sphere."""
    k = np.arange(n) + 0.5
    z, phi = 1 - 2 * k / n, math.pi * (1 + math.sqrt(5)) * k
    side = np.sqrt(1 - z * z)
    return torch.from_numpy(np.stack([side * np.cos(phi), side * np.sin(phi), z], -1))


def test_form_factors_inside_a_sphere_are_the_share_of_its_area():
    radius, n = 7.0, 600
    points = radius * fibonacci_sphere(n)
    areas = torch.full((1, n), 4 * math.pi * radius**2 / n, dtype=torch.float64)
    factors = form_factors(points[None], -points[None] / radius, areas)[0]
    far = torch.cdist(points, points) > 5 * math.sqrt(float(areas[0, 0]))
    torch.testing.assert_close(factors[far] * n, torch.ones(int(far.sum()), dtype=torch.float64), rtol=0.01, atol=0)
    torch.testing.assert_close(factors.sum(1), torch.ones(n, dtype=torch.float64), rtol=0.03, atol=0)


def test_form_factors_agree_with_a_slow_reference():
    rng = np.random.default_rng(0)
    points, normals, areas = rng.normal(size=(8, 3)) * 5, rng.normal(size=(8, 3)), rng.uniform(0, 1, 8)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = np.zeros((8, 8))
    for i in range(8):
        for j in range(8):
            if i != j:
                towards = points[j] - points[i]
                r2 = towards @ towards
                towards /= math.sqrt(r2)
                cosines = max(0.0, normals[i] @ towards) * max(0.0, -normals[j] @ towards)
                expected[i, j] = cosines * areas[j] / (math.pi * (r2 + areas[j] / 6))
    expected /= np.maximum(expected.sum(1, keepdims=True), 1)
    found = form_factors(*(torch.from_numpy(a)[None] for a in (points, normals, areas)))[0]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert expected.max() > 1e-3


def test_one_bounce_never_creates_light():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 50, 3, generator=generator)
    normals = torch.nn.functional.normalize(-points, dim=-1)
    for size in (0.01, 1.0, 100.0):
        sums = form_factors(points, normals, torch.full((2, 50), size)).sum(-1)
        assert (sums <= 1 + 1e-5).all() and (sums >= 0).all()


def test_elements_without_area_take_no_part_and_none_lights_itself():
    points = fibonacci_sphere(40)[None]
    areas = torch.full((1, 40), 0.3, dtype=torch.float64)
    areas[0, 5:9] = 0
    factors = form_factors(points, -points, areas)[0]
    assert (factors[:, 5:9] == 0).all()
    assert (factors.diagonal() == 0).all()


@pytest.mark.parametrize("mu", [0.0, 2.767])
@pytest.mark.parametrize("reflectance", [0.2, 0.6])
@pytest.mark.parametrize(
    "camera", [CAMERA, ENDOMAPPER.resized(144, 108), PINHOLE.resized(160, 120)], ids=lambda c: c.name
)
def test_indirect_light_in_a_sphere_is_the_constant_of_the_integrating_sphere(camera, mu, reflectance):
    """Every element of a sphere gets rho times the mean of what all get, however that is spread, at each bounce."""
    scene = sphere(camera, radius=10)
    batch = to_batch(scene.frame(light=PhotometricCalibration(mu=mu, reflectance=reflectance)))
    found = indirect_irradiance(batch.true_distance, batch.rays, batch.mask, batch.light)[batch.mask]
    solid = pixel_solid_angle(scene.rays) * scene.valid
    fall = torch.exp(-mu * (1 - scene.rays[:, 2:])) / 100
    share = reflectance * float(solid.sum()) / (4 * math.pi)
    first = reflectance * float((solid * fall).sum()) / (4 * math.pi)
    assert float(found.mean()) == pytest.approx(first * (1 + share + share**2 + share**3), rel=0.15)
    assert float(found.std() / found.mean()) < 0.05


@pytest.mark.parametrize("aside", [0.0, 5.0, 8.0])
def test_indirect_light_in_a_sphere_does_not_hang_on_the_slant_at_which_its_wall_is_seen(aside):
    """From anywhere in it: the mean over the sphere of what its parts get, which is a sum over true areas."""
    scene = sphere_from(aside)
    found = indirect(scene, mu=0.0, bounces=1, pool=4)[scene.valid]
    cosine = -(scene.normals * scene.rays).sum(1, keepdim=True)
    areas = scene.distance.square() * pixel_solid_angle(scene.rays) / cosine * scene.valid
    direct = cosine / scene.distance.square()
    share = 0.6 / (4 * math.pi * 10.0**2)
    first = share * float((areas * direct).sum())
    expected = first * (1 + share * float(areas.sum()))
    print(f"{aside}: {float(found.median()) / expected:.3f} of the closed form")
    assert float(found.median()) == pytest.approx(expected, rel=0.03)


def test_zero_reflectance_gives_zero():
    assert (indirect(cylinder(CAMERA), reflectance=0.0) == 0).all()


def test_more_reflectance_and_more_bounces_give_more_light():
    scene = cylinder(CAMERA)
    dim, bright = indirect(scene, 0.3), indirect(scene, 0.6)
    assert (bright[scene.valid] > 2 * dim[scene.valid]).all()
    assert (indirect(scene, bounces=6) >= indirect(scene, bounces=1)).all()


def test_a_plane_does_not_light_itself():
    scene = slanted_plane(PINHOLE.resized(160, 120))
    assert scene.valid.all()
    assert indirect(scene).max() < 1e-3 / 12**2


def test_indirect_light_falls_with_the_square_of_the_size_of_the_scene():
    near, far = cylinder(CAMERA, radius=5, farthest=50), cylinder(CAMERA, radius=20, farthest=200)
    torch.testing.assert_close(indirect(far) * 16, indirect(near))


@pytest.mark.parametrize(
    "camera", [C3VD.resized(90, 72), ENDOMAPPER.resized(93, 71), Pinhole(5, 4, 4.0, 4.0, 2.5, 2.0)]
)
def test_no_nan_with_masked_corners_odd_sizes_or_an_empty_mask(camera):
    scene = cylinder(camera, radius=2, farthest=60)
    axis_outside = torch.where(scene.valid, scene.rays, torch.tensor([0.0, 0, 1]).double().reshape(3, 1, 1))  # to_batch
    for mask in (scene.valid, torch.zeros_like(scene.valid), torch.ones_like(scene.valid)):
        found = indirect_irradiance(scene.distance, axis_outside, mask, lit(0.6))
        assert found.shape == scene.distance.shape
        assert torch.isfinite(found).all() and (found >= 0).all()


def test_what_lies_outside_the_mask_changes_nothing_inside():
    scene = sphere(CAMERA)
    mask = scene.valid.clone()
    mask[..., :48] = False
    other = torch.where(mask, scene.distance, 1e4)
    light = lit(0.6)
    ours = indirect_irradiance(scene.distance, scene.rays, mask, light)
    torch.testing.assert_close(indirect_irradiance(other, scene.rays, mask, light), ours)


def test_each_image_of_a_batch_keeps_its_own_reflectance():
    scene = sphere(CAMERA)
    light = lit(0.6)
    batch = type(light)(*(torch.cat([t, t]) for t in light))._replace(
        reflectance=torch.tensor([0.0, 0.6], dtype=torch.float64).reshape(2, 1, 1, 1)
    )
    twice = [t.expand(2, -1, -1, -1) for t in (scene.distance, scene.rays, scene.valid)]
    found = indirect_irradiance(*twice, batch)
    assert (found[0] == 0).all()
    torch.testing.assert_close(found[1:], indirect(scene))


def test_the_middle_of_an_element_has_the_element_s_own_light_to_the_border_of_the_image():
    """What the same wall gets when each of its squares is a pixel."""
    scene = cylinder(Pinhole(24, 18, 14.0, 14.0, 12.0, 9.0), farthest=math.inf)
    assert scene.valid.all()
    distance = F.avg_pool2d(scene.distance.log(), 3).exp()
    rays = F.normalize(F.avg_pool2d(scene.rays, 3), dim=1)
    expected = indirect_irradiance(distance, rays, torch.ones_like(distance, dtype=torch.bool), lit(0.6), pool=1)
    assert float(expected.max() / expected.min()) > 1.5
    torch.testing.assert_close(indirect(scene, pool=3)[..., 1::3, 1::3], expected)


def test_no_gradient_flows_through_it():
    rays, valid = ray_tensors(CAMERA)
    distance = torch.full_like(rays[:, :1], 5.0).requires_grad_()
    assert not indirect_irradiance(distance, rays, valid, lit(0.6)).requires_grad
