"""Distance on any lens -> what fusion takes: a small plane in every pixel, its weight, and where each direction looks.

Notation: d distance along the unit ray r through a pixel, P = d r, m the unit normal of the surface there, turned away
from the camera. All in camera axes. The plane of a pixel is m · X = m · P.

No image is resampled and no cube has seams: one table over directions (stereographic, so that it holds more than a
half space) says which pixel each direction falls into, half-pixel rim included. So every valid pixel enters the fusion
and none enters twice, whatever the lens. Between pixel centres the plane says where the surface is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import cv2
import numpy as np

from densify.fusion.second_core import halves
from lightdepth.camera import CameraModel, Pinhole
from lightdepth.compiled import compiled
from lightdepth.errors import InputError
from lightdepth.frame import brightest
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import SHARE, above, checked

FULL = 255
"""The weight of a pixel that nothing speaks against. Weights are whole numbers, so that sums of them are exact."""


@dataclass(frozen=True)
@checked
class RectifyConfig:
    """Which predicted pixels are handed to the fusion, how finely, and with what weight."""

    focal_px: Annotated[float, above(0, up_to=100_000)] = 256.0
    """Finest resolution that is fused, pixels per radian of view; blocks of pixels of finer images are averaged first.
    A larger one keeps more detail and takes longer."""
    field: Literal["whole", "pinhole"] = "whole"
    """Which pixels are fused: whole, all that the lens shows; pinhole, only what an undistorted image of the same size
    and focal length would hold, which crops the border of a wide lens."""
    max_slope: Annotated[float, above(0)] = 10.0
    """Largest change of log distance per radian of view with which a pixel is fused: 10 leaves out edges, and wall seen
    at less than 5.7 degrees to its surface. A larger one keeps more of the wall, less accurately."""
    dark: Annotated[float, SHARE] = 0.02
    """Brightness of a pixel's brightest channel, in [0, 1], below which its weight falls, from 1 down to the value of
    unlit at black. A higher one trusts dark pixels less."""
    bright: Annotated[float, SHARE] = 0.98
    """Brightness of a pixel's brightest channel, in [0, 1], above which its weight falls, from 1 down to the value of
    unlit at full brightness, because it may be clipped. A higher one trusts bright pixels more."""
    unlit: Annotated[float, SHARE] = 0.5
    """Weight, from 0 to 1, of a black or clipped pixel; a well-lit one has 1. A larger one trusts such pixels more;
    below 0.5 surfaces came out a little worse."""
    sigma: Annotated[float, above(0)] = 0.15
    """Uncertainty that the model states for a pixel, as standard deviation of log distance (0.15 is 15 %), at which the
    pixel's weight is halved. A larger one trusts uncertain pixels more; models that state none are not affected."""

    feather: Annotated[float, SHARE] = 0.15
    """Distance from the border of what the image shows, as a share of its smaller side, over which a pixel's weight
    rises from 0 to full, so that surfaces have no step where an image ends. A larger one makes softer seams and trusts
    less of the border; 0 makes none."""

    def __post_init__(self) -> None:
        if self.field not in ("whole", "pinhole"):
            raise InputError("field", f"{self.field!r} is not known", "expected whole or pinhole")


