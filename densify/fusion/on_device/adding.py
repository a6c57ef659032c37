"""What a view adds to a volume, as NVIDIA Warp compiles it for a GPU or a CPU (densify.fusion.on_device.naming).

A block is a row of `sums` (n, 7, 512): of its voxels the sums of w, of w s / tau, of views, and of w r, w g, w b and w
near the surface; and of `columns` (n, 64, 2): bits z of 8 x + y, behind the surface and known.
"""

# mypy: ignore-errors
# Annotations are Warp's own types and are read when a kernel is made: no postponed evaluation here.

import numpy as np
import warp as wp

from densify.fusion.on_device.naming import (
    BLOCKS,
    CHANGED,
    HELD,
    MODULE,
    TOUCHED,
    beside,
    coordinate,
    entered,
    packed,
    row_of,
)
from densify.fusion.volume import STEPS

_STEPS = wp.constant(wp.float32(STEPS))
_ASIDE, _TENTH, _TINY = (wp.constant(wp.float32(np.float32(x))) for x in (1e-5, 0.1, 1e-30))


# Blocks that a view reaches


@wp.kernel(module=MODULE)
def blocks_near(
    points: wp.array2d(dtype=wp.float32),
    planes: wp.array2d(dtype=wp.float32),
    some: wp.array(dtype=wp.int32),
    tau: wp.float32,
    across: wp.float32,
    rotation: wp.mat33,
    shift: wp.vec3,
    near: wp.array3d(dtype=wp.int32),
    bounds: wp.array2d(dtype=wp.int32),
):
    """densify.fusion.volume._blocks_near: near (n, 5, 3), and the lowest and the highest of bounds (2, 3)."""
    i = wp.tid()
    pixel = some[i]
    x = points[0, pixel]
    y = points[1, pixel]
    z = points[2, pixel]
    reach = tau / wp.sqrt(x * x + y * y + z * z)
    u = across * planes[pixel, 0]
    v = across * planes[pixel, 1]
    w = across * planes[pixel, 2]
    for a in range(3):
        place = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z
        aside = rotation[a, 0] * u + rotation[a, 1] * v + rotation[a, 2] * w
        middle = wp.int32(wp.floor(place + wp.float32(0.0) - shift[a]))
        far = wp.int32(wp.floor(place + place * reach - shift[a]))
        close = wp.int32(wp.floor(place + (-place) * reach - shift[a]))
        one = wp.int32(wp.floor(place + aside - shift[a]))
        other = wp.int32(wp.floor(place + (-aside) - shift[a]))
        near[i, 0, a] = middle
        near[i, 1, a] = far
        near[i, 2, a] = close
        near[i, 3, a] = one
        near[i, 4, a] = other
        wp.atomic_min(bounds, 0, a, wp.min(middle, wp.min(wp.min(far, close), wp.min(one, other))))
        wp.atomic_max(bounds, 1, a, wp.max(middle, wp.max(wp.max(far, close), wp.max(one, other))))


@wp.kernel(module=MODULE)
def give_rows(
    near: wp.array3d(dtype=wp.int32),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=wp.int32),
    names: wp.array(dtype=wp.int64),
    counts: wp.array(dtype=wp.int32),
):
    """A row to each block that has none."""
    i, k = wp.tid()
    name = packed(wp.int64(near[i, k, 0]), wp.int64(near[i, k, 1]), wp.int64(near[i, k, 2]))
    at = entered(name, keys)
    if at >= 0:
        row = wp.atomic_add(counts, BLOCKS, 1)
        rows[at] = row
        names[row] = name


@wp.kernel(module=MODULE)
def touch(
    near: wp.array3d(dtype=wp.int32),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=wp.int32),
    view: int,
    stamps: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    touched: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
):
    """Each row that a view reaches goes into `touched` once. Until the view is added, it counts as one that holds
    nothing."""
    i, k = wp.tid()
    name = packed(wp.int64(near[i, k, 0]), wp.int64(near[i, k, 1]), wp.int64(near[i, k, 2]))
    row = row_of(name, keys, rows)
    if wp.atomic_exch(stamps, row, view) != view:
        touched[wp.atomic_add(counts, TOUCHED, 1)] = row
        wp.atomic_add(counts, HELD, -held[row])
        held[row] = 0


# Sums


