"""What the wall looks like: its reflectance as a picture over (s, phi), with vessels, and the ripples of its wet film.

The reflectance of the brightest channel is `rho` in the mean over the picture; the others follow the hue of mucosa.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

HEIGHT, WIDTH = 1840, 960
"""Pixels of the picture along s and around."""
MOST = 0.97
"""No wall reflects more."""


@dataclass(frozen=True, eq=False)
class Skin:
    """Reflectance (HEIGHT, WIDTH, 3) and slopes (HEIGHT, WIDTH, 2) of the film, float32; columns wrap around.
    `roughness` is that of its highlights (GGX's alpha)."""

    reflectance: np.ndarray
    slopes: np.ndarray
    roughness: float

    def looked_up(self, picture: np.ndarray, places: np.ndarray) -> np.ndarray:
        """A picture's values (n, c) at places (n, 2), bilinear."""
        height, width = picture.shape[:2]
        y, x = np.clip(places[:, 0], 0, 1) * (height - 1), (places[:, 1] % 1.0) * width
        row, column = np.minimum(y.astype(np.int64), height - 2), x.astype(np.int64) % width
        fy, fx = (y - row)[:, None].astype(np.float32), (x - np.floor(x))[:, None].astype(np.float32)
        flat, beside = picture.reshape(height * width, -1), (column + 1) % width
        above, below = row * width, (row + 1) * width
        top = flat[above + column] * (1 - fx) + flat[above + beside] * fx
        bottom = flat[below + column] * (1 - fx) + flat[below + beside] * fx
        result: np.ndarray = top * (1 - fy) + bottom * fy
        return result


def _cloud(rng: np.random.Generator, size: float) -> np.ndarray:
    """Noise (HEIGHT, WIDTH) of deviation 1 with blots of `size` pixels, periodic around."""
    small = (max(4, round(WIDTH / size)), max(4, round(HEIGHT / size)))
    noise = np.pad(rng.normal(size=small[::-1]), ((0, 0), (2, 2)), mode="wrap").astype(np.float32)
    wide = cv2.resize(noise, (WIDTH + round(4 * WIDTH / small[0]), HEIGHT), interpolation=cv2.INTER_CUBIC)
    start = round(2 * WIDTH / small[0])
    found = wide[:, start : start + WIDTH]
    return np.asarray(found / found.std())


def _vessels(rng: np.random.Generator, trees: int) -> np.ndarray:
    """How much of a vessel lies at each pixel (HEIGHT, WIDTH), in [0, 1]: trees that fork, drawn as they walk."""
    drawn = np.zeros((HEIGHT, WIDTH), np.float32)
    for _ in range(trees):
        strength = rng.uniform(0.4, 1.0)
        branches = [(rng.uniform([0, 0], [HEIGHT, WIDTH]), rng.uniform(0, 2 * np.pi), rng.uniform(2.2, 4.5))]
        while branches:
            at, heading, width = branches.pop()
            bend, trail = rng.normal() * 0.02, [at]
            for _ in range(int(rng.uniform(14, 40))):
                bend = 0.8 * bend + 0.08 * rng.normal()
                heading += bend
                at = at + 8 * np.array([np.sin(heading), np.cos(heading)])
                trail.append(at)
            line = np.array(trail)[:, ::-1]
            for shift in (-WIDTH, 0, WIDTH):  # around the seam
                points = np.round(8 * (line + [shift, 0])).astype(np.int32)[:, None]
                layer_width = max(1, round(width))
                cv2.polylines(drawn, [points], False, strength, layer_width, cv2.LINE_AA, 3)
            if width > 1.3:
                fork = rng.uniform(0.35, 0.8)
                branches += [(at, heading + fork, 0.72 * width), (at, heading - rng.uniform(0.3, 0.8), 0.62 * width)]
    blurred: np.ndarray = cv2.GaussianBlur(drawn, (0, 0), 1.2)
    return blurred


def make_skin(rng: np.random.Generator, rho: float) -> Skin:
    """The skin of a colon whose brightest channel reflects `rho` in the mean."""
    hue = np.array([1.0, rng.uniform(0.30, 0.62), rng.uniform(0.22, 0.5)])
    hue[2] = min(hue[2], 0.98 * hue[1])
    mottled = 0.09 * _cloud(rng, 150) + 0.05 * _cloud(rng, 40) + 0.035 * _cloud(rng, 9)
    red = 0.10 * _cloud(rng, 90)  # patches of redder and paler mucosa
    vessels = rng.uniform(0.35, 0.75) * _vessels(rng, int(rng.integers(25, 60)))
    powers = np.array([0.35, 1.25, 1.1])
    log = mottled[..., None] - vessels[..., None] * powers + red[..., None] * np.array([0.25, -0.6, -0.5])
    picture = hue * np.exp(log)
    brightest, scale = picture[::4, ::4].max(-1), 1.0
    for _ in range(30):
        scale *= rho / np.minimum(scale * brightest, MOST).mean()
    picture = np.minimum(scale * picture, MOST)
    bumps = 0.5 * _cloud(rng, 14) + 0.5 * _cloud(rng, 6)
    slope = rng.uniform(0.03, 0.09)
    down, across = np.gradient(bumps, axis=0), np.gradient(bumps, axis=1)
    slopes = slope * np.stack([down, across], -1) / down.std()
    return Skin(picture.astype(np.float32), slopes.astype(np.float32), float(rng.uniform(0.16, 0.3)))
