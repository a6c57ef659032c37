"""DeviceVolume: a TsdfVolume whose blocks lie on a GPU, or on the CPU, where it is there to be compared.

What comes back of a view is counts, the bounds of its blocks and the names of those that it may have changed; of the
surface, the names of its blocks and its mesh. Blocks that hold nothing any more keep their rows until they are more
than those that hold something.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from densify.fusion.marching_cubes import BLOCK, Cut, corners_of_cases
from densify.fusion.on_device.device import Device
from densify.fusion.posed import check_reach, into_blocks, seeds, voxel_offsets
from densify.fusion.rectify import FULL, DirectionTable, SurfaceView
from densify.fusion.volume import COLORED, FusionConfig, Mesh, checked_voxel

_SUMS, _VOXELS, _COLUMNS = 7, BLOCK**3, BLOCK**2
_EDGES = 3 * (BLOCK + 1) ** 3
"""Edges of a block with its border."""
_NAMES = 3 << 60
"""More than any name of an edge."""


class _Surface(NamedTuple):
    """The surface in k blocks: the end of each column's corners (64 k,); each corner's vertex (c,); and of each vertex
    its edge (v,), 2187 times the row asked for and its number there, and what Cut has of it. Arrays of Warp."""

    ends: Any
    corners: Any
    edges: Any
    names: Any
    near: Any
    far: Any
    share: Any


class DeviceVolume:
    """As densify.fusion.volume.TsdfVolume, whose numbers it has, on a device that Warp knows ("cuda:0", "cpu")."""

    def __init__(self, voxel: float, config: FusionConfig = FusionConfig(), device: str = "cuda"):
        self.voxel = checked_voxel(voxel)
        self.views = 0
        self._config, self._on = config, Device(device)
        self._view = 0  # views added or taken out so far, to know what the last one did
        self._rows = 0  # that are given away
        self._table: tuple[DirectionTable, Any] | None = None
        self._begin(1024)
        self._sums, self._columns = self._on.zeros((256, _SUMS, _VOXELS)), self._on.zeros((256, _COLUMNS, 2))

    def integrate(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray:
        """Adds what a view says, its pose being cam_from_map (4, 4). Packed places (n,) of the blocks whose part of the
        surface may have changed, those that are no longer held included."""
        return self._add(view, cam_from_map, 1)

    def remove(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray:
        """Takes out what `integrate` added for the same view at the same pose; the places as of `integrate`."""
        return self._add(view, cam_from_map, -1)

    def _add(self, view: SurfaceView, cam_from_map: np.ndarray, sign: int) -> np.ndarray:
        some = seeds(view)
        if not len(some):
            return np.zeros(0, np.int64)
        on, wp, side = self._on, self._on.warp, BLOCK * self.voxel
        tau = np.float32(self._config.truncation * self.voxel)
        planes = on.array(view.planes, np.float32)
        near, bounds = on.empty((len(some), 5, 3)), on.array([[2**31 - 1] * 3, [-(2**31)] * 3], np.int32)
        rotation, shift = into_blocks(cam_from_map, side)
        on.launch(
            on.adding.blocks_near, len(some), on.array(view.points, np.float32), planes, on.array(some, np.int32),
            tau, np.float32(2 * self.voxel), wp.mat33(rotation), wp.vec3(shift), near, bounds,
        )  # fmt: skip
        check_reach(self.voxel, *bounds.numpy())
        touched = self._touched(near)
        self.views += sign
        on.launch(
            on.adding.add_view, (len(touched), _COLUMNS), touched, self._names, side,
            wp.mat33d(cam_from_map[:3, :3]), wp.vec3d(cam_from_map[:3, 3]),
            on.array(voxel_offsets(self.voxel, cam_from_map), np.float32),
            self._cells(view.table), np.float32(view.table.scale),
            planes, on.array(view.weights, np.uint8), on.array(view.colors, np.uint8),
            tau, np.float32(self._config.front), np.float32(COLORED * self.voxel), sign, self._config.min_views,
            self._sums, self._columns, self._held, self._counts,
        )  # fmt: skip
        changed = on.empty(8 * len(touched), np.int64)
        on.launch(
            on.adding.name_changed, (len(touched), 8), touched, self._names, self._keys, self._entries, self._view,
            self._stamps, self._told, self._held, changed, self._counts,
        )  # fmt: skip
        count = int(self._counts.numpy()[on.naming.CHANGED])
        return np.sort(changed[:count].numpy())

    def _touched(self, near: Any) -> Any:
        """The rows of the blocks at places (n, 5, 3), given away where there are none."""
        on, most = self._on, 5 * near.shape[0]
        held = int(self._counts.numpy()[on.naming.HELD])
        if self._rows > 2 * held + 1024 or 2 * (self._rows + most) > self._keys.shape[0]:
            self._rebuild(held, held + most)
        self._view += 1
        self._counts.assign([self._rows, 0, 0, held])
        dim, touched = (near.shape[0], 5), on.empty(most)
        on.launch(on.adding.give_rows, dim, near, self._keys, self._entries, self._names, self._counts)
        on.launch(
            on.adding.touch, dim, near, self._keys, self._entries, self._view, self._stamps, self._held, touched,
            self._counts,
        )  # fmt: skip
        counts = self._counts.numpy()
        self._rows = int(counts[on.naming.BLOCKS])
        if self._rows > self._sums.shape[0]:
            self._sums, self._columns = (
                on.longer(array, self._rows + self._rows // 2) for array in (self._sums, self._columns)
            )
        return touched[: int(counts[on.naming.TOUCHED])]

    def _cells(self, table: DirectionTable) -> Any:
        """A table's cells, which views of one lens share."""
        if self._table is None or self._table[0] is not table:
            self._table = table, self._on.array(table.cells, np.int32)
        return self._table[1]

    # Rows

    def _begin(self, blocks: int) -> None:
        """Empties the table, and makes it large enough for so many blocks."""
        size = 1 << (2 * blocks).bit_length()
        self._keys = self._on.zeros(size, np.int64)
        self._keys.fill_(-1)
        self._entries = self._on.zeros(size)
        self._names = self._on.empty(size // 2, np.int64)
        self._held, self._stamps, self._told = (self._on.zeros(size // 2) for _ in range(3))
        self._counts = self._on.zeros(4)

    def _rebuild(self, held: int, blocks: int) -> None:
        """Gives rows to what is held alone, in a table for so many blocks."""
        rows, old_names, old_held, sums, columns = self._rows, self._names, self._held, self._sums, self._columns
        self._begin(2 * blocks)
        new_rows = self._on.empty(rows)
        self._on.launch(self._on.naming.keep_held, rows, old_held, old_names, self._counts, new_rows, self._names)
        self._on.launch(self._on.naming.enter_names, held, self._names, self._keys, self._entries)
        self._held[:held].fill_(1)
        self._sums, self._columns = (
            self._on.zeros((max(256, held + held // 2), *array.shape[1:])) for array in (sums, columns)
        )
        for old, new in ((sums, self._sums), (columns, self._columns)):
            flat = [array.reshape((array.shape[0], -1)) for array in (old, new)]
            self._on.launch(self._on.naming.move_rows, (rows, flat[0].shape[1]), new_rows, *flat)
        self._rows = held

    @property
    def places(self) -> np.ndarray:
        """Packed places (n,) of all blocks that hold anything, in order."""
        names, held = self._names[: self._rows].numpy(), self._held[: self._rows].numpy()
        return np.sort(names[held > 0])

    def slots(self, codes: np.ndarray) -> np.ndarray:
        """Where blocks (n,), packed, are held (n,); -1 where there is none."""
        found = self._on.empty(len(codes))
        names = self._on.array(codes, np.int64)
        self._on.launch(self._on.naming.find_rows, len(codes), names, self._keys, self._entries, self._held, found)
        result: np.ndarray = found.numpy().astype(np.int64)
        return result

    # Surface

    def cut(self, slots: np.ndarray) -> Cut:
        """The surface in the blocks at slots (n,). Of vertices inside a block, TsdfVolume may have another order."""
        names = self._names[: self._rows].numpy()[slots]
        found = self._cut(names)
        if found is None:
            none, start = np.zeros(0, np.int64), np.zeros(1, np.int64)
            return Cut(none, none, none, np.zeros(0), np.zeros((0, 3), np.uint16), none, start, start)
        ends = np.concatenate([[0], found.ends.numpy()[_COLUMNS - 1 :: _COLUMNS]])
        rows = np.flatnonzero(np.diff(ends))
        first_vertex = np.searchsorted(found.edges.numpy(), np.append(rows, len(names)) * _EDGES)
        corners = found.corners.numpy() - np.repeat(first_vertex[:-1], np.diff(ends)[rows])
        return Cut(
            found.names.numpy(), found.near.numpy(), found.far.numpy(), found.share.numpy(),
            corners.astype(np.uint16).reshape(-1, 3), rows, first_vertex, np.append(ends[rows], ends[-1]) // 3,
        )  # fmt: skip

    def _cut(self, names: np.ndarray) -> _Surface | None:
        """The surface in the blocks of these names; None where they have none."""
        if not len(names):
            return None
        on, kernels, dim = self._on, self._on.cutting, (len(names), _COLUMNS)
        asked, above, corners = on.array(names, np.int64), on.empty((len(names), 8)), on.empty(len(names) * _COLUMNS)
        cases, of_case = (on.array(table, np.int32) for table in corners_of_cases())
        on.launch(kernels.find_above, (len(names), 8), asked, self._keys, self._entries, above)
        on.launch(kernels.count_corners, dim, above, self._columns, of_case, corners)
        ends = on.running_sums(corners)
        count = int(ends[-1:].numpy()[0])
        if not count:
            return None
        edges = on.empty(2 * count, np.int64)
        on.launch(kernels.write_corners, dim, above, self._columns, of_case, cases, ends, edges)
        found = on.runs(edges, len(names) * _EDGES)
        v = found.keys.shape[0]
        made = [on.empty(v, t) for t in (np.int64, np.int64, np.int64, np.float64)]
        on.launch(kernels.place_vertices, v, found.keys, asked, above, self._sums, *made)
        return _Surface(ends, found.numbers, found.keys, *made)

    def colors_at(self, found: Cut) -> np.ndarray:
        """Colours (v, 3) float32, 0 to 255, of the vertices of a cut."""
        near, far = (self._on.array(voxels, np.int64) for voxels in (found.near, found.far))
        return self._colors(near, far, self._on.array(found.share, np.float64))

    def _colors(self, near: Any, far: Any, share: Any) -> np.ndarray:
        colors = self._on.empty((share.shape[0], 3), np.float32)
        self._on.launch(self._on.cutting.mean_colors, share.shape[0], self._sums, near, far, share, colors)
        result: np.ndarray = colors.numpy()
        return result

    def extract_mesh(self) -> Mesh:
        """The whole surface; empty when nothing was seen. A cell with a corner that too few views saw has none."""
        found, on = self._cut(self.places), self._on
        if found is None:
            none = np.zeros((0, 3))
            return Mesh(none, np.zeros((0, 3), int), none.astype(np.float32), np.zeros(0), np.zeros(0, int))
        v = found.names.shape[0]
        names = on.empty(2 * v, np.int64)
        on.warp.copy(names, found.names, count=v)
        kept = on.runs(names, _NAMES)
        n, corners = kept.firsts.shape[0], found.corners.shape[0]
        positions, weights, views = on.empty((n, 3), np.float64), on.empty(n, np.float64), on.empty(n)
        triangles, ends = on.empty(corners, np.int64), [on.empty(n, t) for t in (np.int64, np.int64, np.float64)]
        on.launch(
            on.cutting.gather_vertices, n, kept.firsts, found.names, found.near, found.far, found.share,
            self._sums, float(self.voxel), float(FULL), positions, weights, views, *ends,
        )  # fmt: skip
        on.launch(on.cutting.gather_triangles, corners, found.corners, kept.numbers, triangles)
        return Mesh(
            positions.numpy(), triangles.numpy().reshape(-1, 3), self._colors(*ends) / 255.0,
            weights.numpy(), views.numpy().astype(int),
        )  # fmt: skip
