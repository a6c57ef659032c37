"""How smooth a mesh is to the eye: the share of its edges at which the surface turns by more than 30 degrees.

Steps, seams and noise of a few tenths of a millimetre hardly show in distances to the truth, but shade a surface; wall
turns so sharply at few edges only. Each edge counts once, whatever its length; what has one face or no area counts not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TURN_DEG = 30.0


class Edges(NamedTuple):
    """Numbers of edges between two faces: those at which the surface turns by more than TURN_DEG, and all."""

    sharp: int
    all: int

    @property
    def share(self) -> float | None:
        """Of the sharp ones; None where there are no edges."""
        return self.sharp / self.all if self.all else None


NO_EDGES = Edges(0, 0)


def edges(vertices: np.ndarray, triangles: np.ndarray) -> Edges:
    """Of a mesh with vertices (n, 3) and triangles (m, 3) that turn their front alike."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= length[:, None] + 1e-300
    ends = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), 1)
    names = ends[:, 0].astype(np.int64) * (len(vertices) + 1) + ends[:, 1]
    order = np.argsort(names, kind="stable")
    face = np.tile(np.arange(len(triangles)), 3)[order]
    twice = np.flatnonzero(names[order][1:] == names[order][:-1])
    one, two = face[twice], face[twice + 1]
    whole = (length[one] > 0) & (length[two] > 0)
    cosine = (normals[one[whole]] * normals[two[whole]]).sum(1)
    return Edges(int((cosine < np.cos(np.radians(TURN_DEG))).sum()), len(cosine))
