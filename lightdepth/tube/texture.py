"""What is painted on the wall: mucosa colour, mottling, vessels. Maps over (s, phi), periodic in phi."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from lightdepth.ranges import SHARE, Range, above, at_least, checked, ends_of
from lightdepth.tube.shape import smooth_noise


@dataclass(frozen=True)
@checked
class TextureConfig:
    """Ranges of the wall's appearance."""

    hue: Annotated[tuple[float, float], ends_of(Range(-1, 1))] = (-0.03, 0.06)
    """Ends of the range of the wall's hue, turns of the colour circle: 0 is red, 0.08 orange, below 0 a bluish red. A
    larger one is more orange."""
    saturation: Annotated[tuple[float, float], ends_of(SHARE)] = (0.3, 0.65)
    """Ends of the range of the wall's saturation, a share in [0, 1]. A larger one makes deeper colours."""
    mottling: Annotated[tuple[float, float], ends_of(SHARE)] = (0.02, 0.08)
    """Ends of the range of the standard deviation of saturation from place to place, saturation being a share in [0,
    1]. A larger one makes a more mottled wall."""
    value: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.12)
    """Ends of the range of how much darker the darkest spots of the wall are than the brightest, a share of brightness;
    depth from light assumes 0. A larger one breaks that assumption more."""
    vessels: Annotated[tuple[int, int], ends_of(at_least(0, up_to=10_000))] = (10, 45)
    """Least and largest number of stems of blood vessels, each of which branches. More give the wall more texture."""
    resolution: Annotated[float, at_least(0.02, up_to=100)] = 0.14
    """Size of a texel, the pixel of the wall's paint, mm. A larger one makes coarser paint in less time."""
    vessel_width: Annotated[tuple[float, float], ends_of(above(0, up_to=1000))] = (0.25, 0.7)
    """Ends of the range of the width of a vessel's stem, mm. A larger one makes thicker vessels."""
    vessel_value: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of how much darker vessels are than the wall, a share of brightness, on top of up to 25 % where
    scene.texture.value is above 0. A larger one makes darker vessels."""
    vessel_strength: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (1.0, 1.0)
    """Ends of the range of a factor on how strongly vessels are painted, in colour and darkness; 0 hides them. A larger
    one makes them plainer."""
    blotches: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of how much more saturated inflamed patches are than the wall, a share. A larger one makes
    redder patches; (0, 0) makes none."""
    speckle: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of the standard deviation of saturation, a share, between grains about 0.3 mm wide, as mucosal
    pits are. A larger one makes a grainier wall; (0, 0) makes none."""


def make_texture(length: float, circumference: float, config: TextureConfig, rng: np.random.Generator) -> np.ndarray:
    """Albedo (rows along s, columns along phi, 3) float32 RGB in [0, 1]."""
    vessel_rng, blotch_rng, speckle_rng = rng.spawn(3)
    rows, columns = round(length / config.resolution), round(circumference / config.resolution)
    coarse = (rows // 6, columns // 6)

    def noise(scale_mm: float, rng: np.random.Generator = rng) -> np.ndarray:
        sigma = scale_mm / config.resolution / 6
        field = smooth_noise(coarse, (sigma, sigma), rng).astype(np.float32)
        padded = np.concatenate([field, field[:, :1]], 1)
        return cv2.resize(padded, (columns, rows), interpolation=cv2.INTER_LINEAR)

    hue = rng.uniform(*config.hue) + 0.012 * noise(6)
    mottling = rng.uniform(*config.mottling)
    saturation = rng.uniform(*config.saturation) + mottling * (noise(8) + 0.7 * noise(1.5))
    fine = smooth_noise((rows // 2, columns // 2), (1.2, 1.2), rng).astype(np.float32)
    saturation += 0.5 * mottling * cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_LINEAR)
    darker = rng.uniform(*config.value)
    value = 1 - darker * np.clip(0.5 + 0.35 * noise(3), 0, 1)

    vessels = _vessels((rows, columns), int(rng.integers(config.vessels[0], config.vessels[1] + 1)), config, rng)
    vessels *= vessel_rng.uniform(*config.vessel_strength)
    saturation = saturation + 0.25 * vessels
    blotches = blotch_rng.uniform(*config.blotches)
    if blotches > 0:
        saturation += blotches * np.clip(noise(2.5, blotch_rng) + 0.5 * noise(0.9, blotch_rng) - 0.8, 0, 1.5)
    speckle = speckle_rng.uniform(*config.speckle)
    if speckle > 0:
        grain = gaussian_filter(speckle_rng.standard_normal((256, 256)).astype(np.float32), 0.9, mode="wrap")
        tiles = np.tile(grain / grain.std(), (rows // 256 + 1, columns // 256 + 1))
        saturation += speckle * tiles[:rows, :columns]
    saturation = np.clip(saturation, 0.02, 0.95)
    value = value * (1 - 0.25 * vessels * min(1.0, darker * 10))
    value = value * (1 - vessel_rng.uniform(*config.vessel_value) * vessels)
    hsv = np.stack([(hue % 1.0) * 360, saturation, value], -1).astype(np.float32)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def _vessels(shape: tuple[int, int], count: int, config: TextureConfig, rng: np.random.Generator) -> np.ndarray:
    """Branching lines that thin out, 0..1."""
    rows, columns = shape
    canvas = np.zeros(shape, np.float32)
    step = 0.8 / config.resolution
    stems = [
        (rng.uniform(0, rows), rng.uniform(0, columns), rng.uniform(0, 2 * np.pi), rng.uniform(*config.vessel_width), 0)
        for _ in range(count)
    ]
    while stems:
        y, x, angle, width, depth = stems.pop()
        line = [(x, y)]
        for _ in range(int(rng.integers(12, 45))):
            angle += rng.normal(0, 0.22)
            x, y = x + step * np.cos(angle), y + step * np.sin(angle)
            line.append((x, y))
            if depth < 3 and rng.random() < 0.06:
                stems.append((y, x, angle + rng.choice([-1, 1]) * rng.uniform(0.4, 1.0), width * 0.7, depth + 1))
        points = np.array(line)
        thickness = max(1, round(width / config.resolution))
        for shift in (-columns, 0, columns):
            shifted = np.rint((points + (shift, 0)) * 16).astype(np.int32)
            strength = float(0.4 + 0.6 * width / 0.7)
            cv2.polylines(canvas, [shifted], False, strength, thickness, cv2.LINE_AA, shift=4)
    result: np.ndarray = gaussian_filter(canvas, 1.0, mode=("nearest", "wrap")).clip(0, 1)
    return result
