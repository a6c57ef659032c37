"""Distance, depth, normals and solid angles on scenes with closed-form answers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scenes import C3VD, ENDOMAPPER, LENSES, PINHOLE, cylinder, ray_tensors, slanted_plane, sphere

from lightdepth.camera import Pinhole
from lightdepth.datasets import read_c3vd
from lightdepth.decline import masked_blur
from lightdepth.geometry import depth_from_distance, distance_from_depth, normals_from_distance, pixel_solid_angle

SMALL = Pinhole(5, 4, 4.0, 4.5, 2.6, 1.9)


def angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Degrees between unit vectors (1, 3, H, W) -> (1, 1, H, W)."""
    return torch.rad2deg(2 * torch.asin(((a - b).norm(dim=1, keepdim=True) / 2).clamp(max=1)))


def interior(valid: torch.Tensor) -> torch.Tensor:
    """Pixels whose 3x3 neighbourhood is valid."""
    return torch.nn.functional.max_pool2d(1.0 - valid.float(), 3, 1, 1) == 0


@pytest.mark.parametrize("name", LENSES)
def test_distance_and_depth_invert_each_other_and_differ_by_the_ray(name):
    scene = slanted_plane(LENSES[name].resized(60, 48))
    ray_z = scene.rays[:, 2:]
    depth = depth_from_distance(scene.distance, ray_z)
    torch.testing.assert_close(depth, (scene.distance * scene.rays)[:, 2:])
    torch.testing.assert_close(distance_from_depth(depth, ray_z), scene.distance)
    assert (depth <= scene.distance).all()


def test_depth_of_a_plane_across_the_axis_is_constant():
    scene = slanted_plane(PINHOLE.resized(40, 30), normal=(0, 0, -1), height=7)
    torch.testing.assert_close(
        depth_from_distance(scene.distance, scene.rays[:, 2:]), torch.full_like(scene.distance, 7.0)
    )


@pytest.mark.parametrize("name", LENSES)
def test_normals_of_a_plane_are_exact_on_every_lens_and_at_the_border(name):
    scene = slanted_plane(LENSES[name].resized(72, 56))
    normals = normals_from_distance(scene.distance, scene.rays)
    where = scene.valid if scene.valid.all() else interior(scene.valid)
    assert where.double().mean() > 0.5
    assert angles(normals, scene.normals)[where].max() < 1e-4


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("surface", [sphere, cylinder], ids=["sphere", "cylinder"])
def test_normals_of_curved_walls_are_close(name, surface):
    scene = surface(LENSES[name].resized(144, 112))
    error = angles(normals_from_distance(scene.distance, scene.rays), scene.normals)[interior(scene.valid)]
    assert error.median() < 0.2
    assert error.quantile(0.95) < 1.5


