"""A colon whose wall moves: it breathes as a whole, or waves run along it. Truth is then each frame's own.

Notation: s the arc length along the centreline [mm], t the time [s], c(s) the centreline. The wall at rest, c + v, is
at c + f(s, t) v, with f = 1 + a sin 2 pi (t / T - s / L): amplitude a, period T, wavelength L. The centreline rests,
and so does the path of the endoscope.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree

from lightdepth.ranges import Range, above, at_least, checked
from lightdepth.tube.shape import TubeShape, wall_normals


@dataclass(frozen=True)
@checked
class BreathingConfig:
    """How the wall of a colon moves."""

    amplitude: Annotated[float, Range(0, 0.3)] = 0.0
    """Largest change of the colon's radius, as a share of it, up to 0.3; 0 keeps the wall still; any other value needs
    --slam.kind tracked. A larger one moves the wall more."""
    period: Annotated[float, above(0)] = 4.0
    """Time from one breath (or wave) to the next, seconds; without an amplitude it does nothing. A longer one moves the
    wall more slowly."""
    wavelength_mm: Annotated[float, at_least(0)] = 0.0
    """Distance from one wave to the next along the colon (peristalsis), mm; 0 lets the whole colon widen and narrow at
    once. A larger one makes longer waves; without an amplitude there are none."""


class Breathing:
    """The motion of one colon's wall."""

    def __init__(self, shape: TubeShape, config: BreathingConfig):
        self._shape, self._config = shape, config
        self._rings = cKDTree(shape.centers)

    def factor(self, s: np.ndarray, time: float) -> np.ndarray:
        """f at places s (n,)."""
        config = self._config
        phase = time / config.period - (s / config.wavelength_mm if config.wavelength_mm else 0 * s)
        result: np.ndarray = 1 + config.amplitude * np.sin(2 * np.pi * phase)
        return result

    def shape_at(self, time: float) -> TubeShape:
        """The colon at a time."""
        rest = self._shape
        f = self.factor(np.arange(len(rest.centers)) * rest.step, time)
        vertices = rest.centers[:, None] + f[:, None, None] * (rest.vertices - rest.centers[:, None])
        return replace(rest, vertices=vertices, normals=wall_normals(vertices, rest.frames), radius=rest.radius * f)

    def at(self, rest: np.ndarray, time: float) -> np.ndarray:
        """Where points of the wall, (n, 3) at rest, are at a time."""
        center, f = self._around(rest, time)
        result: np.ndarray = center + f * (rest - center)
        return result

    def at_rest(self, points: np.ndarray, time: float) -> np.ndarray:
        """Where points of the wall, (n, 3) at a time, are at rest."""
        center, f = self._around(points, time)
        result: np.ndarray = center + (points - center) / f
        return result

    def _around(self, points: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        row = self._rings.query(points)[1]
        return self._shape.centers[row], self.factor(row * self._shape.step, time)[:, None]
