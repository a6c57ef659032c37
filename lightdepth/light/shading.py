"""What shading leaves unexplained at a scale of the map: residuals of views of places, and the loss over them.

Notation and equations are those of lightdepth.light.millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from lightdepth.light.enclosure import Enclosure
from lightdepth.light.looks import Seen
from lightdepth.photometry import PhotometricCalibration, irradiance

_FLOOR, _TILT = 0.01, 0.015  # deviation of log light, and of normals [rad]
_OUT = 2.5  # deviations at which a view counts for a quarter
_ABSOLUTE, _ROUNDS = 4, 5
_PALER, _SOME, _PALEST = 3, 8, 0.9  # rounds in which the wall's own paleness is found, by each such place


@dataclass(frozen=True)
class Shading:
    """Poses (i, 4, 4) of looks, the places that they see, the wall around these, the light, and how much of its mu is
    the lens's."""

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
        direct, source = (np.stack(lit) for lit in zip(*(self._direct(float(s)) for s in scales), strict=True))
        middle = len(scales) // 2
        for j, rho in enumerate(rhos):
            pale = self._pale(rho, shares[len(shares) // 2], direct[middle], source[middle])
            for k, unseen in enumerate(shares):
                if not rho and k:
                    total[:, j, k] = total[:, j, 0]
                    continue
                received = direct + self._from_wall(rho, unseen, pale, source)
                for i in range(len(scales)):
                    residual = fitted(self._left(received[i], known), known, deviation)[0]
                    squared = (residual / _OUT) ** 2
                    loss = known * squared / (1 + squared)
                    for look, row in enumerate(loss):
                        total[i, j, k, look] = np.bincount(blocks, row, total.shape[4])
        return total

    def doubts(self, scale: float, rho: float, unseen: float) -> tuple[float, float]:
        """Where the images put the light around the axis (tangent of the angle from its place), and by what share they
        have the exponent of the response too large."""
        known, deviation = self._deviation()
        turned = replace(self, light=_turned(self.light))
        logs = []
        for shading in (self, turned):
            direct, source = shading._direct(scale)
            received = direct + self._from_wall(rho, unseen, self._pale(rho, unseen, direct, source), source[None])[0]
            logs.append(np.log(np.maximum(received, 1e-12)))
        left = self._left(np.exp(logs[0]), known)
        _, (aside, bent) = fitted(left, known, deviation, [(logs[1] - logs[0]) / 0.1, logs[0]])
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

    def _pale(self, rho: float, unseen: float, direct: np.ndarray, source: np.ndarray) -> float:
        """How pale the wall itself is under direct light on places (i, n) and elements (i, m): light from wall to wall
        makes it look less so."""
        known, pale = np.isfinite(self.seen.log_light)[:, ::_SOME], self.seen.pale
        if not rho:
            return pale

        def of_channel(reflectance: float) -> np.ndarray:
            light: np.ndarray = (direct[:, ::_SOME] + self.around.received(reflectance, unseen, source, _SOME))[known]
            return light

        bright = of_channel(rho)
        for _ in range(_PALER):
            pale = min(self.seen.pale * float(np.median(bright / of_channel(pale * rho))), _PALEST)
        return pale

    def _from_wall(self, rho: float, unseen: float, pale: float, source: np.ndarray) -> np.ndarray:
        """What the wall adds (k, i, n) to the light of places, the brightest channel's less the darkest's, in units of
        what direct light adds there, where direct light on the elements is (k, i, m)."""
        if not rho:
            return np.zeros((*source.shape[:2], len(self.seen.places)))
        flat = source.reshape(-1, source.shape[2])
        bright, dark = (self.around.received(reflectance, unseen, flat) for reflectance in (rho, pale * rho))
        result: np.ndarray = ((bright - pale * dark) / (1 - pale)).reshape(*source.shape[:2], -1)
        return result

    def _left(self, received: np.ndarray, known: np.ndarray) -> np.ndarray:
        """log L - log E (i, n), 0 where unknown."""
        return np.where(known, np.where(known, self.seen.log_light, 0) - np.log(np.maximum(received, 1e-12)), 0)


def fitted(
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


def _lit(
    points: np.ndarray,
    normals: np.ndarray,
    pose: np.ndarray,
    light: PhotometricCalibration,
    scale: float,
    lens: float,
) -> np.ndarray:
    """Direct light (n,) on places in the map from a camera's pose; `lens` is how much of its mu is the lens's."""
    at = points @ pose[:3, :3].T + pose[:3, 3]
    reach = np.linalg.norm(at, axis=1)
    terms = light.terms(torch.float64)
    terms = terms._replace(mu=terms.mu - lens)
    turned, rays = (_batch(v.T)[:, :, None] for v in (normals @ pose[:3, :3].T, at / reach[:, None]))
    places, shares = (
        ((light.position_mm,), (1.0,)) if light.lamps is None else (light.lamps.positions_mm, light.lamps.shares)
    )
    lit = np.zeros(len(points))
    for place, share in zip(places, shares, strict=True):
        own = terms._replace(position=torch.tensor(place, dtype=torch.float64).reshape(1, 3, 1, 1) / scale)
        lit += share * irradiance(_batch(reach)[:, None, None], turned, rays, own).numpy().ravel()
    result: np.ndarray = lit * np.exp(-lens * (1 - at[:, 2] / reach))
    return result


def _turned(light: PhotometricCalibration) -> PhotometricCalibration:
    """Turned around the camera's axis, so that each lamp moves by a tenth of its distance from it."""

    def moved(place: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = place
        return x - 0.1 * y, y + 0.1 * x, z

    lamps = light.lamps and replace(light.lamps, positions_mm=tuple(map(moved, light.lamps.positions_mm)))
    return replace(light, position_mm=moved(light.position_mm), lamps=lamps)


def _batch(array: np.ndarray) -> torch.Tensor:
    """A batch of one."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float64))[None]
