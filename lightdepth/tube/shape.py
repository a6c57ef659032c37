"""The shape of a synthetic colon: a bent tube with haustral folds, as a grid mesh over (s, phi).

Notation: s arc length along the centreline [mm], phi angle around it; the mesh is a grid of rings (rows, along s) and
spokes (columns, along phi; the last column continues at the first). Lengths in millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.ndimage import gaussian_filter

from lightdepth.ranges import SHARE, Range, above, at_least, checked, ends_of
from lightdepth.tube.polyps import Polyp, draw_polyps, raised

CLOSING = 0.6
"""Mean radii over which a tube closes at its end."""


@dataclass(frozen=True)
@checked
class ShapeConfig:
    """What a colon may look like; pairs are the ends of a uniform range. Lengths in mm."""

    length: Annotated[float, above(0, up_to=10_000)] = 150.0
    """Length of the colon along its centreline, mm. A longer one holds longer paths and takes longer to make."""
    radius: Annotated[tuple[float, float], ends_of(above(0, up_to=1000))] = (15.0, 25.0)
    """Ends of the range of the mean radius, mm. A larger one makes a wider colon."""
    bend: Annotated[tuple[float, float], ends_of(Range(0, math.pi))] = (0.0, 0.9)
    """Ends of the range of how far the tube's direction may turn to either side along its length, radians. A larger one
    makes a more winding colon."""
    fold_spacing: Annotated[tuple[float, float], ends_of(above(0, up_to=10_000))] = (11.0, 24.0)
    """Ends of the range of the distance from one fold to the next, mm, drawn from fold to fold. A larger one makes
    fewer folds."""
    fold_depth: Annotated[tuple[float, float], ends_of(SHARE)] = (0.12, 0.38)
    """Ends of the range of how far a fold reaches into the lumen, as a share of the radius; each fold draws its own. A
    larger one hides more wall behind folds."""
    fold_width: Annotated[tuple[float, float], ends_of(above(0, up_to=1000))] = (1.6, 3.2)
    """Ends of the range of a fold's half width along the tube, mm; each fold draws its own. A larger one makes blunter
    folds."""
    bump: Annotated[tuple[float, float], ends_of(SHARE)] = (0.01, 0.05)
    """Ends of the range of the deviation of the wall from a smooth tube between the folds, as a share of the radius. A
    larger one makes a less even wall."""
    step: Annotated[float, at_least(0.05, up_to=100)] = 0.8
    """Distance between neighbouring points of the mesh that the wall is made of, mm. A larger one makes a coarser wall
    in less time."""
    crescent: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of how much the three parts of a fold differ, a share in [0, 1]: at 0 they are alike, at 1 each
    is anything from missing to a third deeper. A larger one makes less regular folds."""
    waviness: Annotated[tuple[float, float], ends_of(at_least(0, up_to=1000))] = (0.0, 0.0)
    """Ends of the range of how far a fold's line around the tube strays from a plane, mm. A larger one makes wavier
    folds."""
    taeniae: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of how far three bands along the tube (taeniae) pull the wall inwards, as a share of the
    radius. A larger one makes a more triangular lumen."""
    polyps: Annotated[tuple[int, int], ends_of(at_least(0, up_to=10_000))] = (0, 0)
    """Least and largest number of polyps in a colon; each colon draws a number between them. More polyps leave fewer
    images without one."""
    polyp_radius: Annotated[tuple[float, float], ends_of(above(0, up_to=1000))] = (1.5, 5.0)
    """Ends of the range of the radius of a polyp's head, mm. A larger one makes larger polyps, but never so large that
    the endoscope cannot pass."""
    stalked: Annotated[float, SHARE] = 0.35
    """Share of polyps, in [0, 1], that stand on a stalk; the others are flat domes. A larger one makes more stalks."""


@dataclass(frozen=True)
class TubeShape:
    """centers (R, 3) and frames (R, 3, 3: tangent, side, up) of the rings; vertices and unit normals (R, C, 3), normals
    pointing into the lumen; radius (R,) the mean radius of each ring, polyps aside; step the grid spacing."""

    centers: np.ndarray
    frames: np.ndarray
    vertices: np.ndarray
    normals: np.ndarray
    radius: np.ndarray
    step: float
    polyps: tuple[Polyp, ...] = ()

    @property
    def faces(self) -> np.ndarray:
        """Triangles (n, 3) over the flattened grid; two per cell, in order of the cells, wrapping around the tube."""
        rings, spokes = self.vertices.shape[:2]
        i, j = np.meshgrid(np.arange(rings - 1), np.arange(spokes), indexing="ij")
        a, b = i * spokes + j, i * spokes + (j + 1) % spokes
        c, d = a + spokes, b + spokes
        return np.stack([np.stack([a, b, c], -1), np.stack([b, d, c], -1)], 2).reshape(-1, 3)


def smooth_noise(shape: tuple[int, int], sigma: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Noise of unit deviation over (s, phi), smooth over sigma cells, periodic in phi."""
    noise = gaussian_filter(rng.standard_normal(shape), sigma, mode=("nearest", "wrap"))
    result: np.ndarray = noise / max(noise.std(), 1e-12)
    return result


