"""What frames of a colon show of its wall, as C3VD tells it: normals, what hides what, flow, which faces were seen.

Notation: X = o + t r the wall at a pixel, o the camera's centre, r its ray in the world, t the distance.
"""

from __future__ import annotations

import numpy as np
import torch

from lightdepth.datasets.c3vd_surface import SeenSurface
from lightdepth.frame import Frame
from lightdepth.tube.casting import EmbreeCaster
from lightdepth.tube.shape import TubeShape

_REACH_MM = 100.0
"""How far behind a wall, from the camera, C3VD looks for what it hides."""
_BEYOND_MM = 0.01
"""How far behind a hit the ray goes on, so that it does not meet the same face again."""
_SLACK = 2e-3
"""Share of the way to the wall that may lack for it to count as seen: depth is in single precision."""


class SurfaceSeen:
    """The truth of the frames of a wall at rest, one after another, and the faces that any of them saw."""

    def __init__(self, shape: TubeShape):
        self.vertices, self.faces = shape.vertices.reshape(-1, 3), shape.faces
        self.seen = np.zeros(len(self.faces), bool)
        self._normals = shape.normals.reshape(-1, 3)
        self._caster = EmbreeCaster(self.vertices, self.faces)

    def of(self, frame: Frame, before: Frame | None) -> SeenSurface:
        """The truth of a frame; `before` is the one that flow leads to."""
        assert frame.true_world_from_cam is not None
        rotation, origin = frame.true_world_from_cam[:3, :3], frame.true_world_from_cam[:3, 3]
        valid, own_rays = frame.valid, frame.camera.rays()[0][frame.valid]
        rays = own_rays @ rotation.T
        distance, face, uv = self._cast(np.broadcast_to(origin, rays.shape), rays)
        met = np.isfinite(distance)
        self.seen[np.unique(face[met & (distance * own_rays[:, 2] < _REACH_MM)])] = True
        points = origin + np.where(met, distance, 1.0)[:, None] * rays
        normals = self._facing(np.where(met, face, 0), uv, rays) @ rotation
        normals[~met] = 0
        again = np.where(met, distance, 0.0) + _BEYOND_MM
        behind = self._cast(origin + again[:, None] * rays, rays)[0]
        hides = met & (again + behind < _REACH_MM)
        flow = None
        if before is not None:
            flow = np.full((*valid.shape, 2), np.nan, np.float32)
            flow[valid] = self._flow(points, met, frame, before)
        return SeenSurface(_spread(normals, valid), _spread(hides, valid), flow)

    def _facing(self, face: np.ndarray, uv: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Unit normals (n, 3) in the world: those of the corners, blended; where they would turn away from the camera,
        the face's own."""
        corners = self.faces[face]
        weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)
        smooth = _unit((weights[..., None] * self._normals[corners]).sum(1))
        a, b, c = (self.vertices[corners[:, i]] for i in range(3))
        flat = _unit(np.cross(b - a, c - a))
        flat *= -np.sign((flat * rays).sum(1, keepdims=True))
        return np.where((smooth * rays).sum(1, keepdims=True) < 0, smooth, flat)

    def _flow(self, points: np.ndarray, met: np.ndarray, frame: Frame, before: Frame) -> np.ndarray:
        """Pixels (n, 2) from where a frame sees the points to where the one before did; NaN where it did not."""
        assert before.true_world_from_cam is not None
        camera, then = before.camera, before.true_world_from_cam
        there, in_field = camera.project((points - then[:3, 3]) @ then[:3, :3])
        inside = in_field & (there >= 0).all(1) & (there <= (camera.width, camera.height)).all(1)
        eye = np.broadcast_to(then[:3, 3], points.shape)
        hidden = self._caster.blocked(_tensor(eye), _tensor(points + _SLACK * (eye - points))).numpy()
        rows, columns = np.nonzero(frame.valid)
        here = np.stack([columns + 0.5, rows + 0.5], 1)
        result: np.ndarray = np.where((met & inside & ~hidden)[:, None], there - here, np.nan)
        return result

    def _cast(self, origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        hits = self._caster.cast(_tensor(origins), _tensor(rays))
        return hits.distance.numpy().astype(float), hits.face.numpy(), hits.uv.numpy().astype(float)


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _unit(vectors: np.ndarray) -> np.ndarray:
    result: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return result


def _spread(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Values of the pixels in (H, W) bool as an image, 0 elsewhere."""
    whole = np.zeros((*where.shape, *values.shape[1:]), values.dtype)
    whole[where] = values
    return whole
