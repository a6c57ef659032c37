"""What keyframes of a map know of the wall: its places and normals, and how brightly each keyframe sees them.

A plane with unit normal n at distance c has 1/d = (-n/c) · r along unit rays r, whatever the lens. So the normal is
the least-squares solution g of 1/d = g · r over the pixels around, n = -g / |g|, and where the wall is no plane, at the
edge of a fold above all, the solution leaves something over and the pixel counts as rough. Differences of places across
such an edge look like steep wall: with them steep places seemed brighter than any light could make them.

What a wet wall mirrors is as white as the lamp, the wall is not: the brightest channel's light less the darkest's holds
nothing of it. How pale the wall is, the darkest channel's light over the brightest's, says how these two differ in what
goes from wall to wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lightdepth.camera import CameraModel

_HALF = 2  # pixels to either side that a normal is fitted to
_ROUGH, _BROKEN = 0.0025, 0.05  # deviation of distance from that plane, as a share: no place; no wall
_STEEP = 0.25  # least cosine of a place
_LEAST_COSINE = 0.15  # with which the area of a pixel's wall is reckoned
_FACING = 0.97  # largest cosine: from here the film shines
_WHITE, _DARK, _NEAR_WHITE = 0.85, 0.08, 4  # V that is used, and pixels around white ones that are not
_NOISE = 0.004  # deviation of V
_BLUR = (0.7, 1.06, 1.6)  # deviations [px] of the blur with which brightness is read
_SPOT = 0.008  # deviation of the spot of wall that is read, as a share of the typical distance
_COVERED = 0.98  # share of the spot that must be fit to be read
_COLOURED = 0.25  # least share that the difference of channels has of the brightest
_SAME = 0.015  # share by which distances may differ where two keyframes see one place
_TURNED = 0.15  # radians by which their normals may


@dataclass(frozen=True)
class Look:
    """A keyframe of a map with its image, and the surface as it sees it.

    image (H, W, 3) in [0, 1]; valid (H, W); distance (H, W) to the surface along the unit rays, map units, 0 for none.
    """

    camera: CameraModel
    cam_from_map: np.ndarray
    image: np.ndarray
    valid: np.ndarray
    distance: np.ndarray

    def wall(self) -> Wall:
        """The wall in each pixel, by planes through the pixels around it."""
        height, width = self.distance.shape
        y, x = np.mgrid[:height, :width] + 0.5
        rays, inside = self.camera.unproject(np.stack([x.ravel(), y.ravel()], 1))
        rays = rays.reshape(height, width, 3)
        known = (self.distance > 0) & self.valid & inside.reshape(height, width)
        near = np.where(known, 1 / np.where(known, self.distance, 1), 0)
        used = np.where(known[..., None], rays, 0)
        whole = _mean(known.astype(float)) > 1 - 1e-9
        products = _mean(np.einsum("hwi,hwj->hwij", used, used).reshape(height, width, 9)).reshape(height, width, 3, 3)
        right = _mean(used * near[..., None])
        products[~whole] = np.eye(3)
        plane = np.linalg.solve(products, right[..., None])[..., 0]
        left = np.sqrt(np.maximum(_mean(near**2) - (plane * right).sum(-1), 0)) * self.distance
        normals = -plane / np.maximum(np.linalg.norm(plane, axis=-1, keepdims=True), 1e-12)
        cosine = -(normals * rays).sum(-1)
        sides = np.gradient(rays, axis=1), np.gradient(rays, axis=0)
        angle = np.linalg.norm(np.cross(*sides), axis=-1)
        turn, shift = self.cam_from_map[:3, :3], self.cam_from_map[:3, 3]
        return Wall(
            (rays * self.distance[..., None] - shift) @ turn,
            normals @ turn,
            self.distance**2 * angle / np.maximum(cosine, _LEAST_COSINE),
            np.sqrt(angle),
            whole & (left < _BROKEN) & (cosine > 0),
            whole & (left < _ROUGH) & (cosine > _LEAST_COSINE),
        )

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands in the map, (3,)."""
        centre: np.ndarray = -self.cam_from_map[:3, :3].T @ self.cam_from_map[:3, 3]
        return centre


@dataclass(frozen=True)
class Wall:
    """The wall in each pixel of a look: places and unit normals (H, W, 3) in the map, areas (H, W), the pixels' own
    angles (H, W) in radians, where there is wall, and where it is even enough for its normal to be trusted."""

    places: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    angle: np.ndarray
    known: np.ndarray
    even: np.ndarray


@dataclass(frozen=True)
class Seen:
    """Places (n, 3) on the wall with unit normals (n, 3) and by how much looks differ in these (n,), radians; log light
    (i, n) that each of i looks receives from them, NaN where it does not see them well, and its deviation by noise; the
    darkest channel's light over the brightest's in the median."""

    places: np.ndarray
    normals: np.ndarray
    turned: np.ndarray
    log_light: np.ndarray
    deviation: np.ndarray
    pale: float


def typical_distance(looks: Sequence[Look]) -> float:
    """Median over all pixels, map units."""
    return float(np.median(np.concatenate([look.distance[look.distance > 0] for look in looks])))


