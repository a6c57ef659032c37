"""Marching cubes by blocks: the surface is renewed where its volume changed, and kept elsewhere.

Notation: a block is 8 x 8 x 8 voxels and its key (3,) int its place, in blocks. t is the signed distance of a voxel,
negative behind the surface. A cell is the cube between eight voxels and belongs to the block of its lowest corner, so a
block's cells need the first voxels of the seven blocks above it. A vertex lies on an edge between two voxels, and is
the same on whichever side of a block's border it is computed. Arrays of voxels have axes x, y, z.

The cases are those of densify.marching_cubes, which makes a whole surface at once. Here each block is cut by itself,
with the first voxels of the blocks above it, so that no patch needs another.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np

from densify.fusion import BLOCK as SIDE
from densify.marching_cubes import CORNERS, EDGES, triangle_table

_VOXELS = (SIDE + 1) ** 3  # of a block and its border
_EDGES = 3 * _VOXELS  # axis, then x, y, z of the lower voxel
_CHUNK = 1024  # blocks that are worked on at once: some 50 MB
_BITS = 20  # of each of the three numbers in a packed key: half a million voxels to either side of the map's origin


class Blocks(Protocol):
    """What marching cubes needs of a volume: densify.fusion.TsdfVolume has it."""

    voxel: float

    @property
    def capacity(self) -> int: ...

    def slots(self, places: np.ndarray) -> np.ndarray: ...

    def sides(self, slots: np.ndarray) -> np.ndarray: ...

    def values(self, slots: np.ndarray) -> np.ndarray: ...

    def color_sums(self, voxels: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class Patch:
    """The surface inside one block: vertices (n, 3) float32 in map units, colors (n, 3) uint8, triangles (m, 3) uint16
    into them, and the edge (n,) int64 that each vertex lies on, which names it in the whole volume."""

    vertices: np.ndarray
    colors: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray


def packed(keys: np.ndarray) -> np.ndarray:
    """Keys (n, 3) as one int64 each, (n,)."""
    x, y, z = (keys.astype(np.int64) + (1 << _BITS - 1)).T
    return x << 2 * _BITS | y << _BITS | z


_STEPS = packed(CORNERS) - packed(np.zeros((1, 3), int))  # to the eight corners, in packed keys


def unpacked(codes: np.ndarray) -> np.ndarray:
    """Keys (n, 3) of `packed` ones (n,)."""
    low = (1 << _BITS) - 1
    return np.stack([codes >> 2 * _BITS, codes >> _BITS & low, codes & low], -1) - (1 << _BITS - 1)


def touched_cells(codes: np.ndarray) -> np.ndarray:
    """Packed keys of the blocks whose cells have a voxel in any of these blocks, each once."""
    return np.unique(codes[:, None] - _STEPS)


def block_patches(volume: Blocks, keys: np.ndarray, slots: np.ndarray) -> Iterator[tuple[int, Patch]]:
    """The surface of blocks (n, 3) that are, with the seven above them, at `slots` (n, 8): index into keys, and patch,
    of those that have any. Only cells whose eight voxels are all known make triangles."""
    t = _with_border(volume, slots)
    base, case = _cells(t)
    if not len(base):
        return
    offsets, count = _table()
    many = count[case]
    row = np.repeat(np.arange(len(base), dtype=np.int32), many)
    nth = np.arange(len(row), dtype=np.int32) - np.repeat(np.cumsum(many, dtype=np.int32) - many, many)
    corners = base[row, None] + offsets[case[row], nth]  # (m, 3) edges, numbered through all blocks
    used = np.zeros(len(keys) * _EDGES, bool)
    used[corners.ravel()] = True
    edge = np.flatnonzero(used)
    vertex = np.empty(len(used), np.int32)
    vertex[edge] = np.arange(len(edge), dtype=np.int32)
    positions, colors, names = _vertices(edge, t, slots, volume, keys)
    positions = (positions * volume.voxel).astype(np.float32)
    bounds = np.arange(len(keys) + 1) * _EDGES
    first_vertex = np.searchsorted(edge, bounds)
    first_triangle = np.concatenate([[0], np.cumsum(many)])[np.searchsorted(base, bounds)]
    block = np.repeat(np.arange(len(keys)), np.diff(first_triangle))
    triangles = (vertex[corners] - first_vertex[block, None]).astype(np.uint16)
    for b in np.flatnonzero(np.diff(first_triangle)).tolist():
        v, f = slice(*first_vertex[b : b + 2]), slice(*first_triangle[b : b + 2])
        # Copies, so that a patch that stays does not hold the arrays of all that were made with it.
        yield b, Patch(positions[v].copy(), colors[v].copy(), triangles[f].copy(), names[v].copy())


def _with_border(volume: Blocks, slots: np.ndarray) -> np.ndarray:
    """(n, 9, 9, 9): the values of blocks and of the first voxels of those above them; NaN where there is none."""
    out = np.full((len(slots), SIDE + 1, SIDE + 1, SIDE + 1), np.nan, np.float32)
    needed = np.unique(slots[slots >= 0])
    values, row = volume.values(needed), np.searchsorted(needed, slots)
    for above, rows, held in zip(CORNERS, row.T, slots.T >= 0, strict=True):
        to = tuple(slice(SIDE, None) if up else slice(0, SIDE) for up in above)
        take = tuple(slice(0, 1) if up else slice(None) for up in above)
        out[(held, *to)] = values[(rows[held], *take)]
    return out


def _cells(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cells that the surface passes through: where their lowest corner stands among the edges, and their case."""
    # Flat, so that a corner is a shift and every pass runs through memory in one go; a block's border is no cell's
    # lowest corner, and so what a shift brings in from the next block is never looked at.
    behind, known = (t < 0).ravel().view(np.uint8), ~np.isnan(t).ravel()
    places = _place(*CORNERS.T)
    inside = np.zeros((SIDE + 1,) * 3, bool)
    inside[:SIDE, :SIDE, :SIDE] = True
    size = behind.size - int(places[-1])
    whole = np.tile(inside.ravel(), len(t))[:size]
    case = np.zeros(size, np.uint8)
    for bit, place in enumerate(places.tolist()):
        case |= behind[place : place + size] << np.uint8(bit)
        whole &= known[place : place + size]
    active = np.flatnonzero(whole & (case != 0) & (case != 255))
    block, voxel = np.divmod(active, _VOXELS)
    return (block * _EDGES + voxel).astype(np.int32), case[active]


