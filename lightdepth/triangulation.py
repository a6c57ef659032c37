"""How far off a map's points are on their own: what the pixels that they were seen at leave open.

A point X seen from camera centres at distances d along unit rays r, each to sigma_px pixels of a lens with f pixels per
radian, has the information sum (f / (d sigma_px))² (I - r r') (first order). sigma_px is that of the map's own
reprojection errors, a point of m observations having 2 m - 3 of them free. Errors that neighbouring points share, as
they were tracked together or as the map has drifted, do not show in pixels.
"""

from __future__ import annotations

import numpy as np

from lightdepth.robust import mad_sigma
from lightdepth.sparse_map import Keyframe, Submap

_LEAST_INFORMATION = 1e-9  # of the largest: two rays that are one leave their distance open


class PointNoise:
    """The covariances (n, 3, 3) of the points of a submap, in their order; `sigma_px` deviates along either axis."""

    def __init__(self, submap: Submap) -> None:
        count = len(submap.points)
        information, seen = np.zeros((count, 3, 3)), np.zeros(count, int)
        residuals, of_point = [np.zeros((0, 2))], [np.zeros(0, int)]
        for keyframe in submap.keyframes:
            ids, points, pixels = submap.observed_points(keyframe)
            in_camera = keyframe.in_camera(points)
            projected, valid = keyframe.camera.project(in_camera)
            rows, to = submap.rows_of(ids)[0][valid], points[valid] - keyframe.center
            distance = np.linalg.norm(to, axis=1)
            ray = to / distance[:, None]
            per_px = (keyframe.camera.focal_length / distance) ** 2
            information[rows] += per_px[:, None, None] * (np.eye(3) - ray[:, :, None] * ray[:, None, :])
            seen[rows] += 1
            residuals.append((projected - pixels)[valid])
            of_point.append(rows)
        rows = np.concatenate(of_point)
        free = 2 * seen[rows] - 3
        widened = np.concatenate(residuals)[free > 0] * np.sqrt(2 * seen[rows] / np.maximum(free, 1))[free > 0, None]
        self._submap = submap
        self.known = seen >= 2 if not submap.weak_visibility else np.zeros(count, bool)
        self.sigma_px = mad_sigma(widened.ravel()) if len(widened) else 0.0
        values, axes = np.linalg.eigh(information)
        self.known &= values[:, 0] > _LEAST_INFORMATION * values[:, 2]
        spread = self.sigma_px**2 / np.where(self.known[:, None], values, 1)
        self.covariance = np.einsum("nik,nk,njk->nij", axes, spread, axes)

    def along(self, keyframe: Keyframe, ids: np.ndarray) -> np.ndarray:
        """Standard deviation (n,) of the log distance of points by id from a keyframe; NaN where nothing tells."""
        rows, held = self._submap.rows_of(ids)
        to = self._submap.points[rows] - keyframe.center
        square = np.maximum((to**2).sum(1), 1e-300)
        along = np.einsum("ni,nij,nj->n", to, self.covariance[rows], to) / square**2
        result: np.ndarray = np.where(held & self.known[rows], np.sqrt(along), np.nan)
        return result