@dataclass(frozen=True)
class DirectionTable:
    """The pixel of every direction: cells (n, n) int32, the index of the pixel, or `outside`.

    A direction (x, y, z) of length l falls into the cell at column x s + n / 2, row y s + n / 2, s = scale / (l + z).
    """

    cells: np.ndarray
    scale: float
    outside: int

    def look_up(self, origins: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Pixels (n, m) int32 of the directions of points origins (n, 3) + offsets (3, m), float32."""
        pixels = np.empty((len(origins), offsets.shape[1]), np.int32)
        scale = np.float32(self.scale)
        halves(lambda first, end: _look_up(self.cells, scale, origins, offsets, first, end, pixels), len(origins))
        return pixels


@dataclass(frozen=True)
class SurfaceView:
    """What one image says of the surface: for each of n pixels a point (3, n), the plane m · X = b through it as
    (m, b) (n, 4), both float32, a weight (n,) and a colour (n, 3), both uint8; weight 0 where nothing is known.

    One more row at the end stands for all directions outside the image. The table tells the pixel of a direction.
    """

    points: np.ndarray
    planes: np.ndarray
    weights: np.ndarray
    colors: np.ndarray
    table: DirectionTable


@dataclass(frozen=True)
class _Lens:
    """A camera on the grid of merged pixels: unit rays (3, h, w); the angles to the next pixel along u (h, w - 1) and v
    (h - 1, w); the pixels (H, W) of the whole image that a pinhole would hold."""

    rays: np.ndarray
    gaps: tuple[np.ndarray, np.ndarray]
    in_pinhole: np.ndarray
    table: DirectionTable


def surface_view(
    prediction: DepthPrediction,
    image: np.ndarray,
    config: RectifyConfig,
    max_distance: float = np.inf,
    share: np.ndarray | None = None,
) -> SurfaceView:
    """What a (scaled) prediction and its image (H, W, 3) say of the surface; beyond max_distance nothing is known. Each
    pixel keeps a `share` (H, W) in [0, 1] of its weight, all of it if left out."""
    camera = prediction.camera
    merged = max(1, int(np.ceil(camera.focal_length / config.focal_px - 0.01)))
    lens = _lens(camera, merged)
    valid = prediction.valid & camera.rays()[1] & (prediction.distance > 0) & np.isfinite(prediction.distance)
    if config.field == "pinhole":
        valid &= lens.in_pinhole
    distance = np.where(valid, prediction.distance, 1).astype(np.float32, copy=False)
    light = brightest(image).astype(np.float32)
    color, sigma = image, prediction.uncertainty
    kept = feathered(valid, config.feather)
    if share is not None:
        kept = kept * share
    valid &= kept > 0
    points = distance * lens.rays if merged == 1 else None
    edge = np.zeros(valid.shape, bool)
    if merged > 1:
        points = np.stack([_merge(distance * axis, valid, merged) for axis in np.moveaxis(camera.rays()[0], -1, 0)])
        log = np.log(distance)
        edge = (
            _merge(log**2, valid, merged) - _merge(log, valid, merged) ** 2
            > (config.max_slope * merged / camera.focal_length / 2) ** 2
        )
        light, sigma = _merge(light, valid, merged), None if sigma is None else _merge(sigma, valid, merged)
        kept = _merge(kept, valid, merged)
        color = np.stack([_merge(image[..., c], valid, merged) for c in range(3)], -1)
        valid = _merge(valid, np.ones_like(valid), merged) > 0
        distance = np.where(valid, np.sqrt((points**2).sum(0)), np.float32(1))
    assert points is not None
    trust = light_weight(light, config) * kept
    if sigma is not None:
        trust /= 1 + (sigma / np.float32(config.sigma)) ** 2
    near, trust = valid & (distance <= max_distance), trust.astype(np.float32, copy=False)
    planes = np.zeros((valid.size + 1, 4), np.float32)
    weights, colors = np.zeros(len(planes), np.uint8), np.zeros((len(planes), 4), np.uint8)
    halves(
        lambda first, end: _planes(
            points, distance, near, valid, edge, trust, color, lens.rays, *lens.gaps, np.float32(config.max_slope),
            first, end, planes, weights, colors,
        ),
        len(valid),
    )  # fmt: skip
    colors[:, 3] = 1
    points = np.concatenate([points.reshape(3, -1), np.zeros((3, 1), np.float32)], 1)
    return SurfaceView(points, planes, weights, colors, lens.table)


def feathered(valid: np.ndarray, feather: float) -> np.ndarray:
    """Share (H, W) float32 of its weight that a pixel keeps beside the border of what is valid (H, W), which the border
    of the image is too: it rises steadily over `feather` of the smaller side. 0 where invalid."""
    if not feather:
        return valid.astype(np.float32)
    framed = np.pad(valid.astype(np.uint8), 1)
    reach = cv2.distanceTransform(framed, cv2.DIST_L2, 3)[1:-1, 1:-1]
    result: np.ndarray = np.minimum(reach / np.float32(feather * min(valid.shape)), 1)
    return result


def light_weight(value: np.ndarray, config: RectifyConfig) -> np.ndarray:
    """1 where the brightest channel (H, W) is well lit, falling to `unlit` towards black and towards saturation."""
    lit = np.clip(np.minimum(value / config.dark, (1 - value) / (1 - config.bright)), 0, 1)
    return config.unlit + (1 - config.unlit) * lit


@compiled
def _planes(
    points: np.ndarray,
    distance: np.ndarray,
    near: np.ndarray,
    valid: np.ndarray,
    edge: np.ndarray,
    trust: np.ndarray,
    color: np.ndarray,
    rays: np.ndarray,
    gaps_u: np.ndarray,
    gaps_v: np.ndarray,
    max_slope: np.float32,
    first: int,
    end: int,
    planes: np.ndarray,
    weights: np.ndarray,
    colors: np.ndarray,
) -> None:
    """Fills in the planes (n, 4), weights (n,) and colours (n, 4), all of them 0, of the rows of pixels first to end.

    The normal is P_u x P_v, away from the camera, with differences of P to both sides, or to one where the other is
    across an edge or unknown: exact on a plane. A pixel with no neighbour along an axis faces the camera. Beside an
    edge, on either side, and where a pixel is not `near` (h, w) nothing is known.
    """
    height, width = valid.shape
    zero, one, full = np.float32(0), np.float32(1), np.float32(FULL)
    steps = np.empty((2, 3), np.float32)
    for row in range(first, end):
        for column in range(width):
            i = row * width + column
            for c in range(3):
                colors[i, c] = np.uint8(min(max(np.float32(color[row, column, c]), zero), one) * full + np.float32(0.5))
            if edge[row, column] or not near[row, column]:
                continue
            steps[:] = 0
            across = False
            here = distance[row, column]
            for axis in range(2):
                for way in (-1, 1):
                    r, c = (row, column + way) if axis == 0 else (row + way, column)
                    if r < 0 or c < 0 or r >= height or c >= width or not valid[r, c]:
                        continue
                    gap = gaps_u[row, min(c, column)] if axis == 0 else gaps_v[min(r, row), column]
                    there = distance[r, c]
                    if abs(there - here) > max_slope * gap * min(here, there):
                        across = True
                    elif way > 0:
                        for k in range(3):
                            steps[axis, k] += points[k, r, c] - points[k, row, column]
                    else:
                        for k in range(3):
                            steps[axis, k] += points[k, row, column] - points[k, r, c]
            if across:
                continue
            x = steps[0, 1] * steps[1, 2] - steps[0, 2] * steps[1, 1]
            y = steps[0, 2] * steps[1, 0] - steps[0, 0] * steps[1, 2]
            z = steps[0, 0] * steps[1, 1] - steps[0, 1] * steps[1, 0]
            length = np.sqrt(x * x + y * y + z * z)
            ray_x, ray_y, ray_z = rays[0, row, column], rays[1, row, column], rays[2, row, column]
            if length > 0:
                x, y, z = x / length, y / length, z / length
            else:
                x, y, z = ray_x, ray_y, ray_z
            cosine = x * ray_x + y * ray_y + z * ray_z
            weights[i] = np.uint8(np.rint(min(max(full * cosine * trust[row, column], one), full)))
            planes[i, 0], planes[i, 1], planes[i, 2] = x, y, z
            planes[i, 3] = x * points[0, row, column] + y * points[1, row, column] + z * points[2, row, column]


def _halves(array: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """All but the last, and all but the first, of (..., h, w) along v (0) or u (1): views."""
    return (array[..., :-1, :], array[..., 1:, :]) if axis == 0 else (array[..., :-1], array[..., 1:])


def _merge(values: np.ndarray, valid: np.ndarray, size: int) -> np.ndarray:
    """Means (h, w) float32 over the valid pixels of blocks of size x size, 0 where there are none; the last may be
    smaller."""
    height, width = (-(-side // size) for side in valid.shape)
    means = np.empty((height, width), np.float32)
    single = np.ascontiguousarray(values, np.float32)
    halves(lambda first, end: _means(single, valid, size, first, end, means), height)
    return means


@compiled
def _means(values: np.ndarray, valid: np.ndarray, size: int, first: int, end: int, means: np.ndarray) -> None:
    """Rows first to end of the means of blocks. Each column of a block is summed, then the columns; of both, the first
    comes last, which is the order of np.add.reduceat up to blocks of eight."""
    height, width = valid.shape
    zero, one = np.float32(0), np.float32(1)
    sums, counts = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(first, end):
        top, bottom = row * size, min(row * size + size, height)
        sums[:], counts[:] = zero, zero
        for y in range(bottom - top):
            line = top + (y + 1) % (bottom - top)
            for x in range(width):  # choices instead of branches: so columns are summed eight at a time
                sums[x] += values[line, x] if valid[line, x] else zero
                counts[x] += one if valid[line, x] else zero
        for column in range(means.shape[1]):
            left, right = column * size, min(column * size + size, width)
            rest, count = zero, counts[left]
            for x in range(left + 1, right):
                rest += sums[x]
                count += counts[x]
            means[row, column] = (sums[left] + rest) / (count if count > one else one)


@compiled
def _look_up(
    cells: np.ndarray,
    scale: np.ndarray,
    origins: np.ndarray,
    offsets: np.ndarray,
    first: int,
    end: int,
    pixels: np.ndarray,
) -> None:
    # Choices instead of min and max, and the table in a loop of its own: so the first is done eight at a time.
    count, places, size = offsets.shape[1], cells.reshape(-1), np.int32(len(cells))
    half, last, zero = np.float32(size / 2), np.float32(size - 1), np.float32(0)
    for i in range(first, end):
        a, b, c = origins[i, 0], origins[i, 1], origins[i, 2]
        out = pixels[i]
        for v in range(count):
            x, y, z = a + offsets[0, v], b + offsets[1, v], c + offsets[2, v]
            length = np.sqrt(x * x + y * y + z * z)
            # A little aside, so that straight behind is far out instead of in the middle.
            aside = length * np.float32(1e-5)
            least = np.float32(0.1) * aside + np.float32(1e-30)
            s = scale / (length + z if length + z > least else least)
            column, row = (x + aside) * s + half, (y + aside) * s + half
            column = column if column > zero else zero
            column = column if column < last else last
            row = row if row > zero else zero
            row = row if row < last else last
            out[v] = np.int32(row) * size + np.int32(column)
        for v in range(count):
            out[v] = places[out[v]]


@lru_cache(maxsize=8)
def _lens(camera: CameraModel, merged: int) -> _Lens:
    height, width = -(-camera.height // merged), -(-camera.width // merged)
    u, v = np.meshgrid((np.arange(width) + 0.5) * merged, (np.arange(height) + 0.5) * merged)
    rays = np.moveaxis(camera.unproject(np.stack([u, v], -1))[0], -1, 0)
    gaps = [np.linalg.norm(two - one, axis=0).astype(np.float32) for one, two in (_halves(rays, a) for a in (1, 0))]
    rays = np.ascontiguousarray(rays, np.float32)
    return _Lens(rays, (gaps[0], gaps[1]), _in_pinhole(camera), _table(camera, merged))


def _in_pinhole(camera: CameraModel) -> np.ndarray:
    """Pixels (H, W) that an undistorted image of the same size, focal length and principal point would hold."""
    rays, valid = camera.rays()
    if isinstance(camera, Pinhole):
        return valid
    center = camera.project(np.array([0.0, 0.0, 1.0]))[0]
    front = valid & (rays[..., 2] > 1e-6)
    place = camera.focal_length * rays[..., :2] / np.where(front, rays[..., 2], 1)[..., None] + center
    result: np.ndarray = (
        front & (place >= 0).all(-1) & (place[..., 0] <= camera.width) & (place[..., 1] <= camera.height)
    )
    return result


def _table(camera: CameraModel, merged: int, largest: int = 2500) -> DirectionTable:
    """Cells of 0.6 of the least distance between neighbouring pixels, so that every pixel has one."""
    rays, valid = camera.rays()
    plane = np.moveaxis(rays[..., :2] / (1 + rays[..., 2:]), -1, 0)
    gaps = [
        np.linalg.norm(two - one, axis=0)[np.logical_and(*_halves(valid, a))]
        for a in (0, 1)
        for one, two in [_halves(plane, a)]
    ]
    gap = np.concatenate([*gaps, [1.0]])
    reach = float(np.abs(plane[:, valid]).max(initial=0) + np.sort(gap)[-2:].min())
    size = 4 * int(np.clip(2 * reach / (0.6 * merged * gap.min()), 16, largest) / 4 + 1)
    scale = size / (2 * reach)
    pixels, seen = _projected_cells(camera, size, scale)
    width, height = -(-camera.width // merged), -(-camera.height // merged)
    column, row = np.minimum(pixels[seen] // merged, (width - 1, height - 1)).astype(np.int32).T
    cells = np.full((size, size), height * width, np.int32)
    cells[seen] = row * width + column
    return DirectionTable(cells, scale, height * width)


def _projected_cells(camera: CameraModel, size: int, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (size, size, 2) of the middles of all cells, and whether the image holds them.

    Every fourth corner of a cell is projected, what lies between is interpolated (to far less than a pixel: lenses are
    smooth), and the neighbourhood of the rim is projected cell by cell.
    """

    def projected(column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p, q = (column - size / 2) / scale, (row - size / 2) / scale
        return camera.project(np.stack([p, q, (1 - p * p - q * q) / 2], -1))

    corners, known = projected(*np.meshgrid(np.arange(0, size + 1, 4.0), np.arange(0, size + 1, 4.0)))
    pixels = np.empty((size, size, 2), np.float32)
    for i, j in np.ndindex(4, 4):
        low, left = (i + 0.5) / 4, (j + 0.5) / 4
        upper = (1 - left) * corners[:-1, :-1] + left * corners[:-1, 1:]
        lower = (1 - left) * corners[1:, :-1] + left * corners[1:, 1:]
        pixels[i::4, j::4] = (1 - low) * upper + low * lower
    inner, outer = (
        cv2.erode(a.astype(np.uint8), np.ones((4, 4)), anchor=(1, 1))[:-1, :-1] > 0 for a in (known, ~known)
    )
    seen, rim = (np.kron(a, np.ones((4, 4), bool)) for a in (inner, ~inner & ~outer))
    row, column = np.nonzero(rim)
    pixels[rim], seen[rim] = projected(column + 0.5, row + 0.5)
    return pixels, seen
