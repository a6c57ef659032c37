"""The paper's fusion, for `recipe: paper`: one undistorted pinhole image per keyframe, Open3D's TSDF, marching cubes.

Nothing is weighted and nothing is filtered; what the undistorted image cannot hold is cropped. The undistorted image
has the size of the image and the focal length that the lens has at its centre, as undistortion gives it by default.

The traps of Open3D 0.20: the legacy volume silently gives empty meshes, so it is not used; depth is in map units
(depth_scale 1, an explicit depth_max); K is in the corner convention, which is ours; depth that is not finite or all
zero must not reach the grid; weights count views and the threshold is strict.
"""

from __future__ import annotations

import cv2
import numpy as np

from lightdepth import native
from lightdepth.camera import CameraModel, Pinhole
from lightdepth.prediction import DepthPrediction


def undistorted_camera(camera: CameraModel) -> Pinhole:
    """The pinhole of the same size, with the lens's focal length at its centre and its principal point."""
    if isinstance(camera, Pinhole):
        return camera
    (centre,), _ = camera.project(np.array([[0.0, 0, 1]]))
    f = camera.focal_length
    return Pinhole(camera.width, camera.height, f, f, float(centre[0]), float(centre[1]))


def undistorted(
    prediction: DepthPrediction, image: np.ndarray, max_distance: float = np.inf
) -> tuple[np.ndarray, np.ndarray, Pinhole]:
    """Depth (H, W) float32 along the axis, 0 where nothing is known or it is beyond max_distance along the ray, colour
    (H, W, 3) and the pinhole camera of both."""
    pinhole = undistorted_camera(prediction.camera)
    rays, _ = pinhole.rays()
    pixels, seen = prediction.camera.project(rays.reshape(-1, 3))
    x, y = (pixels.reshape(*rays.shape[:2], 2) - 0.5).astype(np.float32).transpose(2, 0, 1)  # cv2 counts from centres
    known = cv2.remap(prediction.valid.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0)
    given = np.where(prediction.valid, prediction.distance, 0).astype(np.float32)
    distance = cv2.remap(given, x, y, cv2.INTER_LINEAR)
    color = cv2.remap(np.ascontiguousarray(image, np.float32), x, y, cv2.INTER_LINEAR)
    use = seen.reshape(known.shape) & (known > 0.999) & (distance > 0) & (distance <= max_distance)
    return np.where(use, distance * rays[..., 2], 0).astype(np.float32), color, pinhole


class PlainTsdf:
    """Open3D's truncated signed distance volume. `voxel` in map units, `truncation` in voxels."""

    def __init__(self, voxel: float, truncation: float):
        o3d = native.open3d()
        float32 = o3d.core.float32
        self._truncation, self._views = truncation, 0
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), (float32,) * 3, ((1), (1), (3)), voxel, 8, 2000, o3d.core.Device("CPU:0")
        )

    def integrate(self, depth: np.ndarray, color: np.ndarray, camera: Pinhole, cam_from_map: np.ndarray) -> None:
        """Adds what `undistorted` gave, of a keyframe whose pose is cam_from_map (4, 4)."""
        o3d, known = native.open3d(), np.where(np.isfinite(depth), depth, 0)
        if not (known > 0).any():
            return
        images = [o3d.t.geometry.Image(np.ascontiguousarray(a, np.float32)) for a in (known, color)]
        matrices = [o3d.core.Tensor(np.ascontiguousarray(m, np.float64)) for m in (camera.matrix, cam_from_map)]
        reach = (1.0, float(known.max()) * 1.001, self._truncation)  # depth_scale, depth_max, truncation
        blocks = self._grid.compute_unique_block_coordinates(images[0], *matrices, *reach)
        self._grid.integrate(blocks, *images, *matrices, *reach)
        self._views += 1

    def extract_mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """vertices (n, 3) in map units, triangles (m, 3), colors (n, 3) in [0, 1]; all empty when nothing was seen."""
        mesh = self._grid.extract_triangle_mesh(weight_threshold=0.0) if self._views else None
        if mesh is None or "positions" not in mesh.vertex or "indices" not in mesh.triangle:
            return np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3))
        vertices, colors = (mesh.vertex[k].numpy().astype(np.float64) for k in ("positions", "colors"))
        return vertices, mesh.triangle.indices.numpy().astype(int), np.clip(colors, 0, 1)