def elements(walls: Sequence[Wall], cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, normals and areas of the wall in cells; a cell's area is that of the look that sees most of it."""
    points, normals, areas = (
        np.concatenate([getattr(wall, part)[wall.known] for wall in walls]) for part in ("places", "normals", "areas")
    )
    _, at = np.unique(np.floor(points / cell), axis=0, return_inverse=True)
    at, count = at.ravel(), int(at.max()) + 1
    ends = np.cumsum([0, *(int(wall.known.sum()) for wall in walls)])
    most = np.max([np.bincount(at[a:b], areas[a:b], count) for a, b in zip(ends, ends[1:], strict=False)], axis=0)
    total = np.bincount(at, areas, count)
    place, turned = (
        np.stack([np.bincount(at, areas * p[:, i], count) for i in range(3)], 1) for p in (points, normals)
    )
    length = np.linalg.norm(turned, axis=1)
    use = (length > 0.3 * total) & (total > 0)
    return place[use] / total[use, None], turned[use] / length[use, None], most[use]


def seen_places(
    looks: Sequence[Look], walls: Sequence[Wall], gamma: float, count: int, rng: np.random.Generator
) -> Seen:
    """Places drawn from all looks' even wall that two looks or more see well."""
    typical, each = typical_distance(looks), -(-count // len(looks))
    drawn = []
    for wall in walls:
        rows = np.flatnonzero(wall.even.ravel())
        drawn.append(wall.places.reshape(-1, 3)[rng.choice(rows, min(each, len(rows)), replace=False)])
    places = np.concatenate(drawn)
    found = [_read(look, wall, places, gamma, typical) for look, wall in zip(looks, walls, strict=True)]
    log_light, deviation, pale, weight = (np.stack([f[k] for f in found]) for k in range(4))
    each_normal = np.stack([f[4] for f in found])
    normals = (weight[..., None] * each_normal).sum(0)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    angles = np.arccos(np.clip((each_normal * normals).sum(-1), -1, 1))
    turned = np.sqrt((weight * angles**2).sum(0) / np.maximum(weight.sum(0), 1e-12))
    use = (np.isfinite(log_light).sum(0) >= 2) & (turned < _TURNED)
    told = np.isfinite(log_light) & use
    paleness = float(np.median(pale[told])) if told.any() else 0.0
    return Seen(places[use], normals[use], turned[use], log_light[:, use], deviation[:, use], paleness)


def _read(
    look: Look, wall: Wall, places: np.ndarray, gamma: float, typical: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Log light (n,) from places in the map, its deviation, how pale they are, how well their normals are known, and
    these (n, 3)."""
    towards = places - look.centre
    reach = np.linalg.norm(towards, axis=1)
    pixels, inside = look.camera.project(places @ look.cam_from_map[:3, :3].T + look.cam_from_map[:3, 3])
    maps = (pixels[None] - 0.5).astype(np.float32)

    def sampled(picture: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
        result: np.ndarray = cv2.remap(np.asarray(picture, np.float32), maps[..., 0], maps[..., 1], how)[0]
        return result

    v, least = look.image.max(-1), look.image.min(-1)
    white = cv2.dilate((v >= _WHITE).astype(np.uint8), np.ones((2 * _NEAR_WHITE + 1,) * 2, np.uint8)) > 0
    fit = (look.valid & ~white & (v > 0.6 * _DARK) & wall.even).astype(np.float32)
    light = v**gamma - least**gamma
    noise = (_NOISE * gamma) ** 2 * (v ** (2 * gamma - 2) + least ** (2 * gamma - 2))
    spot = np.clip(_SPOT * typical / (reach * np.maximum(sampled(wall.angle), 1e-6)), _BLUR[0], _BLUR[-1])
    read = []
    for blur in _BLUR:
        pictures = [_blurred(fit, blur)]
        pictures += [_blurred(fit * p, blur) / np.maximum(pictures[0], 1e-3) for p in (light, v**gamma, noise)]
        read.append([sampled(p) for p in pictures])
        read[-1][3] /= 4 * np.pi * blur**2  # what a blur leaves of the variance
    level = np.interp(np.log(spot), np.log(_BLUR), range(len(_BLUR)))
    below = np.minimum(level.astype(int), len(_BLUR) - 2)
    share, rows = level - below, np.arange(len(places))
    table = np.array(read)
    covered, light, brightest, variance = (
        table[below, k, rows] * (1 - share) + table[below + 1, k, rows] * share for k in range(4)
    )
    normals = sampled(wall.normals, cv2.INTER_NEAREST)
    cosine = -(normals * towards).sum(1) / reach
    use = inside & (np.abs(sampled(look.distance, cv2.INTER_NEAREST) / reach - 1) < _SAME)
    use &= (sampled(fit) > 0.99) & (covered > _COVERED) & (cosine > _STEEP) & (cosine < _FACING)
    use &= (brightest > _DARK**gamma) & (light > _COLOURED * brightest)
    safe = np.where(use, light, 1)
    log_light = np.where(use, np.log(safe), np.nan)
    pale = 1 - safe / np.where(use, brightest, 1)
    return log_light, np.sqrt(variance) / safe, pale, use * cosine**2 / reach**2, normals


def _mean(values: np.ndarray) -> np.ndarray:
    """Means over the pixels around, 0 outside the image."""
    side = 2 * _HALF + 1
    flat = np.ascontiguousarray(values, np.float64)
    channels = np.atleast_3d(flat)
    result = np.stack(
        [
            cv2.boxFilter(channels[..., k], cv2.CV_64F, (side, side), borderType=cv2.BORDER_CONSTANT)
            for k in range(channels.shape[2])
        ],
        -1,
    )
    return result.reshape(flat.shape)


def _blurred(picture: np.ndarray, blur: float) -> np.ndarray:
    result: np.ndarray = cv2.GaussianBlur(np.asarray(picture, np.float32), (0, 0), blur)
    return result
