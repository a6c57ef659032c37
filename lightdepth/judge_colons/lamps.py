"""Lamps beside the lens, and the light file that somebody who measured them would write.

A lamp at P that points along D shines with intensity I max(D · l, 0)^k in the unit direction l. A lens takes light from
the side away, by cos^v of the angle from its axis (vignetting). The house's light file knows one source, which fades by
exp(-mu (1 - D · l)); what is written is the nearest such to all lamps and the lens together, on a wall 30 mm away, and
how much of it is the lens's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from lightdepth.photometry import MeasuredLamps, PhotometricCalibration

_MEASURED_AT_MM = 30.0


@dataclass(frozen=True)
class Lamp:
    """`position` [mm] and unit `direction` in camera axes; intensity on the axis; `power` k of its spread."""

    position: tuple[float, float, float]
    direction: tuple[float, float, float]
    intensity: float = 1.0
    power: float = 1.0

    def shone(self, towards: np.ndarray) -> np.ndarray:
        """Intensity (n,) in unit directions (n, 3), camera axes."""
        cosine = np.maximum(towards @ np.array(self.direction, towards.dtype), 0)
        return np.asarray(self.intensity * cosine**self.power if self.power else np.full_like(cosine, self.intensity))


def vignetting(rays: np.ndarray, power: float) -> np.ndarray:
    """Share (...) of light that the lens lets through along unit rays (..., 3)."""
    return np.asarray(np.clip(rays[..., 2], 0.02, 1) ** power)


def draw_lamps(rng: np.random.Generator) -> tuple[Lamp, ...]:
    """One lamp, or two at either side of the lens, 1.5 to 4.5 mm from its axis, of total intensity 1."""
    count, angle, power = int(rng.integers(1, 3)), rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 2.6)
    shares = rng.uniform(0.38, 0.62) if count == 2 else 1.0
    found = []
    for i, share in enumerate((shares, 1 - shares)[:count]):
        at = angle + i * (np.pi + rng.normal() * 0.3)
        far, tilt = rng.uniform(1.5, 4.5), rng.normal(size=2) * 0.05
        direction = np.array([*tilt, 1.0]) / np.linalg.norm([*tilt, 1.0])
        position = (float(far * np.cos(at)), float(far * np.sin(at)), float(rng.uniform(-1.0, 0.3)))
        found.append(
            Lamp(position, (float(direction[0]), float(direction[1]), float(direction[2])), float(share), float(power))
        )
    return tuple(found)


def measured_light(lamps: Sequence[Lamp], rays: np.ndarray, vignette: float, gamma: float) -> PhotometricCalibration:
    """The light file of lamps behind a lens with these unit rays (n, 3), its gain that of intensity 1."""
    shares = np.array([lamp.intensity for lamp in lamps])
    shares = shares / shares.sum()
    position = shares @ np.array([lamp.position for lamp in lamps])
    direction = shares @ np.array([lamp.direction for lamp in lamps])
    direction = direction / np.linalg.norm(direction)
    points = _MEASURED_AT_MM * rays
    lit = sum(
        (lamp.shone(_towards(points, lamp.position)) / np.square(points - lamp.position).sum(-1) for lamp in lamps),
        np.zeros(len(rays)),
    )
    away = 1 - _towards(points, position) @ direction
    bare = np.asarray(lit) * np.square(points - position).sum(-1)
    mu = _spread(vignetting(rays, vignette) * bare, away)
    return PhotometricCalibration(
        gamma=gamma,
        mu=round(mu, 4),
        position_mm=_rounded(position),
        direction=_rounded(direction),
        source="measured",
        lamps=MeasuredLamps(
            tuple(lamp.position for lamp in lamps),
            tuple(shares.tolist()),
            (0.0, 0.0, 0.0),
            round(mu - _spread(bare, away), 4),
        ),
    )


def _spread(seen: np.ndarray, away: np.ndarray) -> float:
    """The mu of brightness (n,), times the square of the distance, at directions that are `away` (n,) from the axis."""
    log = np.log(np.maximum(seen, 1e-6))
    weight = np.exp(log) / np.exp(log).sum()  # who measures sees what is bright

    def off(mu: float) -> float:
        left = log + mu * away
        return float((weight * np.square(left - weight @ left)).sum())

    return float(minimize_scalar(off, bounds=(0.0, 12.0), method="bounded").x)


def _rounded(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = np.round(vector, 4).tolist()
    return x, y, z


def _towards(points: np.ndarray, position: Sequence[float] | np.ndarray) -> np.ndarray:
    off = points - np.asarray(position)
    return np.asarray(off / np.linalg.norm(off, axis=-1, keepdims=True))
