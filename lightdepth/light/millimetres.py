"""Millimetres per map unit, from the light: it sits some millimetres beside the lens, and that shows in the shading.

How a place on the wall is lit from two positions of the camera depends on the light's offset as a share of the
distance. In a map that is scaled wrongly the offset is the wrong share, and no albedo explains all views of the place.
Notation: s millimetres per map unit; X a place on the wall with unit normal n, in camera axes and map units; P the
light's position, mm, D its direction, l = (X - P/s) / |X - P/s|; E the light that X receives,

    E(s, rho) = exp(-mu (1 - D · l)) (n · -l) / |X - P/s|²  +  rho K E

with form factors K from wall to wall (lightdepth.radiosity). Over views i of places m, with V the brightness,

    gamma log V_im = log g_i + log a_m + log E_im(s, rho) + noise,

gain g_i and albedo a_m unknown. For each s and rho of a grid these are fitted robustly, from a fit by absolute values:
gains differ by much between frames, and a redescending loss alone settles on a part of them. What is left over, as a
function of s, is least at the right scale; where the offset is too small to be seen it is flat, and nothing is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.photometry import PhotometricCalibration, irradiance
from lightdepth.radiosity import form_factors

_RHO = (0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6)
_RANGE, _STEPS = (0.4, 2.5), 13  # of the scale about the one that is expected
_CELL = 0.13  # side of the elements of wall that light each other, as a share of the typical distance
_PLACES = 1500
_WHITE, _DARK, _NEAR_WHITE = 0.85, 0.06, 4  # V that is used, and pixels around white ones that are not
_SLANT = 0.25  # least cosine
_FLOOR, _NOISE = 0.01, 0.005  # deviation of log light, and of V
_OUT = 2.5  # deviations at which a view counts for a quarter
_ABSOLUTE, _ROUNDS = 15, 8
_BLOCK = 0.5  # side of the blocks of wall that are drawn together, as a share of the typical distance
_DRAWN = 24
_INFLATED = 2.0
"""Times the deviation over draws that the error is: neighbouring blocks share what the model of the light lacks."""
_SHALLOW = 1.05  # times its least cost that the cost rises at both ends, or the light says nothing
_LEAST_VIEWS = 300


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

    def wall(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Places (H, W, 3) and unit normals (H, W, 3) towards the camera in camera axes, the area (H, W) of the wall
        that a pixel shows, and where these are known (H, W)."""
        height, width = self.distance.shape
        y, x = np.mgrid[:height, :width] + 0.5
        rays, inside = self.camera.unproject(np.stack([x.ravel(), y.ravel()], 1))
        places = rays.reshape(height, width, 3) * self.distance[..., None]
        along = [np.full_like(places, np.nan) for _ in range(2)]
        along[0][:, 2:-2], along[1][2:-2] = places[:, 4:] - places[:, :-4], places[4:] - places[:-4]
        across = np.cross(*along)
        size = np.linalg.norm(across, axis=-1)
        known = (self.distance > 0) & self.valid & inside.reshape(height, width) & np.isfinite(size) & (size > 0)
        normals = across / np.where(known, size, 1)[..., None]
        normals *= -np.sign((normals * places).sum(-1, keepdims=True))
        return places, normals, np.where(known, size / 16, 0), known


@dataclass(frozen=True)
class Millimetres:
    """Millimetres per map unit that the light tells, or why it tells nothing."""

    mm_per_unit: float
    deviation: float
    """of its logarithm: .05 is 5 %"""
    reflectance: float
    """the wall's, with which the views agree best"""
    views: int
    """number of views of places that were compared"""
    refused: str = ""
    """why no figure is given; empty where one is"""


def millimetres(looks: Sequence[Look], light: PhotometricCalibration, near: float = 1.0, seed: int = 0) -> Millimetres:
    """The scale of a map from the light's offset. It is looked for from .4 to 2.5 times `near`, mm per map unit.

    Raises InputError where fewer than three looks are given.
    """
    if len(looks) < 3:
        raise InputError(
            "the looks", f"{len(looks)} of them", "expected at least 3: places have to be seen from several"
        )
    offset = float(np.hypot(*light.position_mm[:2]))
    if light.assumed or offset == 0:
        why = "nobody gave the light" if light.assumed else "the light is said to sit in the camera"
        return Millimetres(float("nan"), float("inf"), float("nan"), 0, f"{why}: its position is needed")
    shading = _Shading.of(looks, np.random.default_rng(seed))
    if shading.known.sum() < _LEAST_VIEWS:
        why = (
            f"{int(shading.known.sum())} views of places are neither white, dark nor slanted, of {_LEAST_VIEWS} needed"
        )
        return Millimetres(float("nan"), float("inf"), float("nan"), int(shading.known.sum()), why)
    scales = near * np.geomspace(*_RANGE, _STEPS)
    costs = shading.costs(scales, _RHO, light)
    best = costs.min(1)
    at, rho = (int(k) for k in np.unravel_index(costs.argmin(), costs.shape))
    fine = scales[at] * np.exp(np.linspace(-1, 1, 9) * np.log(scales[1] / scales[0]))
    rhos = np.linspace(_RHO[max(0, rho - 1)], _RHO[min(len(_RHO) - 1, rho + 1)], 7)
    closer = shading.costs(fine, rhos, light)
    reflectance = float(rhos[closer.min(0).argmin()])
    found = _least(fine, closer.min(1))
    draws = [
        _least(fine, shading.drawn(np.random.default_rng((seed, k))).costs(fine, (reflectance,), light).min(1))
        for k in range(_DRAWN)
    ]
    deviation = float(_INFLATED * np.std(np.log(draws)))
    told = Millimetres(found, deviation, reflectance, int(shading.known.sum()))
    rise = min(best[0], best[-1]) / closer.min()
    if at in (0, _STEPS - 1) or rise < _SHALLOW:
        typical = float(np.median(np.concatenate([look.distance[look.distance > 0] for look in looks])))
        share = offset / (near * typical)
        return replace(
            told, refused=f"shading hardly changes with the scale: the light's offset is {share:.1%} of the distance"
        )
    return told


