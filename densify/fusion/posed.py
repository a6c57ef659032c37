"""A view at its pose, as both kinds of volume take it: where blocks and voxels are in camera axes, and what is too far.

Sums stand here written out, one rounding after the other: a product of matrices rounds as its library and processor
like, and then the same view would add other numbers elsewhere.
"""

from __future__ import annotations

import numpy as np

from densify.fusion.marching_cubes import BLOCK, REACH
from densify.fusion.rectify import SurfaceView
from lightdepth.errors import InputError

_SPARSE = 4  # every so many pixels are enough to find the blocks


def seeds(view: SurfaceView) -> np.ndarray:
    """The pixels (n,) that a view's blocks are found from."""
    return np.flatnonzero(view.weights)[::_SPARSE]


def into_blocks(cam_from_map: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3) and t (3,), float32, with which the camera's X lies in block R X - t of the map, blocks being `side`
    long."""
    turned = cam_from_map[:3, :3].T
    moved = turned @ cam_from_map[:3, 3] / side
    return (turned / side).astype(np.float32), moved.astype(np.float32)


def block_origins(places: np.ndarray, side: float, cam_from_map: np.ndarray) -> np.ndarray:
    """The first voxels (n, 3) float32 of blocks at places (n, 3), in camera axes."""
    x, y, z = (places * side).T
    turned = (r[0] * x + r[1] * y + r[2] * z + r[3] for r in cam_from_map[:3])
    return np.stack([axis.astype(np.float32) for axis in turned], -1)


def voxel_offsets(voxel: float, cam_from_map: np.ndarray) -> np.ndarray:
    """From a block's first voxel to all of them, (3, 512) float32, in camera axes."""
    place = np.arange(BLOCK) * voxel
    x, y, z = (a.ravel().astype(np.float32) for a in np.meshgrid(place, place, place, indexing="ij"))
    return np.stack([r[0] * x + r[1] * y + r[2] * z for r in cam_from_map[:3, :3].astype(np.float32)])


def check_reach(voxel: float, low: np.ndarray, high: np.ndarray) -> None:
    """Raises InputError where a view's blocks, from places low (3,) to high (3,), are too far or too many."""
    farthest = BLOCK * np.abs(np.array([low, high], np.int64)).max()
    if farthest >= REACH - 2 * BLOCK:
        raise InputError(
            "voxel size",
            f"at {voxel:.3g} one view reaches {farthest} voxels from the map's origin",
            f"at most {REACH} are possible: choose larger voxels",
        )
    shape = high.astype(np.int64) - low + 1
    if np.prod(shape.astype(float)) > 1e8:
        raise InputError(
            "voxel size",
            f"at {voxel:.3g} one view spans {' x '.join(map(str, shape))} blocks of {BLOCK} voxels",
            "choose larger voxels",
        )