@wp.func
def pixel_of(cells: wp.array2d(dtype=wp.int32), scale: wp.float32, x: wp.float32, y: wp.float32, z: wp.float32):
    """densify.fusion.rectify._look_up."""
    zero = wp.float32(0.0)
    half = wp.float32(wp.float64(cells.shape[0]) / wp.float64(2.0))
    last = wp.float32(cells.shape[0] - 1)
    length = wp.sqrt(x * x + y * y + z * z)
    aside = length * _ASIDE
    least = _TENTH * aside + _TINY
    s = scale / wp.where(length + z > least, length + z, least)
    column = (x + aside) * s + half
    row = (y + aside) * s + half
    column = wp.where(column > zero, column, zero)
    column = wp.where(column < last, column, last)
    row = wp.where(row > zero, row, zero)
    row = wp.where(row < last, row, last)
    return cells[wp.int32(row), wp.int32(column)]


@wp.kernel(module=MODULE)
def add_view(
    touched: wp.array(dtype=wp.int32),
    names: wp.array(dtype=wp.int64),
    side: wp.float64,
    rotation: wp.mat33d,
    translation: wp.vec3d,
    offsets: wp.array2d(dtype=wp.float32),
    cells: wp.array2d(dtype=wp.int32),
    scale: wp.float32,
    planes: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.uint8),
    colors: wp.array2d(dtype=wp.uint8),
    tau: wp.float32,
    front: wp.float32,
    colored: wp.float32,
    sign: int,
    least: int,
    sums: wp.array3d(dtype=wp.int32),
    columns: wp.array3d(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
):
    """densify.fusion.volume._add_view, a thread for each column of eight voxels; with the blocks' origins
    (densify.fusion.posed) and the look-ups."""
    i, column = wp.tid()
    row = touched[i]
    name = names[row]
    px = wp.float64(coordinate(name, 0)) * side
    py = wp.float64(coordinate(name, 1)) * side
    pz = wp.float64(coordinate(name, 2)) * side
    a = wp.float32(rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + translation[0])
    b = wp.float32(rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + translation[1])
    c = wp.float32(rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + translation[2])
    zero = wp.float32(0.0)
    one = wp.float32(1.0)
    steps = _STEPS / tau
    per_tau = one / tau
    fall = (front - one) / tau
    behind = wp.int32(0)
    known = wp.int32(0)
    left = wp.int32(0)
    for z in range(8):
        v = 8 * column + z
        x0 = a + offsets[0, v]
        x1 = b + offsets[1, v]
        x2 = c + offsets[2, v]
        pixel = pixel_of(cells, scale, x0, x1, x2)
        d = planes[pixel, 3] - planes[pixel, 0] * x0
        d = d - planes[pixel, 1] * x1 - planes[pixel, 2] * x2
        s = d
        trust = one + d * per_tau
        trust = wp.where(trust > zero, trust, zero)
        d = wp.where(d < tau, d, tau)
        opening = one + d * fall
        trust = wp.where(trust < opening, trust, opening)
        d = wp.where(d > -tau, d, -tau)
        w = wp.int32(wp.rint(wp.float32(weights[pixel]) * trust)) * sign
        sum_w = sums[row, 0, v] + w
        sum_ws = sums[row, 1, v] + w * wp.int32(wp.rint(d * steps))
        seen = sums[row, 2, v]
        if w != 0:
            seen += sign
            sums[row, 0, v] = sum_w
            sums[row, 1, v] = sum_ws
            sums[row, 2, v] = seen
            if wp.abs(s) < colored:
                for k in range(4):
                    sums[row, 3 + k, v] += w * wp.int32(colors[pixel, k])
        left |= seen
        if sum_ws < 0:
            behind |= 1 << z
        if sum_w > 0 and seen >= least:
            known |= 1 << z
    columns[row, column, 0] = behind
    columns[row, column, 1] = known
    if left != 0 and wp.atomic_exch(held, row, 1) == 0:
        wp.atomic_add(counts, HELD, 1)


@wp.kernel(module=MODULE)
def name_changed(
    touched: wp.array(dtype=wp.int32),
    names: wp.array(dtype=wp.int64),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=wp.int32),
    view: int,
    stamps: wp.array(dtype=wp.int32),
    told: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    changed: wp.array(dtype=wp.int64),
    counts: wp.array(dtype=wp.int32),
):
    """The names of the touched blocks, and of those below them that hold anything: each once."""
    i, corner = wp.tid()
    name = beside(names[touched[i]], corner, wp.int64(-1))
    row = row_of(name, keys, rows)
    if row >= 0 and (held[row] == 1 or stamps[row] == view) and wp.atomic_exch(told, row, view) != view:
        changed[wp.atomic_add(counts, CHANGED, 1)] = name
