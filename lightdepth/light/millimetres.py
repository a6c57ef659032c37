"""Millimetres per map unit, from the light: it sits some millimetres beside the lens, and that shows in the shading.

How a place on the wall is lit from two positions of the camera depends on the light's offset as a share of the
distance. In a map that is scaled wrongly the offset is the wrong share, and no albedo explains all views of the place.
Notation: s millimetres per map unit; X a place on the wall with unit normal n, in camera axes and map units; P the
light's position, mm, D its direction, l = (X - P/s) / |X - P/s|; E the light that X receives,

    E(s, rho, b) = exp(-mu (1 - D · l)) (n · -l) / |X - P/s|²  +  E_ind(rho, b)

with the light E_ind that comes by way of other wall, of reflectance rho, of which a share b counts where no look shows
it (lightdepth.light.enclosure). Over views i of places m, with L the light that comes back (lightdepth.light.looks),

    log L_im = log g_i + log a_m + log E_im(s, rho, b) + noise,

gain g_i and albedo a_m unknown. For each s, rho and b of a grid these are fitted robustly, from a fit by absolute
values: gains differ by much between frames, and a redescending loss alone settles on a part of them. What is left over,
as a function of s, is least at the right scale; where the offset is too small to be seen it is flat, and nothing is
said. Blocks of wall and looks are drawn anew, and the least cost found again over s, rho and b: that is the interval.

A light file's mu does not say which share of it is the lens's (vignetting, about the camera's axis) and does not move
with P. It is taken for the lamp's alone; what the scale would change by if half were the lens's is in the interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from lightdepth.errors import InputError
from lightdepth.light.enclosure import Enclosure, enclosure
from lightdepth.light.looks import Look, Seen, elements, seen_places, typical_distance
from lightdepth.photometry import PhotometricCalibration, irradiance

__all__ = ["Look", "Millimetres", "millimetres"]

_RANGE, _STEPS = (0.4, 2.5), 13  # of the scale about the one that is expected
_COARSE = ((0.0, 0.1, 0.3, 0.6), (0.5,))  # reflectances, and shares of the unseen wall
_FINE = ((0.0, 0.04, 0.08, 0.15, 0.25, 0.4, 0.55, 0.7), (0.0, 0.5, 1.0))
_FINE_STEPS = 9  # of the scale, over two steps of the coarse ones to either side
_CELL = 0.18  # side of the elements of wall that light each other, as a share of the typical distance
_PLACES = 2600
_FLOOR, _TILT = 0.01, 0.015  # deviation of log light, and of normals [rad]
_OUT = 2.5  # deviations at which a view counts for a quarter
_ABSOLUTE, _ROUNDS = 4, 5
_BLOCK = 0.5  # side of the blocks of wall that are drawn together, as a share of the typical distance
_DRAWN = 200
_INFLATED, _MODEL = 1.3, 0.03
"""Times the deviation over draws, and in quadrature the least one: what the model of the light lacks."""
_LENS = 0.5  # of the light's spread that may be the lens's
_WIDEST = 0.25  # deviation of the logarithm from which no figure is given
_NEAREST = 0.03  # least offset, as a share of the typical distance at the scale that was found
_ASIDE, _BENT = 0.25, 0.2  # tangent of the angle to where the images put the light; error of the response's exponent
_LEAST_VIEWS = 300


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
    aside: float = float("nan")
    """tangent of the angle, around the axis, between the light's place and where the images put it"""
    bent: float = float("nan")
    """share by which the response's exponent is too large, as the images have it"""

    @property
    def interval(self) -> tuple[float, float]:
        """In which nine of ten scales lie, mm per map unit."""
        reach = float(np.exp(1.645 * self.deviation))
        return self.mm_per_unit / reach, self.mm_per_unit * reach


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
    rng = np.random.default_rng(seed)
    walls, typical = [look.wall() for look in looks], typical_distance(looks)
    seen = seen_places(looks, walls, light.gamma, _PLACES, rng) if all(w.even.any() for w in walls) else None
    views = 0 if seen is None else int(np.isfinite(seen.log_light).sum())
    if seen is None or views < _LEAST_VIEWS:
        why = f"{views} views of places are even, coloured, and neither white, dark nor steep, of {_LEAST_VIEWS} needed"
        return Millimetres(float("nan"), float("inf"), float("nan"), views, why)
    around = enclosure(looks, walls, elements(walls, _CELL * typical), seen, typical, rng)
    shading = _Shading(np.stack([look.cam_from_map for look in looks]), seen, around, light)

    scales = near * np.geomspace(*_RANGE, _STEPS)
    coarse = shading.losses(scales, *_COARSE).sum((3, 4)).min((1, 2))
    at = int(coarse.argmin())
    fine = scales[at] * (scales[1] / scales[0]) ** np.linspace(-2, 2, _FINE_STEPS)
    losses = shading.losses(fine, *_FINE, blocks=_blocks(seen.places, _BLOCK * typical))
    costs = losses.sum((3, 4))
    draws = np.log(_drawn(losses, fine, rng))
    found = float(np.exp(np.median(draws)))
    step, row, column = (int(k) for k in np.unravel_index(costs.argmin(), costs.shape))
    reflectance, unseen = _FINE[0][row], _FINE[1][column]
    aside, bent = shading.doubts(found, reflectance, unseen)
    through = [
        _least(fine, replace(shading, lens=lens).losses(fine, (reflectance,), (unseen,)).sum((1, 2, 3, 4)))
        for lens in (0.0, _LENS)
    ]
    parts = _INFLATED * np.std(draws), _MODEL, 0.5 * np.log(through[1] / through[0])
    told = Millimetres(found, float(np.linalg.norm(parts)), reflectance, views, "", aside, bent)
    flat = at in (0, _STEPS - 1) or step in (0, _FINE_STEPS - 1) or told.deviation > _WIDEST
    return replace(told, refused=_doubt(told, flat, offset / ((near if flat else found) * typical)))


