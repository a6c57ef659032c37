"""Lenses, and scenes whose distance and normals are known in closed form on any of them.

Distance is along the ray, normals are unit and face the camera. Tensors are (1, C, H, W) float64; `valid` (1, 1, H, W)
is where the lens has a ray and the ray meets the surface. Elsewhere distance is 1 and the normal -r: all is finite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration, render
from lightdepth.prediction import DepthPrediction

PINHOLE = Pinhole(640, 480, 500.0, 505.0, 322.0, 237.5)
BROWN = Brown(1350, 1080, 802.319, 801.885, 668.286, 547.733, -0.42234, 0.10654, 1e-3, -7e-4)
ENDOMAPPER = KannalaBrandt(
    1440, 1080, 726.7941, 727.7907, 742.7416, 542.1428, -0.1289632, -0.006051189, 0.001660961, -7.847858e-05
)
C3VD = Scaramuzza(
    1350,
    1080,
    678.544839263292,
    542.975887548343,
    769.243600037458,
    0.0,
    -8.12770624150226e-4,
    6.25674244578925e-7,
    -1.19662182144280e-9,
    0.999986882249990,
    0.00288273829525059,
    -0.00296316513429569,
).with_pixel_center(0.0)
LENSES: dict[str, CameraModel] = {"pinhole": PINHOLE, "brown": BROWN, "endomapper": ENDOMAPPER, "c3vd": C3VD}


@dataclass(frozen=True)
class Scene:
    """What a camera sees of a surface. A unit of length is a millimetre."""

    camera: CameraModel
    rays: Tensor
    valid: Tensor
    distance: Tensor
    normals: Tensor

    def image(self, light: PhotometricCalibration, albedo: Tensor | float = 1.0) -> Tensor:
        """The encoded image (1, 3, H, W) under `light`, not clipped."""
        albedo = torch.as_tensor(albedo, dtype=torch.float64).expand(1, 3, *self.distance.shape[-2:])
        return render(self.distance, self.normals, self.rays, albedo, light.terms(torch.float64)) * self.valid

    def frame(self, name: str = "0000_color.png", light: PhotometricCalibration | None = None) -> Frame:
        """A frame of it, clipped to [0, 1], with its true distance."""
        light = light or PhotometricCalibration(gain=100.0)
        return Frame(
            name=name,
            image=self.image(light)[0].permute(1, 2, 0).clamp(0, 1).numpy().astype(np.float32),
            camera=self.camera,
            light=light,
            true_distance=(self.distance * self.valid)[0, 0].numpy().astype(np.float32),
        )

    def prediction(self, scale: float = 1.0, name: str = "0000_color.png") -> DepthPrediction:
        """A prediction that is right up to `scale`."""
        distance = (self.distance[0, 0] * scale).numpy().astype(np.float32)
        return DepthPrediction(name, distance, self.valid[0, 0].numpy(), self.camera, "closed form")


def ray_tensors(camera: CameraModel) -> tuple[Tensor, Tensor]:
    """Unit rays (1, 3, H, W) and validity (1, 1, H, W)."""
    rays, valid = camera.rays()
    return torch.from_numpy(rays.transpose(2, 0, 1).copy())[None], torch.from_numpy(valid.copy())[None, None]


def _scene(camera: CameraModel, rays: Tensor, valid: Tensor, distance: Tensor, normals: Tensor) -> Scene:
    valid = valid & torch.isfinite(distance) & (distance > 0)
    return Scene(camera, rays, valid, torch.where(valid, distance, 1.0), torch.where(valid, normals, -rays))


def sphere(camera: CameraModel, radius: float = 10.0) -> Scene:
    """The inside of a sphere, seen from its centre: d = radius, n = -r."""
    rays, valid = ray_tensors(camera)
    return _scene(camera, rays, valid, torch.full_like(rays[:, :1], radius), -rays)


def slanted_plane(
    camera: CameraModel, normal: tuple[float, float, float] = (0.3, -0.2, -1.0), height: float = 12.0
) -> Scene:
    """The plane n · X = -height: d = -height / (n · r). Rays that graze it, or miss it, see nothing."""
    rays, valid = ray_tensors(camera)
    direction = torch.tensor(normal, dtype=torch.float64).reshape(1, 3, 1, 1)
    direction = direction / direction.norm()
    cosine = (direction * rays).sum(1, keepdim=True)
    return _scene(camera, rays, valid & (cosine < -0.1), -height / cosine, direction.expand_as(rays))


def cylinder(camera: CameraModel, radius: float = 8.0, farthest: float = 80.0) -> Scene:
    """A tube around the optical axis, seen from inside: d = radius / sin(theta), n = -(x, y, 0) / |(x, y)|.

    It is open: nothing is seen beyond `farthest`.
    """
    rays, valid = ray_tensors(camera)
    sine = rays[:, :2].norm(dim=1, keepdim=True)
    inward = torch.cat([-rays[:, :2] / sine.clamp(min=1e-12), torch.zeros_like(sine)], 1)
    return _scene(camera, rays, valid & (sine > radius / farthest), radius / sine.clamp(min=1e-12), inward)
