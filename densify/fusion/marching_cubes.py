"""Marching cubes over blocks of a volume (Lorensen and Cline 1987), each block cut by itself.

A block is 8 x 8 x 8 voxels; its place (3,) is counted in blocks. A cell is the cube between eight voxels and belongs to
the block of its lowest corner, so a block's cells need the first voxels of the seven blocks above it. A vertex lies on
an edge between two voxels, and is the same, name and all, on whichever side of a block's border it is computed: so the
parts of a surface that blocks give can be joined, and parts that did not change can be kept.

A cell has its corners c = 0..7 at (c & 1, c >> 1 & 1, c >> 2 & 1) along the three axes. A corner is inside where the
value is negative. On a face whose diagonals differ, the two inside corners are cut off from each other: the rule knows
the face alone, so the two cells that share it agree, and the surface has no cracks (after Nielson and Hamann 1991).
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from lightdepth.compiled import compiled

BLOCK = 8
"""Voxels along the side of a block. Compiled code relies on it."""
CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
EDGES = np.array([(c, c | 1 << axis, axis) for axis in range(3) for c in range(8) if not c >> axis & 1])
"""(12, 3): first corner, second corner, axis."""

_BITS = 20  # of each of the three numbers in a packed place
REACH = 1 << _BITS - 1
"""Voxels to either side of the map's origin that have names."""


def packed(places: np.ndarray) -> np.ndarray:
    """Places (n, 3) as one int64 each, (n,); in their order."""
    x, y, z = (places.astype(np.int64) + REACH).T
    result: np.ndarray = x << 2 * _BITS | y << _BITS | z
    return result


def unpacked(codes: np.ndarray) -> np.ndarray:
    """Places (n, 3) of `packed` ones (n,)."""
    low = (1 << _BITS) - 1
    return np.stack([codes >> 2 * _BITS, codes >> _BITS & low, codes & low], -1) - REACH


@cache
def triangle_table() -> tuple[np.ndarray, np.ndarray]:
    """For each of the 256 cases, up to five triangles as edges (256, 5, 3), and their number (256,)."""
    edge_of = {frozenset(map(int, pair)): i for i, pair in enumerate(EDGES[:, :2])}
    table, counts = np.zeros((256, 5, 3), np.int8), np.zeros(256, np.int8)
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


class Cut(NamedTuple):
    """The surface in some blocks: for each of v vertices the name of the edge that it lies on, the voxels at the edge's
    ends, `near` and `far`, as 512 slot + place, and the share of the way from one to the other; and triangles (m, 3)
    uint16, which turn their front to the positive side.

    The k-th block that has any surface is that in row `rows[k]` of those asked for; its vertices begin at
    `first_vertex[k]`, its triangles, which count from there, at `first_triangle[k]`.
    """

    names: np.ndarray
    near: np.ndarray
    far: np.ndarray
    share: np.ndarray
    triangles: np.ndarray
    rows: np.ndarray
    first_vertex: np.ndarray
    first_triangle: np.ndarray

    @property
    def positions(self) -> np.ndarray:
        """(v, 3) in voxels."""
        result: np.ndarray = _positions(self.names, self.share)
        return result


def cut(
    distance: np.ndarray,
    weight: np.ndarray,
    behind: np.ndarray,
    known: np.ndarray,
    above: np.ndarray,
    codes: np.ndarray,
    slots: np.ndarray,
) -> Cut:
    """The zero surface of distance / weight (both (n, 512) int32) in the blocks at `slots` (k,).

    Bit z of behind and of known (n, 64) uint8, at 8 x + y, says whether a voxel lies behind the surface, and whether it
    is known; no cell with an unknown corner has any surface. above (n, 8) says where a block's neighbours at CORNERS
    are held, -1 for none; codes (n,) its packed place.
    """
    return Cut(*_cut(distance, weight, behind, known, above, codes, slots, *corners_of_cases()))


@cache
def corners_of_cases() -> tuple[np.ndarray, np.ndarray]:
    """For each case the corners of its triangles (256, 15), as edges counted from the cell's lowest voxel in a block
    with its border: axis, then x, y, z of the edge's lower voxel. And how many corners there are (256,)."""
    table, counts = triangle_table()
    corner, _, axis = EDGES.T
    return (axis * 729 + CORNERS[corner] @ (81, 9, 1)).astype(np.int32)[table].reshape(256, 15), 3 * counts