@dataclass(frozen=True)
class _Shading:
    """Places on the wall (n, 3) with normals, their log V (i, n) in each look and where it is known; elements of wall
    (m, 3) with normals and areas; poses (i, 4, 4); form factors from elements to elements and to places."""

    poses: np.ndarray
    places: np.ndarray
    normals: np.ndarray
    log_v: np.ndarray
    known: np.ndarray
    blocks: np.ndarray
    elements: np.ndarray
    element_normals: np.ndarray
    between: np.ndarray
    onto: np.ndarray

    @classmethod
    def of(cls, looks: Sequence[Look], rng: np.random.Generator) -> _Shading:
        typical = float(np.median(np.concatenate([look.distance[look.distance > 0] for look in looks])))
        walls = [look.wall() for look in looks]
        in_map = [_to_map(look, *wall) for look, wall in zip(looks, walls, strict=True)]
        elements, element_normals, areas = _elements(in_map, _CELL * typical)
        each = -(-_PLACES // len(looks))
        chosen = [rng.choice(len(points), min(each, len(points)), replace=False) for points, _, _ in in_map]
        places = np.concatenate([points[rows] for (points, _, _), rows in zip(in_map, chosen, strict=True)])
        normals = np.concatenate([n[rows] for (_, n, _), rows in zip(in_map, chosen, strict=True)])
        log_v = np.stack([_seen(look, places, normals) for look in looks])
        use = np.isfinite(log_v).sum(0) >= 2
        places, normals, log_v = places[use], normals[use], log_v[:, use]
        _, blocks = np.unique(np.floor(places / (_BLOCK * typical)), axis=0, return_inverse=True)
        # Places have no area: they receive, and light nothing.
        wall = [np.concatenate(both) for both in ((elements, places), (element_normals, normals))]
        given = np.concatenate([areas, np.zeros(len(places))])
        shares = form_factors(_batch(wall[0]), _batch(wall[1]), _batch(given))[0].numpy()
        between, onto = shares[: len(elements), : len(elements)], shares[len(elements) :, : len(elements)]
        poses = np.stack([look.cam_from_map for look in looks])
        known = np.isfinite(log_v)
        blocks = blocks.ravel()
        return cls(poses, places, normals, log_v, known, blocks, elements, element_normals, between, onto)

    def drawn(self, rng: np.random.Generator) -> _Shading:
        """The same from blocks of wall and looks that are drawn with replacement."""
        blocks = rng.integers(self.blocks.max() + 1, size=self.blocks.max() + 1)
        rows = np.concatenate([np.flatnonzero(self.blocks == b) for b in blocks])
        looks = rng.integers(len(self.poses), size=len(self.poses))
        log_v = self.log_v[looks][:, rows]
        parts = {"places": self.places[rows], "normals": self.normals[rows], "onto": self.onto[rows]}
        return replace(self, poses=self.poses[looks], log_v=log_v, known=np.isfinite(log_v), **parts)

    def costs(
        self, scales: Sequence[float] | np.ndarray, rhos: Sequence[float] | np.ndarray, light: PhotometricCalibration
    ) -> np.ndarray:
        """What is left over (scales, rhos) of gamma log V - log E once gains and albedos are fitted, in [0, 1]."""
        v = np.exp(np.where(self.known, self.log_v, 0.0))
        deviation = np.sqrt(_FLOOR**2 + (light.gamma * _NOISE / v) ** 2)
        weight = self.known / deviation**2
        solved = [np.linalg.inv(np.eye(len(self.elements)) - rho * self.between) if rho else None for rho in rhos]
        costs = np.zeros((len(scales), len(rhos)))
        for i, scale in enumerate(scales):
            lit = [
                (
                    _lit(self.places, self.normals, pose, light, scale),
                    _lit(self.elements, self.element_normals, pose, light, scale),
                )
                for pose in self.poses
            ]
            direct, source = np.stack([a for a, _ in lit]), np.stack([b for _, b in lit], 1)
            for j, (rho, inverse) in enumerate(zip(rhos, solved, strict=True)):
                received = direct if inverse is None else direct + rho * (self.onto @ (inverse @ source)).T
                left = light.gamma * np.where(self.known, self.log_v, 0.0) - np.log(np.maximum(received, 1e-12))
                costs[i, j] = _left_over(left, self.known, deviation, weight)
        return costs


def _left_over(left: np.ndarray, known: np.ndarray, deviation: np.ndarray, weight: np.ndarray) -> float:
    """Mean of Geman-McClure's loss of what gains and albedos leave."""
    gain, use = np.zeros(len(left)), weight
    residual = left
    for n in range(_ABSOLUTE + _ROUNDS):
        level = (use * (left - gain[:, None])).sum(0) / np.maximum(use.sum(0), 1e-12)
        gain = (use * (left - level)).sum(1) / np.maximum(use.sum(1), 1e-12)
        gain -= gain.mean()
        residual = (left - level - gain[:, None]) / deviation
        absolute = np.sqrt(weight) * known / np.maximum(np.abs(residual), 0.3)
        use = absolute if n < _ABSOLUTE - 1 else weight / (1 + (residual / _OUT) ** 2) ** 2
    squared = (residual[known] / _OUT) ** 2
    return float(np.mean(squared / (1 + squared)))


def _lit(
    points: np.ndarray, normals: np.ndarray, pose: np.ndarray, light: PhotometricCalibration, scale: float
) -> np.ndarray:
    """Direct light (n,) on places in the map from a camera's pose."""
    at = points @ pose[:3, :3].T + pose[:3, 3]
    reach = np.linalg.norm(at, axis=1)
    terms = light.terms(torch.float64)
    turned, rays = (_batch(v.T)[:, :, None] for v in (normals @ pose[:3, :3].T, at / reach[:, None]))
    lit = irradiance(_batch(reach)[:, None, None], turned, rays, terms._replace(position=terms.position / scale))
    result: np.ndarray = lit.numpy().ravel()
    return result


def _batch(array: np.ndarray) -> torch.Tensor:
    """A batch of one."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float64))[None]


def _to_map(
    look: Look, places: np.ndarray, normals: np.ndarray, areas: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a look knows of the wall, in the map: places (n, 3), normals (n, 3) and areas (n,)."""
    back = np.linalg.inv(look.cam_from_map)
    return places[known] @ back[:3, :3].T + back[:3, 3], normals[known] @ back[:3, :3].T, areas[known]


def _elements(
    walls: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, normals and areas of the wall in cells; a cell's area is that of the look that sees most of it."""
    points, normals, areas = (np.concatenate(part) for part in zip(*walls, strict=True))
    _, at = np.unique(np.floor(points / cell), axis=0, return_inverse=True)
    at, count = at.ravel(), int(at.max()) + 1
    ends = np.cumsum([0, *(len(a) for _, _, a in walls)])
    most = np.max([np.bincount(at[a:b], areas[a:b], count) for a, b in zip(ends, ends[1:], strict=False)], axis=0)
    total = np.bincount(at, areas, count)
    place, turned = (
        np.stack([np.bincount(at, areas * p[:, i], count) for i in range(3)], 1) for p in (points, normals)
    )
    length = np.linalg.norm(turned, axis=1)
    use = (length > 0.3 * total) & (total > 0)
    return place[use] / total[use, None], turned[use] / length[use, None], most[use]


def _seen(look: Look, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """log V (n,) of places in the map; NaN where a look does not see them, sees them slanted, white or dark."""
    at = places @ look.cam_from_map[:3, :3].T + look.cam_from_map[:3, 3]
    reach = np.linalg.norm(at, axis=1)
    pixels, inside = look.camera.project(at)
    maps = (pixels[None] - 0.5).astype(np.float32)
    v = look.image.max(-1).astype(np.float32)
    near_white = cv2.dilate((v >= _WHITE).astype(np.uint8), np.ones((2 * _NEAR_WHITE + 1,) * 2, np.uint8)) > 0
    fit = (look.valid & ~near_white & (v > _DARK)).astype(np.float32)

    def sampled(picture: np.ndarray, how: int) -> np.ndarray:
        result: np.ndarray = cv2.remap(picture, maps[..., 0], maps[..., 1], how)[0]
        return result

    ratio = sampled(look.distance.astype(np.float32), cv2.INTER_NEAREST) / reach
    bright = sampled(cv2.GaussianBlur(v, (0, 0), 0.7), cv2.INTER_LINEAR)
    cosine = -(at * (normals @ look.cam_from_map[:3, :3].T)).sum(1) / reach
    use = inside & (np.abs(ratio - 1) < 0.02) & (sampled(fit, cv2.INTER_LINEAR) > 0.99) & (cosine > _SLANT)
    result: np.ndarray = np.log(np.where(use & (bright > 0), bright, np.nan))
    return result


def _least(scales: np.ndarray, costs: np.ndarray) -> float:
    """Where a parabola through the least cost and its neighbours, over log scale, is least."""
    at, step = int(costs.argmin()), float(np.log(scales[1] / scales[0]))
    shift = 0.0
    if 0 < at < len(scales) - 1:
        before, here, after = costs[at - 1 : at + 2]
        bend = before - 2 * here + after
        shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(scales[at] * np.exp(shift * step))
