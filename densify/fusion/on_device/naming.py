"""Names of blocks and the table in which their rows are found, as NVIDIA Warp compiles them for a GPU or a CPU.

The loops of densify.fusion.volume, rectify and marching_cubes are the reference for all kernels of this room, to the
bit. So each sum and product stands in their order and precision, none are fused into one rounding (`fuse_fp`), and no
function is called but square root, rounding and floor, which IEEE 754 gives one value each. What threads add together
is whole numbers.

A table has open addresses, and a power of two of them: a name in `keys`, the block's row in `rows`.
"""

# mypy: ignore-errors
# Annotations are Warp's own types and are read when a kernel is made: no postponed evaluation here.

import warp as wp

from densify.fusion.marching_cubes import REACH

MODULE = wp.get_module("lightdepth_fusion")
"""What all kernels of this room are compiled in, at once."""
wp.set_module_options({"fuse_fp": False, "fast_math": False, "enable_backward": False, "max_unroll": 4}, MODULE)

NONE = wp.constant(wp.int64(-1))
"""The name in an entry of the table that holds none."""
BLOCKS, TOUCHED, CHANGED, HELD = (wp.constant(i) for i in range(4))
"""What is counted: rows given away, blocks that a view reaches, those that it may have changed, those that hold
anything."""

_REACH = wp.constant(wp.int64(REACH))
_BITS = wp.constant(wp.int64(20))
_LOW = wp.constant(wp.int64(2**20 - 1))


@wp.func
def packed(x: wp.int64, y: wp.int64, z: wp.int64):
    return ((x + _REACH) << _BITS << _BITS) | ((y + _REACH) << _BITS) | (z + _REACH)


@wp.func
def coordinate(name: wp.int64, axis: int):
    """One of the three numbers of a packed place."""
    part = name
    if axis == 0:
        part = name >> _BITS >> _BITS
    elif axis == 1:
        part = name >> _BITS
    return (part & _LOW) - _REACH


@wp.func
def beside(name: wp.int64, corner: int, way: wp.int64):
    """The name of the block at a corner of a block's cube, upwards (way 1) or downwards (-1)."""
    x = wp.int64(corner & 1)
    y = wp.int64((corner >> 1) & 1)
    z = wp.int64((corner >> 2) & 1)
    return name + way * ((x << _BITS << _BITS) + (y << _BITS) + z)


@wp.func
def first_entry(name: wp.int64, mask: int):
    return wp.int32((wp.uint64(name) * wp.uint64(0x9E3779B97F4A7C15)) >> wp.uint64(33)) & mask


@wp.func
def row_of(name: wp.int64, keys: wp.array(dtype=wp.int64), rows: wp.array(dtype=wp.int32)):
    """The row of a block, -1 where there is none."""
    mask = keys.shape[0] - 1
    at = first_entry(name, mask)
    while keys[at] != name:
        if keys[at] == NONE:
            return -1
        at = (at + 1) & mask
    return rows[at]


@wp.func
def entered(name: wp.int64, keys: wp.array(dtype=wp.int64)):
    """The entry that is now a name's own, -1 where the name was there already."""
    mask = keys.shape[0] - 1
    at = first_entry(name, mask)
    there = wp.atomic_cas(keys, at, NONE, name)
    while there != NONE and there != name:
        at = (at + 1) & mask
        there = wp.atomic_cas(keys, at, NONE, name)
    if there == name:
        return -1
    return at


# Blocks that hold something, and where they are


@wp.kernel(module=MODULE)
def keep_held(
    held: wp.array(dtype=wp.int32),
    names: wp.array(dtype=wp.int64),
    counts: wp.array(dtype=wp.int32),
    new_rows: wp.array(dtype=wp.int32),
    new_names: wp.array(dtype=wp.int64),
):
    """A new row to each block that holds anything, -1 to the others."""
    i = wp.tid()
    new_rows[i] = -1
    if held[i] == 1:
        row = wp.atomic_add(counts, BLOCKS, 1)
        new_rows[i] = row
        new_names[row] = names[i]


@wp.kernel(module=MODULE)
def enter_names(names: wp.array(dtype=wp.int64), keys: wp.array(dtype=wp.int64), rows: wp.array(dtype=wp.int32)):
    i = wp.tid()
    rows[entered(names[i], keys)] = i


@wp.kernel(module=MODULE)
def move_rows(new_rows: wp.array(dtype=wp.int32), source: wp.array2d(dtype=wp.int32), to: wp.array2d(dtype=wp.int32)):
    i, k = wp.tid()
    if new_rows[i] >= 0:
        to[new_rows[i], k] = source[i, k]


@wp.kernel(module=MODULE)
def find_rows(
    names: wp.array(dtype=wp.int64),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    found: wp.array(dtype=wp.int32),
):
    """Rows of blocks by their names; -1 where nothing is held."""
    i = wp.tid()
    row = row_of(names[i], keys, rows)
    found[i] = -1
    if row >= 0 and held[row] == 1:
        found[i] = row


@wp.kernel(module=MODULE)
def count_up(values: wp.array(dtype=wp.int32)):
    i = wp.tid()
    values[i] = i
