"""Distance and depth, points and normals. Pure functions on image tensors (B, C, H, W) or arrays.

Notation: distance t along the unit ray r, depth z along the optical axis, X = t r the point in camera axes. Shapes of
distance and depth (B, 1, H, W), of rays, points and normals (B, 3, H, W), unless said otherwise.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

Values = TypeVar("Values", np.ndarray, Tensor)


def length(vectors: Tensor) -> Tensor:
    """Euclidean length of (B, 3, H, W), (B, 1, H, W); its gradient is finite at zero.

    Thirty times as fast on a CPU as `norm(dim=-3)`, which strides through memory.
    """
    return vectors.square().sum(-3, keepdim=True).clamp(min=1e-24).sqrt()


def depth_from_distance(distance: Values, ray_z: Values) -> Values:
    """z = t r_z, elementwise on arrays or tensors."""
    depth: Values = distance * ray_z
    return depth


def distance_from_depth(depth: Values, ray_z: Values) -> Values:
    """t = z / r_z, elementwise on arrays or tensors. The caller keeps to rays with r_z > 0."""
    distance: Values = depth / ray_z
    return distance


def normals_from_distance(distance: Tensor, rays: Tensor) -> Tensor:
    """Unit normals of the surface t·r by central differences, facing the camera (n · r <= 0).

    At the image's border the difference is one-sided. Where the surface is degenerate the normal is -r.
    """
    points = distance * rays
    padded = F.pad(points, (1, 1, 1, 1), mode="replicate")
    along_u = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]
    along_v = padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    normal = torch.linalg.cross(along_v, along_u, dim=-3)  # v x u points to the camera where z points into the scene
    area = length(normal)
    good = area > (1e-6 * length(along_u) * length(along_v)).clamp(min=2e-12)
    normal = torch.where(good, normal / torch.where(good, area, torch.ones_like(area)), -rays)
    facing = (normal * rays).sum(-3, keepdim=True)
    return torch.where(facing > 0, -normal, normal)


def pixel_solid_angle(rays: Tensor) -> Tensor:
    """Solid angle of each pixel [sr] (B, 1, H, W), from differences of neighbouring rays, one-sided at the border."""
    du, dv = (torch.gradient(rays, dim=dim)[0] if rays.shape[dim] > 1 else torch.zeros_like(rays) for dim in (-1, -2))
    return length(torch.linalg.cross(du, dv, dim=-3))
