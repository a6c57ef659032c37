"""The surface of a volume in patches, one for each block: renewed where the volume changed, and kept elsewhere."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from densify.fusion.chosen import Volume
from densify.fusion.marching_cubes import one_vertex_an_edge
from lightdepth.compiled import compiled


class Patch(NamedTuple):
    """The surface inside one block, as one piece of memory: of n vertices and m triangles the arrays below, in their
    order. (Hundreds are made for each keyframe; four arrays of their own would take longer than all the rest.)"""

    data: bytes
    n: int
    m: int

    @property
    def edges(self) -> np.ndarray:
        """The edge (n,) int64 that each vertex lies on, which names it in the whole volume."""
        return np.frombuffer(self.data, np.int64, self.n)

    @property
    def vertices(self) -> np.ndarray:
        """(n, 3) float32 in map units."""
        return np.frombuffer(self.data, np.float32, 3 * self.n, 8 * self.n).reshape(-1, 3)

    @property
    def triangles(self) -> np.ndarray:
        """(m, 3) uint16 into the vertices."""
        return np.frombuffer(self.data, np.uint16, 3 * self.m, 20 * self.n).reshape(-1, 3)

    @property
    def colors(self) -> np.ndarray:
        """(n, 3) uint8."""
        return np.frombuffer(self.data, np.uint8, 3 * self.n, 20 * self.n + 6 * self.m).reshape(-1, 3)


class BlockSurface:
    """The patches of a surface, by the packed place of their block. `renewed` are the blocks of the last renewal."""

    def __init__(self) -> None:
        self.patches: dict[int, Patch] = {}
        self.renewed = np.zeros(0, np.int64)

    @property
    def places(self) -> np.ndarray:
        """Packed places (n,) of the blocks that have a patch."""
        return np.fromiter(self.patches, np.int64, len(self.patches))

    def renew(self, volume: Volume, changed: np.ndarray) -> None:
        """Makes the patches of blocks (n,), packed, anew: those that its `integrate` says may have changed."""
        self.renewed = np.unique(changed)
        for code in self.renewed.tolist():
            self.patches.pop(code, None)
        slots = volume.slots(self.renewed)
        held = slots >= 0
        found = volume.cut(slots[held])
        counts = np.diff(found.first_vertex), np.diff(found.first_triangle)
        ends = np.cumsum((23 * counts[0] + 6 * counts[1] + 7) // 8)  # in pieces of eight bytes, so that numbers align
        data = _in_patches(
            (found.positions * volume.voxel).astype(np.float32), found.names,
            np.rint(volume.colors_at(found)).astype(np.uint8), found.triangles, *found[-2:], ends,
        ).tobytes()  # fmt: skip
        starts, ends = (8 * np.concatenate([[0], ends])).tolist(), (8 * ends).tolist()
        names, n, m = (array.tolist() for array in (self.renewed[held][found.rows], *counts))
        self.patches.update(
            {p: Patch(data[a:b], v, t) for p, a, b, v, t in zip(names, starts[:-1], ends, n, m, strict=True)}
        )


@compiled
def _in_patches(
    vertices: np.ndarray,
    names: np.ndarray,
    colors: np.ndarray,
    triangles: np.ndarray,
    first_vertex: np.ndarray,
    first_triangle: np.ndarray,
    ends: np.ndarray,
) -> np.ndarray:
    """The memory of patches that end at `ends` (k,), in pieces of eight bytes."""
    data = np.zeros(ends[-1] if len(ends) else 0, np.int64)
    singles, shorts, bytes_ = data.view(np.float32), data.view(np.uint16), data.view(np.uint8)
    for k in range(len(ends)):
        v, t = first_vertex[k], first_triangle[k]
        n, m = first_vertex[k + 1] - v, first_triangle[k + 1] - t
        start = ends[k - 1] if k else 0
        for i in range(n):
            data[start + i] = names[v + i]
            for a in range(3):
                singles[2 * (start + n) + 3 * i + a] = vertices[v + i, a]
                bytes_[8 * start + 20 * n + 6 * m + 3 * i + a] = colors[v + i, a]
        for i in range(m):
            for a in range(3):
                shorts[4 * start + 10 * n + 3 * i + a] = triangles[t + i, a]
    return data


def joined(parts: Iterable[Patch]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patches as one mesh: vertices (n, 3), triangles (m, 3), colors (n, 3) in [0, 1]. Every edge has one vertex."""
    parts = list(parts)
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3))
    starts = np.cumsum([0] + [p.n for p in parts[:-1]])
    triangles = np.concatenate([p.triangles + start for p, start in zip(parts, starts, strict=True)])
    first, triangles = one_vertex_an_edge(np.concatenate([p.edges for p in parts]), triangles)
    vertices = np.concatenate([p.vertices for p in parts])[first].astype(np.float64)
    return vertices, triangles, np.concatenate([p.colors for p in parts])[first] / 255