def _place(x: Any, y: Any, z: Any) -> Any:
    """Place of a voxel in a block with its border, flat."""
    return (x * (SIDE + 1) + y) * (SIDE + 1) + z


def _vertices(
    edge: np.ndarray, t: np.ndarray, slots: np.ndarray, volume: Blocks, keys: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where t changes sign on these edges: positions (n, 3) in voxels, colours (n, 3) uint8, names (n,) int64."""
    block, rest = np.divmod(edge.astype(np.int32), _EDGES)
    axis, voxel = np.divmod(rest, _VOXELS)
    lower = block * _VOXELS + voxel
    before = t.ravel()[lower]
    share = (before / (before - t.ravel()[lower + _place(*np.eye(3, dtype=np.int32))[axis]]))[:, None]
    low = np.stack([voxel // 81, voxel // 9 % 9, voxel % 9], -1)
    step = np.eye(3, dtype=np.int32)[axis]
    where = keys[block] * SIDE + low
    sums = volume.color_sums(_voxel_at(slots, block, low)) * (1 - share)
    sums += volume.color_sums(_voxel_at(slots, block, low + step)) * share
    colors = np.rint(sums[:, :3] / np.maximum(sums[:, 3:], np.float32(1e-9))).astype(np.uint8)
    return where + step * share, colors, packed(where) * 3 + axis


def _voxel_at(slots: np.ndarray, block: np.ndarray, voxel: np.ndarray) -> np.ndarray:
    """Where the volume holds voxels (n, 3; up to 8) of blocks, those on the border in the blocks above."""
    slot = slots[block, (voxel >> 3) @ np.array([1, 2, 4], np.int32)]
    x, y, z = (voxel & 7).T
    return ((slot * SIDE + x) * SIDE + y) * SIDE + z


@cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    """For each case, the edges of its triangles (256, 5, 3) as offsets from the cell's place among the edges, and how
    many triangles there are (256,)."""
    table, counts = triangle_table()
    corner, _, axis = EDGES.T
    return (axis * _VOXELS + _place(*CORNERS[corner].T)).astype(np.int32)[table], counts.astype(np.int32)


class BlockSurface:
    """The patches of a surface, by the packed key of their block. `renewed` are the blocks of the last renewal."""

    def __init__(self) -> None:
        self.patches: dict[int, Patch] = {}
        self.renewed = np.zeros(0, np.int64)
        self._sides = np.zeros(0, np.uint8)  # of each slot, as of TsdfVolume.sides

    @property
    def places(self) -> np.ndarray:
        """Packed keys (n,) of the blocks that have a patch."""
        return np.fromiter(self.patches, np.int64, len(self.patches))

    def renew(self, volume: Blocks, changed: np.ndarray) -> None:
        """Makes the surface anew where blocks (n,) packed have changed, appeared or gone."""
        self.renewed = touched_cells(changed)
        for code in self.renewed.tolist():
            self.patches.pop(code, None)
        if not len(changed):
            return
        codes, row = np.unique(self.renewed[:, None] + _STEPS, return_inverse=True)
        held = volume.slots(unpacked(codes))
        slots = held[row].reshape(-1, 8)
        if len(self._sides) < volume.capacity:
            self._sides = np.concatenate([self._sides, np.zeros(volume.capacity - len(self._sides), np.uint8)])
        # Most blocks lie before or behind the surface, and are not worth a closer look.
        at = held[np.searchsorted(codes, changed)]
        for part in np.array_split(at[at >= 0], len(at) // _CHUNK + 1):
            self._sides[part] = volume.sides(part)
        sides = np.where(slots >= 0, self._sides[slots], 0)
        worth = np.flatnonzero((slots[:, 0] >= 0) & (np.bitwise_or.reduce(sides, 1) == 3))
        for start in range(0, len(worth), _CHUNK):
            part = worth[start : start + _CHUNK]
            names = self.renewed[part].tolist()
            for index, patch in block_patches(volume, unpacked(self.renewed[part]), slots[part]):
                self.patches[names[index]] = patch


def joined(parts: Iterable[Patch]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patches as one mesh: vertices (n, 3), triangles (m, 3), colors (n, 3) in [0, 1]. Every edge has one vertex."""
    parts = list(parts)
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3))
    starts = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    triangles = np.concatenate([p.triangles.astype(np.int64) + s for p, s in zip(parts, starts, strict=True)])
    _, first, same = np.unique(np.concatenate([p.edges for p in parts]), return_index=True, return_inverse=True)
    vertices = np.concatenate([p.vertices for p in parts])[first].astype(np.float64)
    return vertices, same[triangles], np.concatenate([p.colors for p in parts])[first] / 255
