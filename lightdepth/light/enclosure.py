"""Light that the wall of a map receives from the rest of the wall, seen and unseen.

Notation: elements of known wall j with areas A_j; K_ij the share of what element i receives by the cosine law that
comes from j, and k_i = 1 - sum_j K_ij what no look shows; S_j direct light on j, which is 0 in the shadow of other
wall; B radiosity over rho, rho reflectance. What lies where no look shows it is taken for wall like the mean of the
known, to a share b: 0 is an open end, 1 a closed hollow.

    B = S + rho (K B + b k <B>),   <B> = sum A B / sum A,    E_ind at a place = rho (K' B + b k' <B>)

K is found by rays from each element and place (Open3D's RaycastingScene on the looks' own surfaces).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lightdepth import native
from lightdepth.light.looks import Look, Seen, Wall

_RAYS = (192, 128)  # from each element, from each place
_LIFT = 0.012  # of the typical distance that rays start above the wall: looks' surfaces cross
_TURN = 0.15  # of the typical distance that a radian counts for where the element that a ray met is looked up
_TORN = 1.25  # ratio of distances over which a pixel's neighbours do not hang together
_EVERY = 2  # pixels


@dataclass(frozen=True)
class Enclosure:
    """Elements (m, 3) of wall with normals (m, 3) and areas (m,), whether each look's light reaches them (i, m); the
    shares K (m, m) and K' (n, m) for elements and places."""

    elements: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    lit: np.ndarray
    between: np.ndarray
    onto: np.ndarray

    def received(self, rho: float, unseen: float, direct: np.ndarray, every: int = 1) -> np.ndarray:
        """Light (k, n) that places receive from the wall under each of k lights, of which direct light (k, m) reaches
        the elements; of places only each of that number in turn, so that 8 is one in eight."""
        share = self.areas / self.areas.sum()
        shares = self.between, self.onto[::every]
        between, onto = (k + unseen * (1 - k.sum(1, keepdims=True)) * share for k in shares)
        result: np.ndarray = rho * (onto @ np.linalg.solve(np.eye(len(share)) - rho * between, direct.T)).T
        return result


def enclosure(
    looks: Sequence[Look],
    walls: Sequence[Wall],
    wall: tuple[np.ndarray, np.ndarray, np.ndarray],
    seen: Seen,
    typical: float,
    rng: np.random.Generator,
) -> Enclosure:
    """Who lights whom among elements (places, normals, areas) of the wall and the places seen."""
    points, normals, areas = wall
    scene, tensor = _scene(looks, walls)
    tree = cKDTree(np.concatenate([points, _TURN * typical * normals], 1))

    def shares(at: np.ndarray, out: np.ndarray, count: int) -> np.ndarray:
        """Of rays about normals (n, 3) at places (n, 3), the shares (n, m) that meet each element."""
        towards = _by_cosine(out, count, rng)
        start = np.broadcast_to((at + _LIFT * typical * out)[:, None], towards.shape)
        rays = np.concatenate([start, towards], -1).reshape(-1, 6).astype(np.float32)
        hit = scene.cast_rays(tensor(rays))
        far, facing = hit["t_hit"].numpy(), hit["primitive_normals"].numpy()
        met = np.isfinite(far)
        rays, far, facing = rays[met], far[met], facing[met]
        facing = facing * -np.sign((facing * rays[:, 3:]).sum(1, keepdims=True))
        _, which = tree.query(np.concatenate([rays[:, :3] + far[:, None] * rays[:, 3:], _TURN * typical * facing], 1))
        row = np.repeat(np.arange(len(at)), count)[met]
        found = np.bincount(row * len(points) + which, minlength=len(at) * len(points)) / count
        return found.reshape(len(at), len(points))

    lifted = points + _LIFT * typical * normals
    lit = []
    for look in looks:
        rays = np.concatenate([lifted, look.centre - lifted], 1).astype(np.float32)
        lit.append(~scene.test_occlusions(tensor(rays), tnear=0.0, tfar=0.98).numpy())
    between, onto = shares(points, normals, _RAYS[0]), shares(seen.places, seen.normals, _RAYS[1])
    return Enclosure(points, normals, areas, np.stack(lit), between, onto)


def _scene(looks: Sequence[Look], walls: Sequence[Wall]) -> tuple[Any, Any]:
    """The looks' surfaces as one scene that rays are cast at, and what makes arrays into its tensors."""
    open3d = native.open3d()
    tensor, vertices, triangles, count = open3d.core.Tensor, [], [], 0
    for look, wall in zip(looks, walls, strict=True):
        distance = np.where(look.valid, look.distance, 0)[::_EVERY, ::_EVERY]
        index = np.arange(distance.size).reshape(distance.shape)
        corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], -1).reshape(-1, 4)
        far = distance.ravel()[corners]
        corners = corners[(far.min(1) > 0) & (far.max(1) < _TORN * far.min(1))]
        vertices.append(wall.places[::_EVERY, ::_EVERY].reshape(-1, 3))
        triangles += [corners[:, [0, 1, 2]] + count, corners[:, [0, 2, 3]] + count]
        count += distance.size
    scene = open3d.t.geometry.RaycastingScene()
    points, faces = np.concatenate(vertices), np.concatenate(triangles)
    scene.add_triangles(tensor(points.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene, tensor


def _by_cosine(normals: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Unit directions (n, count, 3) about normals (n, 3), as dense as the cosine to these; each turned by chance."""
    aside = (np.arange(count) + 0.5) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi, (len(normals), 1))
    least = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    x = np.cross(normals, least)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normals, x)
    flat = np.cos(turn)[..., None] * x[:, None] + np.sin(turn)[..., None] * y[:, None]
    result: np.ndarray = np.sqrt(aside)[:, None] * flat + np.sqrt(1 - aside)[:, None] * normals[:, None]
    return result
