"""Light that reaches the wall from the wall.

Inside a tube every visible surface element lights every other; the direct light's cues (distance, cosine, spread) are
weakened by it. Notation: E irradiance of an element, rho the wall's reflectance, dA its area, K the form factors

    K_ij = cos_i cos_j dA_j / (pi (r_ij² + dA_j / 6)),     E = E_direct + rho K E

with rows clipped to a sum of 1, because one bounce cannot create light. Only what the camera sees takes part, and
occlusion between elements is ignored: an approximation made for speed, good enough to train against.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from lightdepth.geometry import normals_from_distance, pixel_solid_angle
from lightdepth.photometry import LightTerms, irradiance


def form_factors(points: Tensor, normals: Tensor, areas: Tensor) -> Tensor:
    """K (B, N, N) between elements: points and normals (B, N, 3), areas (B, N), zero area takes no part."""
    between = points[:, None, :, :] - points[:, :, None, :]  # from i to j
    squared = between.square().sum(-1)
    direction = between / squared.clamp(min=1e-12).sqrt()[..., None]
    cos_i = (direction * normals[:, :, None, :]).sum(-1).clamp(min=0)
    cos_j = (-direction * normals[:, None, :, :]).sum(-1).clamp(min=0)
    factors = cos_i * cos_j * areas[:, None, :] / (math.pi * (squared + areas[:, None, :] / 6).clamp(min=1e-12))
    return factors / factors.sum(-1, keepdim=True).clamp(min=1.0)


@torch.no_grad()
def indirect_irradiance(
    distance: Tensor, rays: Tensor, mask: Tensor, light: LightTerms, bounces: int = 3, pool: int = 8
) -> Tensor:
    """rho K E at every pixel (B, 1, H, W), from elements of pool x pool pixels. No gradient flows through it.

    `mask` (B, 1, H, W) marks pixels with a surface; elsewhere the result continues its surroundings and is finite.
    """
    height, width = distance.shape[-2:]
    weight = F.avg_pool2d(mask.float(), pool, ceil_mode=True)

    def pooled(values: Tensor) -> Tensor:
        return F.avg_pool2d(values * mask, pool, ceil_mode=True) / weight.clamp(min=1e-6)

    seen = weight > 0.25
    coarse_rays = F.normalize(F.avg_pool2d(rays, pool, ceil_mode=True), dim=1)
    log_distance = pooled(distance.clamp(min=1e-6).log())
    middle = (log_distance * seen).sum((-2, -1), keepdim=True) / seen.sum((-2, -1), keepdim=True).clamp(min=1)
    coarse = torch.where(seen, log_distance, middle).exp()
    normals = normals_from_distance(coarse, coarse_rays)
    direct = irradiance(coarse, normals, coarse_rays, light)

    cosine = -(normals * coarse_rays).sum(1, keepdim=True)
    areas = coarse.square() * pixel_solid_angle(coarse_rays) * weight / cosine.clamp(min=0.1) * seen
    factors = form_factors((coarse * coarse_rays).flatten(2).mT, normals.flatten(2).mT, areas.flatten(1))
    source = (direct * seen).flatten(2).mT  # (B, N, 1)
    rho = light.reflectance.reshape(-1, 1, 1)
    total = source
    for _ in range(bounces):
        total = source + rho * factors @ total
    bounced = (rho * factors @ total).mT.reshape_as(coarse).clamp(min=1e-12)
    upsampled = F.interpolate(bounced.log(), size=(height, width), mode="bilinear", align_corners=False)
    return upsampled.exp() * (rho.reshape(-1, 1, 1, 1) > 0)
