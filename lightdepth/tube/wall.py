"""Maps over the wall of a tube, sampled between their texels on any device.

A map has its rows along s, from one end to the other, and its columns along phi, where it wraps. A place on the wall is
(phi, s), each from -1 to 1: -1 to 1 of phi is once around, whatever the map's size.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor


class WallMap(NamedTuple):
    """values (B or 1, C, R, W + 1): the first column stands again at the end."""

    values: Tensor

    @classmethod
    def of(cls, values: Tensor) -> WallMap:
        """From values (B or 1, R, W, C)."""
        return cls(torch.cat([values, values[:, :, :1]], 2).permute(0, 3, 1, 2).contiguous())

    def at(self, place: Tensor) -> Tensor:
        """Samples (B, C, P), bilinear, at places (B, P, 2); one map serves all views."""
        shared = len(self.values) == 1
        grid = place[None] if shared else place[:, None]  # (1, B, P, 2) or (B, 1, P, 2)
        found = F.grid_sample(self.values, grid, mode="bilinear", padding_mode="border", align_corners=True)
        return found[0].transpose(0, 1) if shared else found[:, :, 0]


def place_of(faces: Tensor, uvs: Tensor, grid: tuple[int, ...]) -> Tensor:
    """Places (..., 2) of hits on a mesh of TubeShape.faces over a grid of (rings, spokes)."""
    rings, spokes = grid
    cell, second = faces // 2, faces % 2 == 1
    w1, w2 = uvs.unbind(-1)
    # Triangles (a, b, c) and (b, d, c) of a cell with a (0, 0), b (0, 1), c (1, 0), d (1, 1) as (ring, spoke).
    ring = cell // spokes + torch.where(second, w1 + w2, w2)
    spoke = cell % spokes + torch.where(second, 1 - w2, w1)
    return torch.stack([2 * spoke / spokes - 1, 2 * ring / (rings - 1) - 1], -1)
