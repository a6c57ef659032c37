"""TsdfVolume: views of any lens in, one surface out.

Notation: s signed distance of a voxel from the surface as one view has it, positive on the side of the camera, cut off
at tau; w that view's weight there, falling to 0 at tau behind the surface (Bylow et al., RSS 2013) and to `front`
of it at tau before, so that where a view ends nothing jumps. A voxel holds the sums of w and of w s / tau over views.

s is taken to the plane of the pixel that the voxel's direction falls into: exact on planes, whatever the slant, and no
image has to be resampled into pinhole views. Sums are of whole numbers. So a view can be taken out again, the order of
views does not matter, and a surface put together again after a loop closure is, bit for bit, that of a fresh run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from densify.fusion.marching_cubes import BLOCK, CORNERS, Cut, cut, one_vertex_an_edge, packed
from densify.fusion.posed import block_origins, check_reach, into_blocks, seeds, voxel_offsets
from densify.fusion.rectify import FULL, SurfaceView
from densify.fusion.second_core import halves
from lightdepth.compiled import compiled
from lightdepth.errors import InputError
from lightdepth.ranges import COUNT, SHARE, above, checked
from lightdepth.sparse_map import Submap, typical_distance

STEPS = 2048
"""Steps of s / tau on either side of 0; a sum holds 4096 views of full weight."""
COLORED = 2.0
"""Voxels from the surface that colour is kept for."""


@dataclass(frozen=True)
@checked
class FusionConfig:
    """Resolution and reach of the surface."""

    voxel: Annotated[float | None, above(0)] = None
    """Edge of a voxel, the smallest cell of the volume that the surface is made in, map units; left out,
    voxels_per_distance sets it. A larger one makes a coarser surface in less time."""
    voxels_per_distance: Annotated[float, above(0, up_to=1000)] = 52.0
    """Number of voxels in the typical distance from a submap's keyframes to their points, which sets the voxels' size
    where voxel is left out. More make a finer surface and take more time and memory."""
    truncation: Annotated[float, above(0, up_to=1000)] = 6.0
    """Distance before and behind the surface, voxels, over which what the keyframes say is averaged (a TSDF's
    truncation). A larger one smooths more noise away, and more thin folds with it."""
    min_views: Annotated[int, COUNT] = 1
    """Least number of keyframes that must have seen a piece of surface for it to be kept; the recipe paper keeps all.
    More leave out what few have seen."""
    front: Annotated[float, SHARE] = 0.3
    """Weight, from 0 to 1, of a keyframe in the space that it looks through, at the truncation's distance in front of
    its wall or more; from the wall to there it falls steadily. A larger one cuts away more of what keyframes look
    through, with steps where they disagree; 1 cuts with full weight."""
    far: Annotated[float, above(0)] = 2.0
    """Farthest distance from a keyframe that is fused, as a multiple of the distance within which 90 % of its inliers
    lie. A larger one reaches farther, where depth is worse."""

    max_error: Annotated[float, above(0)] = 12.0
    """Largest expected error, as a ratio to distance in per cent, with which a pixel is still fused. It is estimated
    from the pixel's uncertainty, its slant, how far it lies beyond the map's points, and its light. A larger one keeps
    more of the wall, less accurately; the recipe paper keeps all."""

    def voxel_for(self, submap: Submap) -> float:
        """The size of a voxel, in map units."""
        return self.voxel or typical_distance(submap) / self.voxels_per_distance


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


def checked_voxel(voxel: float) -> float:
    """Itself. Raises InputError where a voxel has no size."""
    if not np.isfinite(voxel) or voxel <= 0:
        raise InputError("voxel size", f"{voxel}", "expected a positive length in map units")
    return voxel


class TsdfVolume:
    """A truncated signed distance volume that grows where surface is seen. `voxel` in map units.

    It grows in blocks of 8 x 8 x 8 voxels, each named by its place, counted in blocks and packed into one number
    (densify.fusion.marching_cubes), and held in a slot.
    """

    def __init__(self, voxel: float, config: FusionConfig = FusionConfig()):
        self.voxel = checked_voxel(voxel)
        self.views = 0
        self._config = config
        self._held = np.zeros((2, 0), np.int64)  # packed places of all blocks, in order, and their slots
        self._free: list[int] = []
        self._codes = np.zeros(0, np.int64)
        # Neighbour slots: _above[b, c] is the block at b + CORNERS[c], _below[b, c] the one at b - CORNERS[c]; -1 where
        # there is none.
        self._above = np.full((0, 8), -1, np.int32)
        self._below = np.full((0, 8), -1, np.int32)
        self._behind = np.zeros((0, BLOCK**2), np.uint8)  # bit z of 8 x + y: a voxel behind the surface
        self._known = np.zeros((0, BLOCK**2), np.uint8)  # and one that enough views have seen
        self._weight = np.zeros((0, BLOCK**3), np.int32)
        self._distance = np.zeros((0, BLOCK**3), np.int32)
        self._seen = np.zeros((0, BLOCK**3), np.int16)
        self._color = np.zeros((0, BLOCK**3, 4), np.int32)  # sums of w r, w g, w b and w, near the surface

    def integrate(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray:
        """Adds what a view says, its pose being cam_from_map (4, 4). Packed places (n,) of the blocks whose part of the
        surface may have changed, those that are no longer held included."""
        return self._add(view, cam_from_map, 1)

    def remove(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray:
        """Takes out what `integrate` added for the same view at the same pose; the places as of `integrate`."""
        return self._add(view, cam_from_map, -1)

    def _add(self, view: SurfaceView, cam_from_map: np.ndarray, sign: int) -> np.ndarray:
        places = self._touched(view, cam_from_map)
        if not len(places):
            return np.zeros(0, np.int64)
        self.views += sign
        slots = self._hold(packed(places))
        origins = block_origins(places, BLOCK * self.voxel, cam_from_map)
        offsets = voxel_offsets(self.voxel, cam_from_map)
        pixels = view.table.look_up(origins, offsets)
        any_left = np.zeros(len(slots), bool)
        halves(
            lambda first, end: _add_view(
                self._weight, self._distance, self._seen, self._color, self._behind, self._known, slots,
                origins, offsets, pixels, view.planes, view.weights, view.colors,
                np.float32(self._config.truncation * self.voxel), np.float32(self._config.front),
                np.float32(COLORED * self.voxel), sign,
                self._config.min_views, first, end, any_left,
            ),
            len(slots),
        )  # fmt: skip
        touched = np.unique(self._below[slots])
        codes = self._codes[touched[touched >= 0]]
        self._release(slots[~any_left])
        result: np.ndarray = codes
        return result

    def _touched(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray:
        """Places (n, 3), in order, of the blocks that the surface of a view passes through or comes close to."""
        some = seeds(view)
        if not len(some):
            return np.zeros((0, 3), int)
        rotation, shift = into_blocks(cam_from_map, BLOCK * self.voxel)
        tau = np.float32(self._config.truncation * self.voxel)
        across = np.float32(2 * self.voxel)
        near, low, high = _blocks_near(view.points, view.planes, some, tau, across, rotation, shift)
        check_reach(self.voxel, low, high)
        touched = np.zeros(high - low + 1, bool)
        _mark(touched, near, low)
        result: np.ndarray = np.argwhere(touched) + low
        return result

    def _hold(self, codes: np.ndarray) -> np.ndarray:
        """The slots (n,) of blocks, which are given one where they have none."""
        slots = self.slots(codes)
        new = np.flatnonzero(slots < 0)
        if len(new):
            self._grow(len(new))
            slots[new] = taken = [self._free.pop() for _ in range(len(new))]
            self._codes[taken] = codes[new]
            held = np.concatenate([self._held, [codes[new], taken]], 1)
            self._held = held[:, np.argsort(held[0], kind="stable")]
            for corner, step in enumerate(_CODE_STEPS.tolist()):
                for here, back, way in ((self._above, self._below, step), (self._below, self._above, -step)):
                    here[taken, corner] = there = self.slots(codes[new] + way)
                    back[there[there >= 0], corner] = slots[new][there >= 0]
        return slots

    def _release(self, slots: np.ndarray) -> None:
        """Gives up blocks that hold nothing."""
        if not len(slots):
            return
        for corner in range(8):
            for here, back in ((self._above, self._below), (self._below, self._above)):
                there = here[slots, corner]
                back[there[there >= 0], corner] = -1
        self._above[slots] = self._below[slots] = -1
        self._held = self._held[:, ~np.isin(self._held[1], slots)]
        self._free += slots.tolist()

    def _grow(self, wanted: int) -> None:
        held = len(self._codes)
        if wanted <= len(self._free):
            return
        more = max(256, held // 2, wanted)
        for name in ("_codes", "_above", "_below", "_behind", "_known", "_weight", "_distance", "_seen", "_color"):
            array = getattr(self, name)
            longer = np.zeros((held + more, *array.shape[1:]), array.dtype)
            longer[:held] = array
            if name in ("_above", "_below"):
                longer[held:] = -1
            setattr(self, name, longer)
        self._free += range(held + more - 1, held - 1, -1)

    def slots(self, codes: np.ndarray) -> np.ndarray:
        """Where blocks (n,), packed, are held (n,); -1 where there is none."""
        places, slots = self._held
        if not len(places):
            return np.full(codes.shape, -1)
        at = np.searchsorted(places, codes).clip(max=len(places) - 1)
        return np.where(places[at] == codes, slots[at], -1)

    @property
    def places(self) -> np.ndarray:
        """Packed places (n,) of all blocks that hold anything, in order."""
        result: np.ndarray = self._held[0].copy()
        return result

    def cut(self, slots: np.ndarray) -> Cut:
        """The surface in the blocks at slots (n,)."""
        return cut(self._distance, self._weight, self._behind, self._known, self._above, self._codes, slots)

    def colors_at(self, found: Cut) -> np.ndarray:
        """Colours (v, 3) float32, 0 to 255, of the vertices of a cut."""
        result: np.ndarray = _mean_colors(self._color.reshape(-1, 4), found.near, found.far, found.share)
        return result

    def extract_mesh(self) -> Mesh:
        """The whole surface; empty when nothing was seen. A cell with a corner that too few views saw has none."""
        found = self.cut(self.slots(self.places))
        starts = np.repeat(found.first_vertex[:-1], np.diff(found.first_triangle))
        first, triangles = one_vertex_an_edge(found.names, found.triangles + starts[:, None])
        near, far, share = found.near[first], found.far[first], found.share[first]
        weight, seen = self._weight.reshape(-1), self._seen.reshape(-1)
        return Mesh(
            found.positions[first] * self.voxel,
            triangles,
            self.colors_at(found)[first] / 255.0,
            ((1 - share) * weight[near] + share * weight[far]) / FULL,
            np.where(share < 0.5, seen[near], seen[far]).astype(int),
        )


_CODE_STEPS = packed(CORNERS) - packed(np.zeros((1, 3), int))  # to the eight corners, in packed places


@compiled
def _add_view(
    weight: np.ndarray,
    distance: np.ndarray,
    seen: np.ndarray,
    color: np.ndarray,
    behind: np.ndarray,
    known: np.ndarray,
    slots: np.ndarray,
    origins: np.ndarray,
    offsets: np.ndarray,
    pixels: np.ndarray,
    planes: np.ndarray,
    weights: np.ndarray,
    colors: np.ndarray,
    tau: float,
    front: np.float32,
    colored: np.float32,
    sign: int | np.int32,
    least: int,
    first: int,
    end: int,
    any_left: np.ndarray,
) -> None:
    """Adds sign times what a view says to the sums of the blocks at slots (n,), first to end. The voxels of a block are
    at its origin (n, 3) + offsets (3, 512), in camera axes, and in its pixels (n, 512). Whether a block holds anything
    then goes into any_left (n,)."""
    # Loops of one kind each, and choices instead of min and max: so those over sums are done eight at a time.
    zero, one, sign = np.float32(0), np.float32(1), np.int32(sign)
    steps, per_tau, fall = np.float32(STEPS) / tau, one / tau, (front - one) / tau
    plane = np.empty((4, 512), np.float32)
    full, s = np.empty(512, np.float32), np.empty(512, np.float32)
    signed = np.empty(512, np.int32)
    for i in range(first, end):
        slot, pixel = slots[i], pixels[i]
        for v in range(512):
            for k in range(4):
                plane[k, v] = planes[pixel[v], k]
            full[v] = weights[pixel[v]]
        x, y, z = origins[i, 0], origins[i, 1], origins[i, 2]
        sum_w, sum_ws, count = weight[slot], distance[slot], seen[slot]
        for v in range(512):
            d = plane[3, v] - plane[0, v] * (x + offsets[0, v])
            d = d - plane[1, v] * (y + offsets[1, v]) - plane[2, v] * (z + offsets[2, v])
            s[v] = d
            trust = one + d * per_tau  # what lies behind a wall is ever less known
            trust = trust if trust > zero else zero
            d = d if d < tau else tau
            open_ = one + d * fall  # what is looked through, the farther from the wall
            trust = trust if trust < open_ else open_
            d = d if d > -tau else -tau
            w = np.int32(np.rint(full[v] * trust)) * sign
            signed[v] = w
            sum_w[v] += w
            sum_ws[v] += w * np.int32(np.rint(d * steps))
            count[v] += np.int16(sign) if w != 0 else np.int16(0)
        left = np.int16(0)
        for column in range(64):
            bits_b = bits_k = 0
            for z in range(8):
                v = 8 * column + z
                left |= count[v]
                bits_b |= (sum_ws[v] < 0) << z
                bits_k |= (sum_w[v] > 0 and count[v] >= least) << z
            behind[slot, column], known[slot, column] = bits_b, bits_k
        any_left[i] = left != 0
        for v in range(512):
            if signed[v] != 0 and abs(s[v]) < colored:
                for k in range(4):
                    color[slot, v, k] += signed[v] * colors[pixel[v], k]


@compiled
def _blocks_near(
    points: np.ndarray,
    planes: np.ndarray,
    some: np.ndarray,
    tau: float,
    across: float,
    rotation: np.ndarray,
    shift: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (5 n, 3) int32 of the blocks at the points of some pixels (n,), tau before and behind them along the ray,
    as far as the view speaks, and `across` to both sides of the surface, where marching cubes needs a neighbour; the
    lowest (3,) and the highest (3,)."""
    near = np.empty((5 * len(some), 3), np.int32)
    low, high = np.full(3, 2**31 - 1, np.int32), np.full(3, -(2**31), np.int32)
    step = np.empty(5, np.float32)
    for i in range(len(some)):
        pixel = some[i]
        x, y, z = points[0, pixel], points[1, pixel], points[2, pixel]
        reach = tau / np.sqrt(x * x + y * y + z * z)
        u, v, w = across * planes[pixel, 0], across * planes[pixel, 1], across * planes[pixel, 2]
        for a in range(3):
            place = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z
            aside = rotation[a, 0] * u + rotation[a, 1] * v + rotation[a, 2] * w
            step[0], step[1], step[2], step[3], step[4] = 0, place * reach, -place * reach, aside, -aside
            for k in range(5):
                block = np.int32(np.floor(place + step[k] - shift[a]))
                near[5 * i + k, a] = block
                low[a], high[a] = min(low[a], block), max(high[a], block)
    return near, low, high


@compiled
def _mark(marked: np.ndarray, places: np.ndarray, low: np.ndarray) -> None:
    """Sets marked (x, y, z) at places (n, 3), counted from `low`."""
    for i in range(len(places)):
        marked[places[i, 0] - low[0], places[i, 1] - low[1], places[i, 2] - low[2]] = True


@compiled
def _mean_colors(color: np.ndarray, near: np.ndarray, far: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Mean colours (n, 3) from weighted sums (m, 4), `share` of the way between rows `near` and `far` (n,) of them."""
    out = np.empty((len(share), 3), np.float32)
    for i in range(len(share)):
        one, two, t = near[i], far[i], share[i]
        weight = max((1 - t) * color[one, 3] + t * color[two, 3], 1e-9)
        for c in range(3):
            out[i, c] = ((1 - t) * color[one, c] + t * color[two, c]) / weight
    return out
