"""Marching cubes, as NVIDIA Warp compiles it for a GPU or a CPU (densify.fusion.on_device.naming): a thread for each
column of eight cells, sorted edges in the place of a walk from cell to cell."""

# mypy: ignore-errors
# Annotations are Warp's own types and are read when a kernel is made: no postponed evaluation here.

import warp as wp

from densify.fusion.on_device.naming import MODULE, beside, coordinate, packed, row_of


@wp.kernel(module=MODULE)
def find_above(
    asked: wp.array(dtype=wp.int64),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=wp.int32),
    above: wp.array2d(dtype=wp.int32),
):
    """Rows (n, 8) of the blocks at the corners of those asked for, -1 where there is none."""
    i, corner = wp.tid()
    above[i, corner] = row_of(beside(asked[i], corner, wp.int64(1)), keys, rows)


@wp.func
def bits_of(columns: wp.array3d(dtype=wp.int32), above: wp.array2d(dtype=wp.int32), i: int, x: int, y: int, which: int):
    """The nine bits of a column of a block with its border."""
    at = ((x & 7) << 3) | (y & 7)
    corner = (x >> 3) | ((y >> 3) << 1)
    here = above[i, corner]
    up = above[i, corner | 4]
    bits = wp.int32(0)
    if here >= 0:
        bits = columns[here, at, which]
    if up >= 0:
        bits |= (columns[up, at, which] & 1) << 8
    return bits


@wp.func
def crossed_cells(b: wp.vec4i, known: int):
    """Bit z of each cell of a column that has surface, of the bits behind the surface at its four edges."""
    some = b[0] | b[1] | b[2] | b[3]
    every = b[0] & b[1] & b[2] & b[3]
    return (some | (some >> 1)) & ~(every & (every >> 1)) & known & (known >> 1) & 255


@wp.func
def case_of(b: wp.vec4i, z: int):
    case = wp.int32(0)
    for k in range(4):
        case |= ((b[k] >> z) & 1) << k
        case |= ((b[k] >> (z + 1)) & 1) << (4 + k)
    return case


@wp.func
def edges_behind(columns: wp.array3d(dtype=wp.int32), above: wp.array2d(dtype=wp.int32), i: int, x: int, y: int):
    return wp.vec4i(
        bits_of(columns, above, i, x, y, 0),
        bits_of(columns, above, i, x + 1, y, 0),
        bits_of(columns, above, i, x, y + 1, 0),
        bits_of(columns, above, i, x + 1, y + 1, 0),
    )


@wp.func
def edges_known(columns: wp.array3d(dtype=wp.int32), above: wp.array2d(dtype=wp.int32), i: int, x: int, y: int):
    known = bits_of(columns, above, i, x, y, 1) & bits_of(columns, above, i, x + 1, y, 1)
    return known & bits_of(columns, above, i, x, y + 1, 1) & bits_of(columns, above, i, x + 1, y + 1, 1)


@wp.kernel(module=MODULE)
def count_corners(
    above: wp.array2d(dtype=wp.int32),
    columns: wp.array3d(dtype=wp.int32),
    of_case: wp.array(dtype=wp.int32),
    corners: wp.array(dtype=wp.int32),
):
    """Corners of the triangles of each column of cells (n * 64,)."""
    i, column = wp.tid()
    x = column >> 3
    y = column & 7
    count = wp.int32(0)
    known = edges_known(columns, above, i, x, y)
    if known != 0:
        b = edges_behind(columns, above, i, x, y)
        crossed = crossed_cells(b, known)
        z = wp.int32(0)
        while crossed >> z != 0:
            if (crossed >> z) & 1 == 1:
                count += of_case[case_of(b, z)]
            z += 1
    corners[i * 64 + column] = count


@wp.kernel(module=MODULE)
def write_corners(
    above: wp.array2d(dtype=wp.int32),
    columns: wp.array3d(dtype=wp.int32),
    of_case: wp.array(dtype=wp.int32),
    cases: wp.array2d(dtype=wp.int32),
    ends: wp.array(dtype=wp.int32),
    edges: wp.array(dtype=wp.int64),
):
    """The edge of each corner, as 2187 times the row asked for and the edge's number in the block with its border."""
    i, column = wp.tid()
    x = column >> 3
    y = column & 7
    at = wp.int32(0)
    if i + column > 0:
        at = ends[i * 64 + column - 1]
    if ends[i * 64 + column] > at:
        b = edges_behind(columns, above, i, x, y)
        crossed = crossed_cells(b, edges_known(columns, above, i, x, y))
        z = wp.int32(0)
        while crossed >> z != 0:
            if (crossed >> z) & 1 == 1:
                case = case_of(b, z)
                for k in range(of_case[case]):
                    edges[at] = wp.int64(i) * wp.int64(2187) + wp.int64(x * 81 + y * 9 + z + cases[case, k])
                    at += 1
            z += 1


@wp.kernel(module=MODULE)
def mark_first(keys: wp.array(dtype=wp.int64), marks: wp.array(dtype=wp.int32)):
    """1 at the first of each run of equal keys."""
    i = wp.tid()
    marks[i] = 1
    if i > 0 and keys[i] == keys[i - 1]:
        marks[i] = 0