def make_shape(config: ShapeConfig, rng: np.random.Generator) -> TubeShape:
    """A random colon. The far end is closed, so that every ray into the scene meets the wall.

    Shapes of before the later effects (from `crescent` on) stay as they were: those draw from generators of their own.
    """
    fold_rng, polyp_rng = rng.spawn(2)
    rings = round(config.length / config.step) + 1
    s = np.arange(rings) * config.step
    mean_radius = rng.uniform(*config.radius)
    spokes = 8 * round(2 * np.pi * mean_radius / config.step / 8)
    phi = np.arange(spokes) * 2 * np.pi / spokes

    centers, frames = _wandering(s, rng.uniform(*config.bend), rng)
    profile = 1 + 0.12 * np.interp(s, np.linspace(0, config.length, 6), rng.standard_normal(6))
    profile = gaussian_filter(profile, 8 / config.step)
    relative = profile[:, None] * np.ones(spokes)
    sigma = 5.0 / config.step
    relative += rng.uniform(*config.bump) * smooth_noise((rings, spokes), (sigma, sigma), rng)
    folds, taenia = _folds(s, phi, config, rng, fold_rng)
    relative -= folds
    relative -= fold_rng.uniform(*config.taeniae) * _bands(phi, taenia)

    radius = mean_radius * closed(relative.clip(min=0.3), CLOSING * mean_radius, s, config.length)
    polyps = draw_polyps(radius, config.step, config.polyps, config.polyp_radius, config.stalked, polyp_rng)
    return swept(radius, centers, frames, config.step, polyps)


def swept(
    radius: np.ndarray, centers: np.ndarray, frames: np.ndarray, step: float, polyps: tuple[Polyp, ...] = ()
) -> TubeShape:
    """The shape of a wall at radius (R, C) [mm] from a centreline: centers (R, 3), frames (R, 3, 3)."""
    side = _outwards(frames, radius.shape[1])
    vertices = centers[:, None] + radius[..., None] * side
    normals = _normals(vertices, side)
    if polyps:
        vertices = raised(vertices, normals, polyps)
        normals = _normals(vertices, side)
    return TubeShape(centers, frames, vertices, normals, radius.mean(1), step, polyps)


def wall_normals(vertices: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Unit normals (R, C, 3), into the lumen, of a wall around a centreline with frames (R, 3, 3)."""
    return _normals(vertices, _outwards(frames, vertices.shape[1]))


def _outwards(frames: np.ndarray, spokes: int) -> np.ndarray:
    phi = np.arange(spokes) * 2 * np.pi / spokes
    result: np.ndarray = np.cos(phi)[:, None] * frames[:, None, 1] + np.sin(phi)[:, None] * frames[:, None, 2]
    return result


def closed(relative: np.ndarray, end: float, s: np.ndarray, length: float) -> np.ndarray:
    """Radii (R, C) at s (R,) that close at `length`, or at the last ring, with a half ellipse, `end` mm long."""
    length = min(length, float(s[-1]))
    closing = np.sqrt(np.clip(1 - ((s - (length - end)) / end).clip(min=0) ** 2, 0, 1))
    result: np.ndarray = relative * np.maximum(closing, 1e-3)[:, None]
    return result


def _normals(vertices: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Unit normals (R, C, 3) of the grid, into the lumen; side (R, C, 3) points outwards."""
    along_s = np.gradient(vertices, axis=0)
    wrapped = np.concatenate([vertices[:, -1:], vertices, vertices[:, :1]], 1)
    along_phi = (wrapped[:, 2:] - wrapped[:, :-2]) / 2
    normals = np.cross(along_s, along_phi)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True).clip(min=1e-12)
    result: np.ndarray = normals * np.sign((normals * -side).sum(-1).mean())
    return result


