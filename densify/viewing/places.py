"""What of a surface is drawn alike by every viewer: colours, size, and where its cameras were."""

from __future__ import annotations

import numpy as np

from lightdepth.reporting.scene import Layer, Surface

USED, LEFT_OUT, CHOSEN, PATH = (41, 128, 217), (140, 140, 140), (255, 158, 26), (41, 128, 217)
"""Colours of cameras and of the path, those of a report's scene."""


def vertex_colors(layer: Layer, count: int) -> np.ndarray:
    """The colours (n, 3) in [0, 1] of `count` vertices, also where all have one."""
    colors = layer.colors()
    if colors is not None:
        return colors
    one = np.full(3, 0.8) if layer.palette is None else layer.palette[0] / 255
    return np.broadcast_to(one, (count, 3))


def extent(surface: Surface) -> float:
    """The longest side of the box around a surface."""
    return float(np.ptp(surface.vertices, axis=0).max()) if len(surface.vertices) else 1.0


def centers(surface: Surface) -> np.ndarray:
    """Where its cameras were (n, 3)."""
    poses = [p.cam_from_map for p in surface.poses]
    return np.array([-p[:3, :3].T @ p[:3, 3] for p in poses]).reshape(-1, 3)
