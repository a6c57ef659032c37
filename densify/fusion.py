"""TsdfVolume: views with depth in, one surface out, over Open3D's VoxelBlockGrid.

The traps of Open3D 0.20 that are handled here, and nowhere else: the legacy volume silently gives empty meshes, so it
is not used; depth is in map units (depth_scale 1, an explicit depth_max); K is in the corner convention, which is ours;
depth that is not finite or all zero must not reach the grid; weights count views and the threshold is strict.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from densify.rectify import PinholeView
from lightdepth import native
from lightdepth.errors import InputError


@dataclass(frozen=True)
class FusionConfig:
    """Resolution and reach of the surface."""

    voxel: float | None = None  # map units; by default a typical observed distance over voxels_per_distance
    voxels_per_distance: float = 52.0
    # Voxels. Exact depth is best at 4 (folds bleed beyond); predicted depth leaves a sieve at grazing walls there, and
    # is better at 6 in accuracy, withheld-point error and coverage alike.
    truncation: float = 6.0
    min_views: int = 1  # a surface voxel must be seen by at least this many views
    far: float = 2.0  # predictions beyond far times the 90th percentile of a keyframe's inlier distances are left out


class TsdfVolume:
    """A truncated signed distance volume that grows where depth is seen. `voxel` in map units."""

    def __init__(self, voxel: float, config: FusionConfig, block_count: int = 2000):
        if not np.isfinite(voxel) or voxel <= 0:
            raise InputError(f"voxel size {voxel}; expected a positive length in map units")
        self.voxel = voxel
        self._config = config
        self._o3d = native.open3d()
        core = self._o3d.core
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.float32, core.float32),
            ((1), (1), (3)),
            voxel,
            8,
            block_count,
            core.Device("CPU:0"),
        )
        self.views = 0

    def integrate(self, view: PinholeView, cam_from_map: np.ndarray) -> None:
        """Adds one view of a keyframe whose pose is cam_from_map (4, 4)."""
        depth = np.where(np.isfinite(view.depth), view.depth, 0).astype(np.float32)
        if not (depth > 0).any():
            return
        o3d = self._o3d
        image = o3d.t.geometry.Image(np.ascontiguousarray(depth))
        color = o3d.t.geometry.Image(np.ascontiguousarray(view.color, np.float32))
        matrix = o3d.core.Tensor(np.ascontiguousarray(view.matrix, np.float64))
        pose = o3d.core.Tensor(np.ascontiguousarray(view.view_from_cam @ cam_from_map, np.float64))
        reach = (1.0, float(depth.max()) * 1.001, self._config.truncation)  # depth_scale, depth_max, truncation
        blocks = self._grid.compute_unique_block_coordinates(image, matrix, pose, *reach)
        self._grid.integrate(blocks, image, color, matrix, pose, *reach)
        self.views += 1

    def extract_mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """vertices (n, 3) in map units, triangles (m, 3), colors (n, 3) in [0, 1]; all empty when nothing was seen."""
        empty = np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3))
        if not self.views:
            return empty
        mesh = self._grid.extract_triangle_mesh(weight_threshold=float(self._config.min_views - 1))
        if "positions" not in mesh.vertex or "indices" not in mesh.triangle:
            return empty
        vertices = mesh.vertex.positions.numpy().astype(np.float64)
        colors = mesh.vertex.colors.numpy().astype(np.float64) if "colors" in mesh.vertex else np.ones_like(vertices)
        return vertices, mesh.triangle.indices.numpy().astype(int), np.clip(colors, 0, 1)