@wp.kernel(module=MODULE)
def number_runs(
    keys: wp.array(dtype=wp.int64),
    order: wp.array(dtype=wp.int32),
    counted: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.int32),
    runs: wp.array(dtype=wp.int64),
    firsts: wp.array(dtype=wp.int32),
):
    """The number of each key's run, by the key's place before the sort; each run's key, and the first place of it."""
    i = wp.tid()
    run = counted[i] - 1
    numbers[order[i]] = run
    if i == 0 or counted[i - 1] == run:
        runs[run] = keys[i]
        firsts[run] = order[i]


@wp.func
def voxel_of(above: wp.array2d(dtype=wp.int32), i: int, x: int, y: int, z: int):
    """512 times its row, and its place there."""
    row = above[i, (x >> 3) | ((y >> 3) << 1) | ((z >> 3) << 2)]
    return wp.int64(row) * wp.int64(512) + wp.int64(((x & 7) << 6) | ((y & 7) << 3) | (z & 7))


@wp.func
def sum_of(sums: wp.array3d(dtype=wp.int32), which: int, voxel: wp.int64):
    return wp.float64(sums[wp.int32(voxel >> wp.int64(9)), which, wp.int32(voxel & wp.int64(511))])


@wp.kernel(module=MODULE)
def place_vertices(
    edges: wp.array(dtype=wp.int64),
    asked: wp.array(dtype=wp.int64),
    above: wp.array2d(dtype=wp.int32),
    sums: wp.array3d(dtype=wp.int32),
    names: wp.array(dtype=wp.int64),
    near: wp.array(dtype=wp.int64),
    far: wp.array(dtype=wp.int64),
    share: wp.array(dtype=wp.float64),
):
    """densify.fusion.marching_cubes._place_vertices."""
    v = wp.tid()
    i = wp.int32(edges[v] // wp.int64(2187))
    edge = wp.int32(edges[v] % wp.int64(2187))
    axis = edge // 729
    voxel = edge % 729
    x = voxel // 81
    y = (voxel // 9) % 9
    z = voxel % 9
    eight = wp.int64(8)
    bx = eight * coordinate(asked[i], 0) + wp.int64(x)
    by = eight * coordinate(asked[i], 1) + wp.int64(y)
    bz = eight * coordinate(asked[i], 2) + wp.int64(z)
    one = voxel_of(above, i, x, y, z)
    two = voxel_of(
        above, i, x + wp.where(axis == 0, 1, 0), y + wp.where(axis == 1, 1, 0), z + wp.where(axis == 2, 1, 0)
    )
    here = sum_of(sums, 1, one) / sum_of(sums, 0, one)
    there = sum_of(sums, 1, two) / sum_of(sums, 0, two)
    names[v] = wp.int64(3) * packed(bx, by, bz) + wp.int64(axis)
    near[v] = one
    far[v] = two
    share[v] = here / (here - there)


@wp.kernel(module=MODULE)
def mean_colors(
    sums: wp.array3d(dtype=wp.int32),
    near: wp.array(dtype=wp.int64),
    far: wp.array(dtype=wp.int64),
    share: wp.array(dtype=wp.float64),
    colors: wp.array2d(dtype=wp.float32),
):
    """densify.fusion.volume._mean_colors."""
    i = wp.tid()
    t = share[i]
    rest = wp.float64(1.0) - t
    weight = wp.max(rest * sum_of(sums, 6, near[i]) + t * sum_of(sums, 6, far[i]), wp.float64(1e-9))
    for c in range(3):
        mean = (rest * sum_of(sums, 3 + c, near[i]) + t * sum_of(sums, 3 + c, far[i])) / weight
        colors[i, c] = wp.float32(mean)


@wp.kernel(module=MODULE)
def gather_vertices(
    firsts: wp.array(dtype=wp.int32),
    names: wp.array(dtype=wp.int64),
    near: wp.array(dtype=wp.int64),
    far: wp.array(dtype=wp.int64),
    share: wp.array(dtype=wp.float64),
    sums: wp.array3d(dtype=wp.int32),
    voxel: wp.float64,
    full: wp.float64,
    positions: wp.array2d(dtype=wp.float64),
    weights: wp.array(dtype=wp.float64),
    views: wp.array(dtype=wp.int32),
    near_kept: wp.array(dtype=wp.int64),
    far_kept: wp.array(dtype=wp.int64),
    share_kept: wp.array(dtype=wp.float64),
):
    """densify.fusion.volume.TsdfVolume.extract_mesh, of the vertices that are kept."""
    i = wp.tid()
    v = firsts[i]
    t = share[v]
    place = names[v] // wp.int64(3)
    axis = wp.int32(names[v] % wp.int64(3))
    for a in range(3):
        position = wp.float64(coordinate(place, a))
        if a == axis:
            position += t
        positions[i, a] = position * voxel
    one = near[v]
    two = far[v]
    rest = wp.float64(1.0) - t
    weights[i] = (rest * sum_of(sums, 0, one) + t * sum_of(sums, 0, two)) / full
    nearest = wp.where(t < wp.float64(0.5), one, two)
    views[i] = wp.int32(sum_of(sums, 2, nearest))
    near_kept[i] = one
    far_kept[i] = two
    share_kept[i] = t


@wp.kernel(module=MODULE)
def gather_triangles(
    numbers: wp.array(dtype=wp.int32), kept: wp.array(dtype=wp.int32), triangles: wp.array(dtype=wp.int64)
):
    i = wp.tid()
    triangles[i] = wp.int64(kept[numbers[i]])