def test_normals_get_better_with_the_square_of_the_resolution():
    def error(width: int) -> float:
        scene = cylinder(ENDOMAPPER.resized(width, width * 3 // 4), farthest=20)
        found = normals_from_distance(scene.distance, scene.rays)
        return float(angles(found, scene.normals)[interior(scene.valid)].median())

    assert error(120) / error(240) == pytest.approx(4, rel=0.25)


def slow_normal(points: np.ndarray, row: int, column: int) -> np.ndarray:
    """Cross product of the differences to the neighbours, one-sided at the border, turned to the camera."""
    height, width = points.shape[:2]
    across = points[row, min(column + 1, width - 1)] - points[row, max(column - 1, 0)]
    down = points[min(row + 1, height - 1), column] - points[max(row - 1, 0), column]
    normal = np.cross(across, down)
    normal /= np.linalg.norm(normal)
    return normal if normal @ points[row, column] <= 0 else -normal


def rough_distance(seed: int = 0) -> torch.Tensor:
    return 5 + torch.rand(1, 1, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_normals_agree_with_a_slow_reference_on_a_rough_surface():
    rays, distance = ray_tensors(SMALL)[0], rough_distance()
    found = normals_from_distance(distance, rays)[0].permute(1, 2, 0).numpy()
    points = (distance * rays)[0].permute(1, 2, 0).numpy()
    expected = [[slow_normal(points, row, column) for column in range(5)] for row in range(4)]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_normals_are_unit_and_face_the_camera_even_on_noise():
    rays = ray_tensors(C3VD.resized(54, 43))[0].float()
    noise = torch.rand(3, 1, 43, 54, generator=torch.Generator().manual_seed(0)) * 50 + 0.1
    normals = normals_from_distance(noise, rays)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(3, 43, 54))
    assert ((normals * rays).sum(1) <= 1e-6).all()


def test_where_the_surface_is_a_point_the_normal_looks_back_along_the_ray():
    rays = ray_tensors(SMALL)[0]
    torch.testing.assert_close(normals_from_distance(torch.zeros_like(rays[:, :1]), rays), -rays)


def test_scaling_the_distance_leaves_the_normals():
    rays, distance = ray_tensors(SMALL)[0], rough_distance()
    torch.testing.assert_close(normals_from_distance(distance * 1e-3, rays), normals_from_distance(distance, rays))


def test_gradient_of_the_normals():
    rays = ray_tensors(SMALL)[0]
    distance = rough_distance().requires_grad_()
    assert torch.autograd.gradcheck(lambda d: normals_from_distance(d, rays), distance)


def test_gradient_is_finite_where_the_surface_is_degenerate():
    distance = torch.zeros(1, 1, 4, 5, dtype=torch.float64, requires_grad=True)
    normals_from_distance(distance, ray_tensors(SMALL)[0]).square().sum().backward()
    assert torch.isfinite(distance.grad).all()


def test_solid_angles_of_a_pinhole_image_sum_to_that_of_its_rectangle():
    camera = Pinhole(160, 120, 80.0, 80.0, 80.0, 60.0)
    a, b = 1.0, 0.75  # half width and height at depth 1
    rectangle = 4 * np.arctan(a * b / np.sqrt(1 + a * a + b * b))
    angle = pixel_solid_angle(ray_tensors(camera)[0])
    assert float(angle.sum()) == pytest.approx(rectangle, rel=2e-3)


def test_solid_angle_of_a_pinhole_pixel_is_cos_cubed_over_f_squared_at_the_border_too():
    camera = Pinhole(80, 60, 200.0, 200.0, 40.0, 30.0)
    rays = ray_tensors(camera)[0]
    torch.testing.assert_close(pixel_solid_angle(rays), rays[:, 2:] ** 3 / 200.0**2, rtol=5e-3, atol=0)


def test_real_c3vd_depth_is_along_the_axis_and_its_normals_are_the_published_ones(realdata):
    folder = realdata / "c3vd_frame" / "c3vd_layout_derived"
    level = cv2.imread(str(folder / "0000_depth.tiff"), cv2.IMREAD_UNCHANGED)
    published = cv2.imread(str(folder / "0000_normals.tiff"), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(np.float64)
    assert level.dtype == np.uint16 and level.shape == (C3VD.height, C3VD.width)
    rays, valid = ray_tensors(C3VD)
    rays = rays.float()
    known = torch.from_numpy((level > 0) & (level < 65535))[None, None] & valid
    depth = torch.from_numpy(level / np.float32(655.35))[None, None]
    normals = torch.from_numpy(published / 65535 * 2 - 1).permute(2, 0, 1)[None].float()

    def median_error(distance: torch.Tensor) -> float:
        # The picture has depth steps of 0.39 mm: smooth them before taking differences
        smooth = masked_blur(distance.log(), known, 6.0).exp()
        error = angles(normals_from_distance(smooth, rays), normals / normals.norm(dim=1, keepdim=True))
        return float(error[interior(known)].median())

    (read,) = read_c3vd(folder)
    np.testing.assert_allclose(read.true_distance * C3VD.rays()[0][..., 2], (depth * known)[0, 0], atol=1e-4)
    one = torch.ones_like(depth)
    assert median_error(torch.where(known, distance_from_depth(depth, rays[:, 2:]), one)) < 3.5
    assert median_error(torch.where(known, depth, one)) > 15
