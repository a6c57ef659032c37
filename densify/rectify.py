"""Distance on any lens -> depth of pinhole views, which TSDF fusion needs.

A pinhole camera is one view. Any other lens becomes faces of a cube around the camera centre, each 90 degrees wide,
only those that its field touches: together they hold every direction in front exactly once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from lightdepth.camera import CameraModel, Pinhole
from lightdepth.prediction import DepthPrediction


@dataclass(frozen=True)
class RectifyConfig:
    """Which predicted pixels are handed to the fusion, and how finely."""

    focal_px: float = 256.0  # resolution of the views, pixels per radian at most
    max_jump: float = 0.15  # a step in log distance between neighbouring view pixels above this is an edge: left out
    min_cosine: float = 0.05  # cosine between ray and normal below this is grazing: left out


@dataclass(frozen=True)
class PinholeView:
    """depth (H, W) float32 along the view's axis, 0 where nothing is known; color (H, W, 3) float32;
    matrix K (3, 3), first pixel's centre at (0.5, 0.5); view_from_cam (4, 4)."""

    depth: np.ndarray
    color: np.ndarray
    matrix: np.ndarray
    view_from_cam: np.ndarray


@dataclass(frozen=True)
class _Grid:
    """Where each pixel of a view looks: source pixels (H, W, 2), their validity, unit rays (H, W, 3) in view axes."""

    pixels: np.ndarray
    valid: np.ndarray
    rays: np.ndarray
    matrix: np.ndarray
    view_from_cam: np.ndarray


_FACES = {  # rows: the view's x, y, z axes in camera axes
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


@lru_cache(maxsize=8)
def _grids(camera: CameraModel, focal_px: float) -> tuple[_Grid, ...]:
    if isinstance(camera, Pinhole):
        shrink = min(1.0, focal_px / camera.focal_length)
        small = camera.resized(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))
        rays, _ = small.rays()
        return (_grid(camera, rays, small.matrix, np.eye(3)),)
    half = round(min(focal_px, camera.focal_length))
    matrix = np.array([[half, 0, half], [0, half, half], [0, 0, 1.0]])
    rays, _ = Pinhole(2 * half, 2 * half, half, half, half, half).rays()
    grids = (_grid(camera, rays, matrix, np.array(axes, float)) for axes in _FACES.values())
    return tuple(_cropped(grid) for grid in grids if grid.valid.any())


def _grid(camera: CameraModel, rays: np.ndarray, matrix: np.ndarray, view_from_cam: np.ndarray) -> _Grid:
    pixels, valid = camera.project(rays @ view_from_cam)
    pose = np.eye(4)
    pose[:3, :3] = view_from_cam
    return _Grid(pixels.astype(np.float32), valid, rays, matrix, pose)


def _cropped(grid: _Grid) -> _Grid:
    """The part of a face that the field touches."""
    rows, columns = np.flatnonzero(grid.valid.any(1)), np.flatnonzero(grid.valid.any(0))
    r, c = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    matrix = grid.matrix.copy()
    matrix[:2, 2] -= (c.start, r.start)
    return _Grid(grid.pixels[r, c], grid.valid[r, c], grid.rays[r, c], matrix, grid.view_from_cam)


def pinhole_views(
    prediction: DepthPrediction, image: np.ndarray, config: RectifyConfig, max_distance: float = np.inf
) -> Iterator[PinholeView]:
    """Views of a (scaled) prediction with the image (H, W, 3) as colour; beyond max_distance nothing is known.

    A view pixel is known only where the source pixels around it are all valid.
    """
    distance = np.where(prediction.valid, prediction.distance, 0).astype(np.float32)
    known = prediction.valid.astype(np.float32)
    for grid in _grids(prediction.camera, config.focal_px):
        x, y = grid.pixels[..., 0] - 0.5, grid.pixels[..., 1] - 0.5  # cv2 puts the first pixel's centre at (0, 0)
        sampled = cv2.remap(distance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        share = cv2.remap(known, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        color = cv2.remap(image.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        use = grid.valid & (share > 0.999) & (sampled > 0) & (sampled <= max_distance)
        use &= ~_edges(sampled, use, config.max_jump) & ~_grazing(sampled, grid.rays, config.min_cosine)
        depth = np.where(use, sampled * grid.rays[..., 2], 0).astype(np.float32)
        if use.any():
            yield PinholeView(depth, np.ascontiguousarray(color), grid.matrix, grid.view_from_cam)


def _edges(distance: np.ndarray, known: np.ndarray, max_jump: float) -> np.ndarray:
    """Pixels on either side of a jump of log distance: their depth is a mixture, and fusing it makes curtains."""
    log = np.log(np.where(known, distance, 1.0))
    edge = np.zeros(distance.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(log, axis=axis)) > max_jump
        both = known.take(range(1, known.shape[axis]), axis) & known.take(range(known.shape[axis] - 1), axis)
        jump &= both
        padding = [(0, 0), (0, 0)]
        padding[axis] = (0, 1)
        edge |= np.pad(jump, padding)
        padding[axis] = (1, 0)
        edge |= np.pad(jump, padding)
    return edge


def _grazing(distance: np.ndarray, rays: np.ndarray, min_cosine: float) -> np.ndarray:
    points = distance[..., None] * rays
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    length = np.linalg.norm(normals, axis=-1)
    cosine = np.abs((normals * rays).sum(-1)) / np.where(length > 0, length, 1)
    return cosine < min_cosine