def one_vertex_an_edge(names: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the vertices of several blocks, by their names (v,): the rows (n,) of those to keep, in the order of the
    names, and the triangles (m, 3), which counted all, counting these."""
    _, first, same = np.unique(names, return_index=True, return_inverse=True)
    return first, same[triangles]


@compiled
def _cut(
    distance: np.ndarray,
    weight: np.ndarray,
    behind: np.ndarray,
    known: np.ndarray,
    above: np.ndarray,
    codes: np.ndarray,
    slots: np.ndarray,
    cases: np.ndarray,
    counts: np.ndarray,
) -> tuple[np.ndarray, ...]:
    names, near, far = np.empty(8192, np.int64), np.empty(8192, np.int64), np.empty(8192, np.int64)
    share = np.empty(8192, np.float64)
    corners = np.empty(49152, np.uint16)
    rows = np.empty(len(slots), np.int64)
    first_vertex, first_triangle = np.zeros(len(slots) + 1, np.int64), np.zeros(len(slots) + 1, np.int64)
    vertex_at = np.full(3 * 729, -1, np.int32)
    edges = np.empty(3 * 729, np.int32)
    blocks = v = t = 0
    for row in range(len(slots)):
        if len(names) < v + 3 * 729:  # as many as one block can have
            names, near, far, share = _longer(names), _longer(near), _longer(far), _longer(share)
        if len(corners) < t + 15 * 512:
            corners = _longer(corners)
        around = above[slots[row]]
        n, m = _cut_cells(behind, known, around, cases, counts, vertex_at, edges, corners[t:])
        if m == 0:
            continue
        _place_vertices(distance, weight, around, codes[slots[row]], edges[:n], names[v:], near[v:], far[v:], share[v:])
        for i in range(n):
            vertex_at[edges[i]] = -1
        rows[blocks] = row
        blocks, v, t = blocks + 1, v + n, t + m
        first_vertex[blocks], first_triangle[blocks] = v, t // 3
    triangles = corners[:t].reshape(-1, 3)
    rows, first_vertex, first_triangle = rows[:blocks], first_vertex[: blocks + 1], first_triangle[: blocks + 1]
    return names[:v], near[:v], far[:v], share[:v], triangles, rows, first_vertex, first_triangle


@compiled
def _cut_cells(
    behind: np.ndarray,
    known: np.ndarray,
    around: np.ndarray,
    cases: np.ndarray,
    counts: np.ndarray,
    vertex_at: np.ndarray,
    edges: np.ndarray,
    corners: np.ndarray,
) -> tuple[int, int]:
    """Writes the corners of a block's triangles, as numbers of vertices, and the edges that these lie on; how many
    vertices and corners there are. `vertex_at` is -1 for all edges, and then the number of an edge's vertex."""
    behinds, knowns = np.zeros((9, 9), np.int64), np.zeros((9, 9), np.int64)  # with the border; bit z of x, y
    both, either = -1, 0
    for x in range(9):
        for y in range(9):
            at = (x & 7) << 3 | y & 7
            s, up = around[x >> 3 | y >> 3 << 1], around[x >> 3 | y >> 3 << 1 | 4]
            if s >= 0:
                behinds[x, y], knowns[x, y] = behind[s, at], known[s, at]
            if up >= 0:
                behinds[x, y] |= np.int64(behind[up, at] & 1) << 8
                knowns[x, y] |= np.int64(known[up, at] & 1) << 8
            both &= behinds[x, y] | ~knowns[x, y]
            either |= behinds[x, y] & knowns[x, y]
    n = m = 0
    if both & 511 == 511 or either == 0:  # most blocks lie on one side of the surface
        return n, m
    for x in range(8):
        for y in range(8):
            b0, b1, b2, b3 = behinds[x, y], behinds[x + 1, y], behinds[x, y + 1], behinds[x + 1, y + 1]
            k = knowns[x, y] & knowns[x + 1, y] & knowns[x, y + 1] & knowns[x + 1, y + 1]
            some, all = b0 | b1 | b2 | b3, b0 & b1 & b2 & b3
            crossed = (some | some >> 1) & ~(all & all >> 1) & k & k >> 1 & 255
            for z in range(8):
                if crossed >> z & 1 == 0:
                    continue
                case = b0 >> z & 1 | (b1 >> z & 1) << 1 | (b2 >> z & 1) << 2 | (b3 >> z & 1) << 3
                z1 = z + 1
                case |= (b0 >> z1 & 1) << 4 | (b1 >> z1 & 1) << 5 | (b2 >> z1 & 1) << 6 | (b3 >> z1 & 1) << 7
                for i in range(counts[case]):
                    edge = x * 81 + y * 9 + z + cases[case, i]
                    if vertex_at[edge] < 0:
                        vertex_at[edge], edges[n] = n, edge
                        n += 1
                    corners[m] = vertex_at[edge]
                    m += 1
    return n, m


@compiled
def _place_vertices(
    distance: np.ndarray,
    weight: np.ndarray,
    around: np.ndarray,
    code: int,
    edges: np.ndarray,
    names: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    share: np.ndarray,
) -> None:
    """Where the surface crosses the edges (n,) of a block."""
    t_sums, w_sums = distance.reshape(-1), weight.reshape(-1)
    mask = (1 << _BITS) - 1
    base = (8 * ((code >> 2 * _BITS) - REACH) + REACH) << 2 * _BITS
    base |= (8 * ((code >> _BITS & mask) - REACH) + REACH) << _BITS | 8 * ((code & mask) - REACH) + REACH
    for i in range(len(edges)):
        edge = np.int64(edges[i])
        axis, voxel = edge // 729, edge % 729
        x, y, z = voxel // 81, voxel // 9 % 9, voxel % 9
        one = around[x >> 3 | y >> 3 << 1 | z >> 3 << 2] * 512 + ((x & 7) << 6 | (y & 7) << 3 | z & 7)
        names[i] = 3 * (base + (x << 2 * _BITS | y << _BITS | z)) + axis
        x, y, z = x + (axis == 0), y + (axis == 1), z + (axis == 2)
        two = around[x >> 3 | y >> 3 << 1 | z >> 3 << 2] * 512 + ((x & 7) << 6 | (y & 7) << 3 | z & 7)
        here, there = t_sums[one] / w_sums[one], t_sums[two] / w_sums[two]
        near[i], far[i], share[i] = one, two, here / (here - there)


@compiled
def _positions(names: np.ndarray, share: np.ndarray) -> np.ndarray:
    positions, mask = np.empty((len(names), 3), np.float64), (1 << _BITS) - 1
    for i in range(len(names)):
        place, axis = names[i] // 3, names[i] % 3
        positions[i, 0] = (place >> 2 * _BITS) - REACH
        positions[i, 1] = (place >> _BITS & mask) - REACH
        positions[i, 2] = (place & mask) - REACH
        positions[i, axis] += share[i]
    return positions


@compiled
def _longer(array: np.ndarray) -> np.ndarray:
    out = np.empty(2 * len(array) + 8192, array.dtype)
    for i in range(len(array)):  # a slice would take seconds to compile
        out[i] = array[i]
    return out
