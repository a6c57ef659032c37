"""Polyps: part of the wall raised to a dome, or to a head on a stalk that leans over.

Notation: a the radius of the head, u in [0, 1] from the top of a polyp to the edge of the patch of wall that it takes.
The wall stays one grid: a patch is pulled over the surface of revolution (rho(u), z(u)). Lengths in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

# (u, rho / a, z / a) from the top to the edge; the head overhangs its stalk.
_DOME = np.array(
    [(0, 0, 0.75), (0.25, 0.5, 0.68), (0.5, 0.92, 0.42), (0.65, 1.05, 0.2), (0.8, 1.25, 0.04), (1, 1.7, 0)]
)
_STALKED = np.array(
    [
        *[(0, 0, 2.7), (0.15, 0.6, 2.5), (0.3, 0.97, 1.95), (0.42, 0.95, 1.5), (0.52, 0.6, 1.1)],
        *[(0.6, 0.4, 0.9), (0.75, 0.42, 0.35), (0.88, 0.8, 0.06), (1, 1.5, 0)],
    ]
)


@dataclass(frozen=True)
class Polyp:
    """A polyp at (ring, spoke) of the grid; lean is the sideways shift per height, angle its direction."""

    ring: int
    spoke: int
    radius: float
    stalked: bool
    lean: float
    angle: float
    lobes: tuple[float, float]  # amplitude and phase of the head's irregularity

    @property
    def reach(self) -> float:
        """Radius of the patch that it takes [mm]."""
        return self.radius * float((_STALKED if self.stalked else _DOME)[-1, 1])


def draw_polyps(
    wall_radius: np.ndarray,
    step: float,
    count: tuple[int, int],
    radius: tuple[float, float],
    stalked: float,
    rng: np.random.Generator,
) -> tuple[Polyp, ...]:
    """Polyps on a wall of radius (R, C), small enough for the endoscope to pass."""
    rings, spokes = wall_radius.shape
    found = []
    for _ in range(int(rng.integers(count[0], count[1] + 1))):
        on_stalk = bool(rng.random() < stalked)
        ring, spoke = int(rng.integers(round(12 / step), max(round(12 / step) + 1, rings - 10))), rng.integers(spokes)
        room = float(wall_radius[ring, spoke])
        most = (0.14 if on_stalk else 0.35) * room
        size = min(float(np.exp(rng.uniform(*np.log(radius)))), most)
        lean, angle = rng.uniform(0, 0.5), rng.uniform(0, 2 * np.pi)
        lobes = (float(rng.uniform(0, 0.12)), float(rng.uniform(0, 2 * np.pi)))
        found.append(Polyp(ring, int(spoke), size, on_stalk, float(lean * on_stalk), float(angle), lobes))
    return tuple(found)


def raised(vertices: np.ndarray, normals: np.ndarray, polyps: tuple[Polyp, ...]) -> np.ndarray:
    """The grid (R, C, 3) with its polyps; normals (R, C, 3) point into the lumen."""
    vertices = vertices.copy()
    for polyp in polyps:
        centre, normal = vertices[polyp.ring, polyp.spoke], normals[polyp.ring, polyp.spoke]
        offset = vertices - centre
        height = offset @ normal
        flat = offset - height[..., None] * normal
        reach = np.linalg.norm(flat, axis=-1)
        u = reach / polyp.reach
        taken = (u < 1) & (np.abs(height) < 1.2 * polyp.reach)
        u, flat, reach, height = u[taken], flat[taken], reach[taken].clip(min=1e-9), height[taken]
        profile = PchipInterpolator(*_split(polyp))
        rho, z = (polyp.radius * profile(u)).T
        first = np.cross(normal, (0.0, 0.0, 1.0) if abs(normal[2]) < 0.9 else (1.0, 0.0, 0.0))
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        around = np.arctan2(flat @ second, flat @ first)
        amplitude, phase = polyp.lobes
        bumpy = 1 + amplitude * (1 - u) * np.cos(3 * around + phase) * np.sin(4 * np.pi * u + phase)
        sideways = polyp.lean * (np.cos(polyp.angle) * first + np.sin(polyp.angle) * second)
        blend = u**2 * (3 - 2 * u)  # the wall's own relief fades towards the top
        vertices[taken] = (
            centre
            + (bumpy * rho / reach)[:, None] * flat
            + (blend * height + z)[:, None] * normal
            + z[:, None] * sideways
        )
    return vertices


def tinted(
    albedo: np.ndarray,
    polyps: tuple[Polyp, ...],
    ring_radius: np.ndarray,
    spokes: int,
    step: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """The albedo (R, C, 3) with polyps of a colour of their own, mostly redder; ring_radius (rings,) of the wall."""
    rows, columns = albedo.shape[:2]
    for polyp in polyps:
        tint = np.array([1.0, *np.exp(rng.normal(-0.15, 0.2) + rng.normal(0, 0.04, 2))], np.float32)
        circumference = 2 * np.pi * ring_radius[polyp.ring]
        row = polyp.ring * (rows - 1) / (len(ring_radius) - 1)
        column = polyp.spoke * columns / spokes
        size = np.array([rows / (len(ring_radius) * step), columns / circumference]) * polyp.reach
        r = np.arange(max(0, int(row - size[0])), min(rows, int(row + size[0]) + 1))
        c = np.arange(int(column - size[1]), int(column + size[1]) + 1)
        reach = np.hypot(((r - row) / size[0])[:, None], ((c - column) / size[1])[None])
        weight = np.clip(3 * (0.75 - reach), 0, 1)[..., None].astype(np.float32)
        place = np.ix_(r, c % columns)
        albedo[place] = (albedo[place] * (1 - weight + weight * tint)).clip(0, 1)
    return albedo


def _split(polyp: Polyp) -> tuple[np.ndarray, np.ndarray]:
    table = _STALKED if polyp.stalked else _DOME
    return table[:, 0], table[:, 1:]
