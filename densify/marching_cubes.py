"""Marching cubes over blocks of a volume (Lorensen and Cline 1987), in whole-array operations.

A cell has its corners c = 0..7 at (c & 1, c >> 1 & 1, c >> 2 & 1) along the three axes. A corner is inside where the
value is negative. On a face whose diagonals differ, the two inside corners are cut off from each other: the rule knows
the face alone, so the two cells that share it agree, and the surface has no cracks (after Nielson and Hamann 1991).
"""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np

CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
EDGES = np.array([(c, c | 1 << axis, axis) for axis in range(3) for c in range(8) if not c >> axis & 1])
"""(12, 3): first corner, second corner, axis."""


@cache
def triangle_table() -> tuple[np.ndarray, np.ndarray]:
    """For each of the 256 cases, up to five triangles as edges (256, 5, 3), and their number (256,)."""
    edge_of = {frozenset(map(int, pair)): i for i, pair in enumerate(EDGES[:, :2])}
    table, counts = np.zeros((256, 5, 3), int), np.zeros(256, int)
    for case in range(256):
        following = {}
        for face in _faces():
            inside = [bool(case >> c & 1) for c in face]
            for k in range(4):
                if inside[k] and not inside[k - 1]:  # from where the walk around the face enters to where it leaves
                    last = k
                    while inside[(last + 1) % 4]:
                        last = (last + 1) % 4
                    enter = edge_of[frozenset((face[k - 1], face[k]))]
                    leave = edge_of[frozenset((face[last], face[(last + 1) % 4]))]
                    following[enter] = leave
        triangles = []
        while following:
            first, edge = following.popitem()
            loop = [first]
            while edge != first:
                loop.append(edge)
                edge = following.pop(edge)
            triangles += _fan(loop)
        counts[case] = len(triangles)
        table[case, : len(triangles)] = np.reshape(triangles, (-1, 3))
    return table, counts


def _fan(loop: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of a loop of edges, from the start that puts the fewest diagonals into a face of the cell: there, the
    next cell could have the same."""

    def in_a_face(first: int, second: int) -> bool:
        corners = CORNERS[np.concatenate([EDGES[first, :2], EDGES[second, :2]])]
        return bool((corners == corners[0]).all(0).any())

    turned = [loop[i:] + loop[:i] for i in range(len(loop))]
    best = min(turned, key=lambda t: sum(in_a_face(t[0], t[i]) for i in range(2, len(t) - 1)))
    return [(best[0], best[i], best[i + 1]) for i in range(1, len(best) - 1)]


def _faces() -> list[tuple[int, int, int, int]]:
    """Corners of the six faces, counter-clockwise as seen from outside."""
    faces = []
    for axis, side in product(range(3), (0, 1)):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        base = side << axis
        ring = (base, base | u, base | u | v, base | v)
        faces.append(ring if side else ring[::-1])
    return faces


def marching_cubes(
    values: np.ndarray, neighbors: np.ndarray, cells_of: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The zero surface of values (n, B, B, B) in n blocks, NaN where nothing is known; no cell with such a corner has
    any surface.

    neighbors (n, 8) are the rows of the blocks at CORNERS from each (itself first), or -1; cells_of (n,) bool says of
    which blocks the cells are wanted. Gives, for each vertex, the voxel that it lies at or beyond (k,), as an index
    into the flattened values, the voxel on the other side (k,), the share (k,) of the way to it; and triangles (m, 3),
    which turn their front to the positive side.
    """
    size = values.shape[1]
    table, counts = triangle_table()
    state = (values < 0) * np.uint8(1) + np.isnan(values) * np.uint8(2)
    padded = np.full((len(values), size + 1, size + 1, size + 1), 2, np.uint8)
    for corner, (i, j, k) in enumerate(CORNERS):
        there = neighbors[:, corner]
        source = tuple(np.s_[0:1] if far else np.s_[:] for far in (i, j, k))
        target = tuple(np.s_[size:] if far else np.s_[:size] for far in (i, j, k))
        found = there >= 0
        padded[(found, *target)] = state[(there[found], *source)]
    case = np.zeros(values.shape, np.uint8)
    unknown = np.zeros(values.shape, np.uint8)
    for corner, (i, j, k) in enumerate(CORNERS):
        part = padded[:, i : i + size, j : j + size, k : k + size]
        case |= (part & 1) << np.uint8(corner)
        unknown |= part & 2
    crossed = (unknown == 0) & (case > 0) & (case < 255) & cells_of[:, None, None, None]
    block, *place = np.nonzero(crossed)
    case_here = case[crossed]
    # The voxel at each corner of each cell, across into the neighbours.
    corner_voxels = np.empty((len(block), 8), np.int64)
    for corner, offset in enumerate(CORNERS):
        at = [p + o for p, o in zip(place, offset, strict=True)]
        over = sum((a == size).astype(int) << axis for axis, a in enumerate(at))
        row = neighbors[block, over]
        corner_voxels[:, corner] = np.ravel_multi_index([row, *(a % size for a in at)], values.shape)
    used = np.repeat(np.arange(len(block)), counts[case_here])
    within = np.arange(len(used)) - np.repeat(np.cumsum(counts[case_here]) - counts[case_here], counts[case_here])
    edges = table[case_here[used], within]  # (m, 3)
    keys = corner_voxels[used[:, None], EDGES[edges, 0]] * 3 + EDGES[edges, 2]
    others = corner_voxels[used[:, None], EDGES[edges, 1]]
    ids = np.full(values.size * 3, -1, np.int32)
    ids[keys] = 0
    owners = np.flatnonzero(ids == 0)
    ids[owners] = np.arange(len(owners))
    triangles = ids[keys]
    second = np.empty(len(owners), np.int64)
    second[triangles] = others
    first = owners // 3
    flat = values.reshape(-1)
    a, b = flat[first], flat[second]
    return first, second, a / (a - b), triangles