def _wandering(s: np.ndarray, swing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A smooth curve by arc length with parallel-transported frames."""
    knots = np.linspace(s[0], s[-1], 5)
    angles = [gaussian_filter(np.interp(s, knots, swing * rng.uniform(-1, 1, 5)), len(s) / 12) for _ in range(2)]
    return centreline(s, angles[0], angles[1])


def centreline(s: np.ndarray, yaw: np.ndarray, pitch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The curve (R, 3) that leaves the origin along z and turns by yaw and pitch (R,), with frames (R, 3, 3)."""
    yaw, pitch = yaw - yaw[0], pitch - pitch[0]
    tangent = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], -1)
    step = s[1] - s[0]
    centers = np.concatenate([[np.zeros(3)], np.cumsum((tangent[1:] + tangent[:-1]) / 2 * step, 0)])
    side = np.empty_like(tangent)
    side[0] = np.cross((0.0, 1.0, 0.0), tangent[0])
    for i in range(1, len(s)):
        side[i] = side[i - 1] - (side[i - 1] @ tangent[i]) * tangent[i]
        side[i] /= np.linalg.norm(side[i])
    side[0] /= np.linalg.norm(side[0])
    return centers, np.stack([tangent, side, np.cross(tangent, side)], 1)


def _folds(
    s: np.ndarray, phi: np.ndarray, config: ShapeConfig, rng: np.random.Generator, own: np.random.Generator
) -> tuple[np.ndarray, float]:
    """How far the folds reach into the lumen, as a share of the radius (R, C), and the angle of a taenia's opposite.

    Each is a ring of narrow profile, tilted, and strong between the three taeniae, weak on them. `own` draws what
    makes it a crescent and its course wavy.
    """
    total = np.zeros((len(s), len(phi)))
    crescent, waviness = own.uniform(*config.crescent), own.uniform(*config.waviness)
    taenia = rng.uniform(0, 2 * np.pi)
    position = rng.uniform(2, 10)
    while position < s[-1]:
        tilt = rng.uniform(-2.5, 2.5) * np.cos(phi - rng.uniform(0, 2 * np.pi))
        lobes = 0.55 + 0.45 * np.cos(3 * (phi - taenia) + rng.normal(0, 0.3))
        one_sided = 1 + 0.35 * np.cos(phi - rng.uniform(0, 2 * np.pi))
        depth = rng.uniform(*config.fold_depth) * lobes * one_sided
        width = rng.uniform(*config.fold_width)
        if crescent > 0:
            depth *= 1 - crescent + crescent * _by_third(own.uniform(0, 1.3, 3), phi - taenia)
        waves = waviness * _waves(phi, own)
        offset = (s[:, None] - position - tilt - waves) / width
        total = np.maximum(total, depth * np.exp(-(np.abs(offset) ** 1.6)))
        position += rng.uniform(*config.fold_spacing)
    return total, taenia


def _by_third(weights: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """One of three weights around each of the angles 0, 120 and 240 degrees, blended between them."""
    near = np.exp(4 * np.cos(phi[:, None] - np.arange(3) * 2 * np.pi / 3))
    result: np.ndarray = near @ weights / near.sum(1)
    return result


def _waves(phi: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A periodic curve of unit deviation."""
    wave = sum(rng.normal(0, 1 / k) * np.cos(k * phi - rng.uniform(0, 2 * np.pi)) for k in (2, 3, 4, 6))
    return np.asarray(wave) / 0.86


def _bands(phi: np.ndarray, taenia: float) -> np.ndarray:
    """1 along the three taeniae, half-way between the strong parts of the folds, 0 apart from them. (C,)"""
    return np.exp(6 * (np.cos(3 * (phi - taenia) + np.pi) - 1) / 2)