def _doubt(told: Millimetres, flat: bool, share: float) -> str:
    """Why no figure is given, of a light beside the lens by such a share of the distance; empty where nothing is."""
    if share < _NEAREST:
        return f"the light's offset is {share:.1%} of the distance, of {_NEAREST:.0%} needed"
    if abs(told.aside) > _ASIDE:
        angle = np.degrees(np.arctan(abs(told.aside)))
        return f"the light shines from elsewhere: the images put it {angle:.0f} degrees around the axis from its place"
    if abs(told.bent) > _BENT:
        return f"the response does not fit: the images' gamma is {1 / (1 + told.bent):.2f} times the light's"
    if told.reflectance >= _FINE[0][-1]:
        return f"a wall of reflectance {told.reflectance:g} or more, or another response: the images do not say which"
    if flat:
        return f"shading hardly changes with the scale: the light's offset is {share:.1%} of the distance"
    return ""


@dataclass(frozen=True)
class _Shading:
    """Poses (i, 4, 4) of looks, the places that they see, the wall around these, the light, and which share of its
    spread is the lens's."""

    poses: np.ndarray
    seen: Seen
    around: Enclosure
    light: PhotometricCalibration
    lens: float = 0.0

    def losses(
        self, scales: np.ndarray, rhos: Sequence[float], shares: Sequence[float], blocks: np.ndarray | None = None
    ) -> np.ndarray:
        """Geman-McClure's loss (scales, rhos, shares, looks, blocks) of what gains and albedos leave, per view, summed
        over the blocks (n,) of places; one block where none are given."""
        known, deviation = self._deviation()
        blocks = np.zeros(known.shape[1], int) if blocks is None else blocks
        total = np.zeros((len(scales), len(rhos), len(shares), len(known), int(blocks.max()) + 1))
        ways = {(j, k): self.around.gathered(r, b) for j, r in enumerate(rhos) for k, b in enumerate(shares) if r}
        for i, scale in enumerate(scales):
            direct, source = self._direct(float(scale))
            for j, rho in enumerate(rhos):
                for k in range(len(shares)):
                    if not rho and k:
                        total[i, j, k] = total[i, j, 0]
                        continue
                    received = direct + (ways[j, k] @ source.T).T if rho else direct
                    residual = _fitted(self._left(received, known), known, deviation)[0]
                    squared = (residual / _OUT) ** 2
                    loss = known * squared / (1 + squared)
                    for look, row in enumerate(loss):
                        total[i, j, k, look] = np.bincount(blocks, row, total.shape[4])
        return total

    def doubts(self, scale: float, rho: float, unseen: float) -> tuple[float, float]:
        """Where the images put the light around the axis (tangent of the angle from its place), and by what share they
        have the exponent of the response too large."""
        known, deviation = self._deviation()
        x, y, z = self.light.position_mm
        turned = replace(self, light=replace(self.light, position_mm=(x - 0.1 * y, y + 0.1 * x, z)))
        logs = []
        for shading in (self, turned):
            direct, source = shading._direct(scale)
            received = direct + (self.around.gathered(rho, unseen) @ source.T).T if rho else direct
            logs.append(np.log(np.maximum(received, 1e-12)))
        left = self._left(np.exp(logs[0]), known)
        _, (aside, bent) = _fitted(left, known, deviation, [(logs[1] - logs[0]) / 0.1, logs[0]])
        return float(aside), float(bent)

    def _deviation(self) -> tuple[np.ndarray, np.ndarray]:
        """Which views (i, n) are known, and their deviations: a floor, noise, and normals, which matter where steep."""
        known = np.isfinite(self.seen.log_light)
        at = np.einsum("ijk,nk->inj", self.poses[:, :3, :3], self.seen.places) + self.poses[:, None, :3, 3]
        turned = np.einsum("ijk,nk->inj", self.poses[:, :3, :3], self.seen.normals)
        cosine = np.clip(-(at * turned).sum(-1) / np.linalg.norm(at, axis=-1), 0.05, 1)
        steep = np.sqrt(1 - cosine**2) / cosine * np.maximum(self.seen.turned, _TILT)
        return known, np.sqrt(_FLOOR**2 + np.where(known, self.seen.deviation, 1) ** 2 + steep**2)

    def _direct(self, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Direct light on places (i, n) and on elements (i, m) at a scale."""
        wall = self.around
        onto = [_lit(self.seen.places, self.seen.normals, pose, self.light, scale, self.lens) for pose in self.poses]
        between = [_lit(wall.elements, wall.normals, pose, self.light, scale, self.lens) for pose in self.poses]
        return np.stack(onto), np.stack(between) * wall.lit

    def _left(self, received: np.ndarray, known: np.ndarray) -> np.ndarray:
        """log L - log E (i, n), 0 where unknown."""
        return np.where(known, np.where(known, self.seen.log_light, 0) - np.log(np.maximum(received, 1e-12)), 0)


def _fitted(
    left: np.ndarray, known: np.ndarray, deviation: np.ndarray, columns: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """What gains and albedos leave of (i, n), in deviations, and the factors of columns (i, n) fitted beside them.

    Albedos are eliminated, gains and factors solved for, by weights that are drawn anew from what is left.
    """
    weight = known / deviation**2
    use, beside, looks = weight, np.array(columns).reshape(-1, *left.shape), len(left)
    size = looks + len(beside)
    for n in range(_ABSOLUTE + _ROUNDS):
        total = np.maximum(use.sum(0), 1e-12)
        free = left - (use * left).sum(0) / total
        freed = beside - ((use * beside).sum(1) / total)[:, None]
        weighted = use * freed
        matrix = np.zeros((size, size))
        matrix[:looks, :looks] = np.diag(use.sum(1)) - use @ (use / total).T
        matrix[:looks, :looks] += np.trace(matrix) / looks / looks * 1e-3  # gains are known but for their mean
        matrix[looks:, :looks] = weighted.sum(2)
        matrix[:looks, looks:] = matrix[looks:, :looks].T
        matrix[looks:, looks:] = np.einsum("kin,lin->kl", weighted, freed)
        matrix += 1e-9 * np.trace(matrix) * np.eye(size)
        solved = np.linalg.solve(matrix, np.concatenate([(use * free).sum(1), (weighted * free).sum((1, 2))]))
        rest = left - solved[:looks, None] - np.tensordot(solved[looks:], beside, 1)
        residual = (rest - (use * rest).sum(0) / total) / deviation
        absolute = np.sqrt(weight) * known / np.maximum(np.abs(residual), 0.3)
        use = absolute if n < _ABSOLUTE - 1 else weight / (1 + (residual / _OUT) ** 2) ** 2
    return residual, solved[looks:]


def _drawn(losses: np.ndarray, scales: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The scale (draws,) of least loss over blocks of wall and looks that are drawn with replacement."""
    looks, blocks = losses.shape[3:]
    flat = losses.reshape(-1, looks, blocks)
    found = []
    for _ in range(_DRAWN):
        of_look = rng.multinomial(looks, np.full(looks, 1 / looks))
        of_block = rng.multinomial(blocks, np.full(blocks, 1 / blocks))
        costs = (of_look @ flat @ of_block).reshape(losses.shape[:3])
        found.append(_least(scales, costs.min((1, 2))))
    return np.array(found)


def _blocks(places: np.ndarray, side: float) -> np.ndarray:
    """The block (n,) of wall in which each place lies."""
    _, blocks = np.unique(np.floor(places / side), axis=0, return_inverse=True)
    result: np.ndarray = blocks.ravel()
    return result


def _lit(
    points: np.ndarray,
    normals: np.ndarray,
    pose: np.ndarray,
    light: PhotometricCalibration,
    scale: float,
    lens: float,
) -> np.ndarray:
    """Direct light (n,) on places in the map from a camera's pose, a share of whose spread is the lens's."""
    at = points @ pose[:3, :3].T + pose[:3, 3]
    reach = np.linalg.norm(at, axis=1)
    terms = light.terms(torch.float64)
    terms = terms._replace(position=terms.position / scale, mu=terms.mu * (1 - lens))
    turned, rays = (_batch(v.T)[:, :, None] for v in (normals @ pose[:3, :3].T, at / reach[:, None]))
    lit = irradiance(_batch(reach)[:, None, None], turned, rays, terms)
    result: np.ndarray = lit.numpy().ravel() * np.exp(-lens * light.mu * (1 - at[:, 2] / reach))
    return result


def _batch(array: np.ndarray) -> torch.Tensor:
    """A batch of one."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float64))[None]


def _least(scales: np.ndarray, costs: np.ndarray) -> float:
    """Where a parabola through the least cost and its neighbours, over log scale, is least."""
    at, step = int(costs.argmin()), float(np.log(scales[1] / scales[0]))
    shift = 0.0
    if 0 < at < len(scales) - 1:
        before, here, after = costs[at - 1 : at + 2]
        bend = before - 2 * here + after
        shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(scales[at] * np.exp(shift * step))
