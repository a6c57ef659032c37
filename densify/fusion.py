"""TsdfVolume: views of any lens in, one surface out.

Notation: s signed distance of a voxel from the surface as one view has it, positive on the side of the camera, cut off
at tau; w that view's weight there, falling to 0 at tau behind the surface (Bylow et al., RSS 2013). A voxel holds
the sums of w and of w s / tau over views.

s is taken to the plane of the pixel that the voxel's direction falls into: exact on planes, whatever the slant, and no
image has to be resampled into pinhole views. Sums are of whole numbers. So a view can be taken out again, the order of
views does not matter, and a surface put together again after a loop closure is, bit for bit, that of a fresh run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from densify.marching_cubes import CORNERS, marching_cubes
from densify.rectify import FULL, SurfaceView
from lightdepth.errors import InputError

BLOCK = 8
"""Voxels along the side of a block, the piece in which the volume grows."""
STEPS = 2048
"""Steps of s / tau on either side of 0; a sum holds 4096 views of full weight."""
_CHUNK = 32  # blocks at a time: what they need stays in the cache
_COLORED = 2.0  # voxels from the surface that colour is kept for
_SPARSE = 4  # every so many pixels are enough to find the blocks

Block = tuple[int, int, int]
"""The place of a block in the volume, counted in blocks."""


@dataclass(frozen=True)
class FusionConfig:
    """Resolution and reach of the surface."""

    voxel: float | None = None  # map units; by default a typical observed distance over voxels_per_distance
    voxels_per_distance: float = 52.0
    truncation: float = 6.0  # voxels
    min_views: int = 1  # a surface voxel must be seen by at least this many views
    far: float = 2.0  # predictions beyond far times the 90th percentile of a keyframe's inlier distances are left out


@dataclass(frozen=True)
class Mesh:
    """vertices (n, 3) in map units, triangles (m, 3) that turn their front to the cameras, colors (n, 3) in [0, 1];
    for each vertex the weight (n,) of all views together, 1 being one view that nothing speaks against, and the number
    of views (n,)."""

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    weights: np.ndarray
    views: np.ndarray


class TsdfVolume:
    """A truncated signed distance volume that grows where surface is seen. `voxel` in map units."""

    def __init__(self, voxel: float, config: FusionConfig):
        if not np.isfinite(voxel) or voxel <= 0:
            raise InputError(f"voxel size {voxel}; expected a positive length in map units")
        self.voxel = voxel
        self.views = 0
        self._config = config
        self._rows: dict[Block, int] = {}  # place of a block, in blocks -> its row in the sums
        self._free: list[int] = []
        self._weight = np.zeros((0, BLOCK**3), np.int32)
        self._distance = np.zeros((0, BLOCK**3), np.int32)
        self._seen = np.zeros((0, BLOCK**3), np.int16)
        self._color = np.zeros((0, BLOCK**3, 4), np.int32)  # sums of w r, w g, w b and w, near the surface
        place = np.arange(BLOCK) * voxel
        self._offsets = np.stack(np.meshgrid(place, place, place, indexing="ij")).reshape(3, -1).astype(np.float32)

    def integrate(self, view: SurfaceView, cam_from_map: np.ndarray) -> set[Block]:
        """Adds what a view says, its pose being cam_from_map (4, 4). The blocks that changed."""
        return self._add(view, cam_from_map, 1)

    def remove(self, view: SurfaceView, cam_from_map: np.ndarray) -> set[Block]:
        """Takes out what `integrate` added for the same view at the same pose. The blocks that changed."""
        return self._add(view, cam_from_map, -1)

    def _add(self, view: SurfaceView, cam_from_map: np.ndarray, sign: int) -> set[Block]:
        blocks = self._touched(view, cam_from_map)
        if not len(blocks):
            return set()
        self.views += sign
        keys: list[Block] = [(x, y, z) for x, y, z in blocks.tolist()]
        rows = np.array([self._row(key) for key in keys], int)
        rotation, translation = cam_from_map[:3, :3], cam_from_map[:3, 3]
        corners = (blocks * (BLOCK * self.voxel) @ rotation.T + translation).astype(np.float32)
        offsets = rotation.astype(np.float32) @ self._offsets
        tau = np.float32(self._config.truncation * self.voxel)
        for start in range(0, len(rows), _CHUNK):
            chunk = rows[start : start + _CHUNK]
            points = [corners[start : start + _CHUNK, a, None] + offsets[a] for a in range(3)]
            pixels = view.table.look_up(*points)
            m_x, m_y, m_z, b = np.moveaxis(view.planes.take(pixels, 0), -1, 0)
            distance = b - m_x * points[0] - m_y * points[1] - m_z * points[2]
            behind = (1 + distance / tau).clip(0, 1)  # what lies behind a wall is ever less known
            weight = np.rint(view.weights.take(pixels) * behind).astype(np.int32)
            steps = np.rint(distance.clip(-tau, tau) * (STEPS / tau)).astype(np.int32)
            signed = sign * weight
            self._weight[chunk] += signed
            self._distance[chunk] += signed * steps
            self._seen[chunk] += np.sign(signed).astype(np.int16)
            block, voxel = np.nonzero((np.abs(distance) < _COLORED * self.voxel) & (weight > 0))
            colors = view.colors.take(pixels[block, voxel], 0) * signed[block, voxel, None]
            self._color[chunk[block], voxel] += colors
        for i in np.flatnonzero(~self._seen[rows].any(1)):
            self._free.append(self._rows.pop(keys[i]))
        return set(keys)

    def _touched(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray:
        """Places (n, 3) of the blocks that the surface of a view passes through or comes close to."""
        some = np.flatnonzero(view.weights)[::_SPARSE]
        if not len(some):
            return np.zeros((0, 3), int)
        points, normals = view.points[:, some], view.planes[some, :3].T
        rays = points * (np.float32(self._config.truncation * self.voxel) / np.sqrt((points**2).sum(0)))
        # Along the ray as far as the view speaks; across, to where marching cubes needs a neighbour.
        shifts = (-rays, 0, rays, -2 * np.float32(self.voxel) * normals, 2 * np.float32(self.voxel) * normals)
        around = np.concatenate([points + shift for shift in shifts], 1)
        rotation, translation = cam_from_map[:3, :3], cam_from_map[:3, 3]
        side = BLOCK * self.voxel
        place = (rotation.T / side).astype(np.float32) @ around - (rotation.T @ translation / side).astype(np.float32)[
            :, None
        ]
        place = np.floor(place).astype(np.int32)
        low, high = place.min(1), place.max(1)
        shape = high - low + 1
        if np.prod(shape.astype(float)) > 1e8:
            raise InputError(
                f"voxel size {self.voxel:.3g}: one view spans {' x '.join(map(str, shape))} blocks of {BLOCK} voxels; "
                "choose larger voxels"
            )
        touched = np.zeros(shape, bool)
        touched[tuple(place - low[:, None])] = True
        return np.argwhere(touched) + low

    def _row(self, block: Block) -> int:
        row = self._rows.get(block)
        if row is None:
            if not self._free:
                self._grow()
            row = self._rows[block] = self._free.pop()
        return row

    def _grow(self) -> None:
        held = len(self._weight)
        more = max(256, held // 2)
        for name in ("_weight", "_distance", "_seen", "_color"):
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)]))
        self._free = list(range(held + more - 1, held - 1, -1))

    def slots(self, places: np.ndarray) -> np.ndarray:
        """Where blocks (n, 3) are held (n,); -1 where there is none."""
        return np.array([self._rows.get((x, y, z), -1) for x, y, z in places.tolist()], int)

    def sides(self, slots: np.ndarray) -> np.ndarray:
        """Of held blocks (n,): 1 has voxels behind the surface, 2 before it, 3 both: only there is any surface."""
        known, behind = self._known(slots), self._distance[slots] < 0
        return (known & behind).any(1) + np.uint8(2) * (known & ~behind).any(1)

    def values(self, slots: np.ndarray) -> np.ndarray:
        """Signed distance (n, 8, 8, 8) of held blocks (n,) in truncations, NaN where too few views have seen it."""
        mean = self._distance[slots] / np.maximum(self._weight[slots], 1).astype(np.float32) / np.float32(STEPS)
        return np.where(self._known(slots), mean, np.float32(np.nan)).reshape(-1, BLOCK, BLOCK, BLOCK)

    def color_sums(self, voxels: np.ndarray) -> np.ndarray:
        """Weighted sums of red, green, blue (0 to 255) and of the weights (n, 4), at voxels 512 slot + place (n,)."""
        return self._color.reshape(-1, 4).take(voxels, 0)

    def _known(self, slots: np.ndarray) -> np.ndarray:
        return (self._weight[slots] > 0) & (self._seen[slots] >= self._config.min_views)

    @property
    def capacity(self) -> int:
        """Places for blocks, used or not: slots are below it."""
        return len(self._weight)

    @property
    def blocks(self) -> set[Block]:
        """Places of all blocks that hold anything."""
        return set(self._rows)

    def extract_mesh(self, blocks: set[Block] | None = None) -> Mesh:
        """The surface, or the part of it in some blocks' cells; empty when nothing was seen.

        A cell with a corner that too few views have seen has no surface. Cells reach into the next blocks: what
        changed with a set of blocks is in `reaching(blocks)`.
        """
        wanted = self.blocks if blocks is None else blocks & self.blocks
        needed = wanted if blocks is None else {_moved(b, c) for b in wanted for c in CORNERS.tolist()} & self.blocks
        places = np.array(sorted(needed), np.int64).reshape(-1, 3)
        shape = (len(places), BLOCK, BLOCK, BLOCK)
        keys: list[Block] = [(x, y, z) for x, y, z in places.tolist()]
        rows = np.array([self._rows[key] for key in keys], int)
        weight, seen = self._weight[rows], self._seen[rows]
        known = (weight > 0) & (seen >= self._config.min_views)
        values = np.where(known, self._distance[rows] / np.maximum(weight, 1), np.nan).astype(np.float32)
        cells_of = np.array([key in wanted for key in keys], bool)
        first, second, share, triangles = marching_cubes(values.reshape(shape), _neighbors(places), cells_of)

        def at(voxels: np.ndarray) -> np.ndarray:
            block, *inner = np.unravel_index(voxels, shape)
            return (places[block] * BLOCK + np.stack(inner, -1)) * self.voxel

        def between(sums: np.ndarray) -> np.ndarray:
            flat = sums.reshape(-1, *sums.shape[2:])
            t = share.reshape(-1, *[1] * (flat.ndim - 1))
            return (1 - t) * flat[first] + t * flat[second]

        t = share[:, None]
        color = between(self._color[rows])
        return Mesh(
            (1 - t) * at(first) + t * at(second),
            triangles,
            color[:, :3] / (255 * np.maximum(color[:, 3:], 1e-9)),
            between(weight) / FULL,
            np.where(share < 0.5, seen.reshape(-1)[first], seen.reshape(-1)[second]).astype(int),
        )


def reaching(blocks: set[Block]) -> set[Block]:
    """Blocks with a cell that has a corner in one of `blocks`: those whose surface changes with them."""
    return {_moved(b, (-c).tolist()) for b in blocks for c in CORNERS}


def _moved(block: Block, by: list[int]) -> Block:
    return block[0] + by[0], block[1] + by[1], block[2] + by[2]


def _neighbors(places: np.ndarray) -> np.ndarray:
    """Rows (n, 8) of the blocks at CORNERS from each of the places (n, 3), which are sorted; -1 where there is none."""
    if not len(places):
        return np.zeros((0, 8), int)
    from_low = places - places.min(0)
    shape = from_low.max(0) + 2
    keys = np.ravel_multi_index(from_low.T, shape)
    wanted = np.ravel_multi_index((from_low[:, None] + CORNERS).reshape(-1, 3).T, shape).reshape(-1, 8)
    row = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
    return np.where(keys[row] == wanted, row, -1)
