"""What lies on the wall: mucus, bubbles, stool; and the fine relief that breaks up highlights.

Maps are over (s, phi), rows along s, columns along phi and periodic. Slopes are the tangents of the angle by which the
surface of the film is tilted, along s and along phi. Lengths in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from lightdepth.ranges import SHARE, above, at_least, checked, ends_of
from lightdepth.tube.shape import smooth_noise


@dataclass(frozen=True)
@checked
class FilmConfig:
    """Ranges of what lies on the wall; by default nothing does."""

    mucus: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of the share of the wall under a film of mucus. A larger one covers more of it; (0, 0) makes
    none."""
    mucus_tint: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.4)
    """Ends of the range of the share of the wall's colour that mucus hides where it lies (see mucus). A larger one
    makes mucus more opaque."""
    bubbles: Annotated[tuple[int, int], ends_of(at_least(0, up_to=10_000))] = (0, 0)
    """Least and largest number of clusters of 3 to 29 bubbles each in a colon. More hide more of the wall."""
    bubble_radius: Annotated[tuple[float, float], ends_of(above(0, up_to=1000))] = (0.5, 1.8)
    """Ends of the range of the radius of the largest bubbles of a cluster, mm; the others go down to 0.4 of it. A
    larger one makes larger bubbles."""
    stool: Annotated[tuple[int, int], ends_of(at_least(0, up_to=10_000))] = (0, 0)
    """Least and largest number of specks of stool in a colon. More hide more of the wall."""
    stool_radius: Annotated[tuple[float, float], ends_of(above(0, up_to=1000))] = (0.4, 2.5)
    """Ends of the range of the radius of a speck of stool, mm. A larger one makes larger specks."""


@dataclass(frozen=True)
class Film:
    """wet (R, C) in [0, 1]; slopes (R', C', 2) of the bubbles or None."""

    wet: np.ndarray | None
    slopes: np.ndarray | None


def cover(
    albedo: np.ndarray, resolution: float, config: FilmConfig, rng: np.random.Generator
) -> tuple[np.ndarray, Film]:
    """The albedo (R, C, 3) under what lies on it, and the film; `resolution` mm per texel."""
    mucus_rng, bubble_rng, stool_rng = rng.spawn(3)
    albedo, wet = _mucus(albedo, resolution, config, mucus_rng)
    albedo = _stool(albedo, resolution, config, stool_rng)
    albedo, slopes = _bubbles(albedo, resolution, config, bubble_rng)
    return albedo, Film(wet, slopes)


def fine_relief(rng: np.random.Generator, size: int = 512) -> np.ndarray:
    """Slopes (size, size, 2) float32 of unit deviation, a tile that repeats."""
    height = gaussian_filter(rng.standard_normal((size, size)).astype(np.float32), 0.8, mode="wrap")
    slopes = np.stack([np.roll(height, -1, axis) - height for axis in (0, 1)], -1)
    result: np.ndarray = slopes / slopes.std()
    return result


def _mucus(
    albedo: np.ndarray, resolution: float, config: FilmConfig, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray | None]:
    share, tint = rng.uniform(*config.mucus), rng.uniform(*config.mucus_tint)
    if share <= 0:
        return albedo, None
    rows, columns = albedo.shape[:2]
    coarse = max(1, round(0.8 / resolution))
    shape = (max(8, rows // coarse), max(8, columns // coarse))
    size = 3.5 / (resolution * coarse)
    field = smooth_noise(shape, (size * 1.5, size), rng) + 0.5 * smooth_noise(shape, (size / 3, size / 3), rng)
    wet = 1 / (1 + np.exp(-(field - np.quantile(field, 1 - share)) / 0.08))
    wet = wet.astype(np.float32)
    over = tint * cv2.resize(wet, (columns, rows), interpolation=cv2.INTER_LINEAR)[..., None]
    colour = np.array([1.0, rng.uniform(0.78, 0.95), rng.uniform(0.5, 0.85)], np.float32)
    return albedo * (1 - over) + colour * over, wet


def _stool(albedo: np.ndarray, resolution: float, config: FilmConfig, rng: np.random.Generator) -> np.ndarray:
    for _ in range(int(rng.integers(config.stool[0], config.stool[1] + 1))):
        radius = np.exp(rng.uniform(*np.log(config.stool_radius))) / resolution
        red = rng.uniform(0.45, 0.9)
        colour = np.array([red, red * rng.uniform(0.6, 0.85), red * rng.uniform(0.15, 0.4)], np.float32)
        rows, columns, u, v = _window(albedo, radius * 1.6, rng)
        angle, reach = np.arctan2(v, u), np.hypot(u, v) / radius
        edge = 1 + sum(rng.normal(0, 0.25 / k) * np.cos(k * angle + rng.uniform(0, 6.3)) for k in (1, 2, 3, 5))
        cover = np.clip((edge - reach) * 4, 0, 1)[..., None].astype(np.float32)
        albedo[rows, columns] = albedo[rows, columns] * (1 - cover) + colour * cover
    return albedo


def _bubbles(
    albedo: np.ndarray, resolution: float, config: FilmConfig, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray | None]:
    """Domes of foam, in clusters: steep at the rim, which is pale, and flat in the middle."""
    clusters = int(rng.integers(config.bubbles[0], config.bubbles[1] + 1))
    if clusters == 0:
        return albedo, None
    slopes = np.zeros((*albedo.shape[:2], 2), np.float32)
    for _ in range(clusters):
        row, column = rng.uniform(0, albedo.shape[0]), rng.uniform(0, albedo.shape[1])
        size = rng.uniform(1.5, 5.0) / resolution
        for _ in range(int(rng.integers(3, 30))):
            radius = np.exp(rng.uniform(*np.log(config.bubble_radius))) / resolution * rng.uniform(0.4, 1)
            at = (row + size * rng.normal(), column + size * rng.normal())
            rows, columns, u, v = _window(albedo, radius * 1.1, rng, at)
            reach = np.hypot(u, v) / radius
            inside = (reach < 1)[..., None]
            steep = 1 / np.sqrt(np.clip(1 - 0.93 * np.minimum(reach, 1) ** 2, 0.05, 1)) / radius
            slopes[rows, columns] = np.where(inside, np.stack([u, v], -1) * steep[..., None], slopes[rows, columns])
            rim = (0.45 * np.exp(-(((reach - 0.9) / 0.09) ** 2)) + 0.08 * inside[..., 0])[..., None].astype(np.float32)
            dark = (0.3 * np.exp(-(((reach - 1.03) / 0.06) ** 2)))[..., None].astype(np.float32)
            wall = albedo[rows, columns] * (1 - dark)
            albedo[rows, columns] = wall * (1 - rim) + rim
    return albedo, slopes


def _window(
    albedo: np.ndarray, radius: float, rng: np.random.Generator, at: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices (n, 1) and (1, n) of a square around a place, columns wrapping, and its offsets (n, n) in texels."""
    rows, columns = albedo.shape[:2]
    row, column = (rng.uniform(0, rows), rng.uniform(0, columns)) if at is None else at
    half = min(int(np.ceil(radius)) + 1, rows // 2 - 1, columns // 2 - 1)
    middle = int(np.clip(row, half, rows - 1 - half))
    r, c = np.arange(middle - half, middle + half + 1), np.arange(int(column) - half, int(column) + half + 1)
    u, v = np.meshgrid(r - row, c - column, indexing="ij")
    return r[:, None], (c % columns)[None], u, v
