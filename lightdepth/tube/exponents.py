"""How brightness depends on geometry in one image: what a synthetic colon must have in common with real frames.

Notation: V = max(R, G, B), d distance along the ray, cos between ray and normal, psi the ray's angle from the axis.

    log V = b0 + b1 log d + b2 log cos - b3 (1 - cos psi)

For a Lambertian wall, light at the camera and a pure response gamma: b1 = -2 / gamma, b2 = 1 / gamma, b3 = mu / gamma.
Light between the walls, rougher walls, stray light in the lens and tone curves all weaken them. `python -m
lightdepth.tube.exponents` prints the table of the colons that networks are trained on.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import cv2
import numpy as np
import torch

from lightdepth.camera import CameraModel
from lightdepth.decline import masked_blur
from lightdepth.geometry import normals_from_distance
from lightdepth.tube.path import lens
from lightdepth.tube.scene import TubeConfig, realistic
from lightdepth.tube.sequence import render_sequence

BLUR = 4 / 1080  # of the image height, of V
ERODED = 15 / 1080  # of the image height: width of the square by which the fit mask shrinks
V_RANGE = (0.04, 0.97)
LEAST_COSINE = 0.1
FARTHEST_MM = 99.0
REAL_RANGES = {"distance": (-0.95, -0.55), "cosine": (0.15, 0.30), "spread": (0.6, 1.25)}
"""What fits to real C3VD frames gave."""


class Exponents(NamedTuple):
    """b1, b2 and b3 above, the share of the variance of log V that they explain, and the number of pixels used."""

    distance: float
    cosine: float
    spread: float
    explained: float
    pixels: int


def fit_exponents(
    image: np.ndarray,
    distance: np.ndarray,
    camera: CameraModel,
    valid: np.ndarray | None = None,
    normals: np.ndarray | None = None,
) -> Exponents | None:
    """Least squares on one image (H, W, 3) encoded, with its distance (H, W) in mm, 0 where unknown.

    Without normals (H, W, 3) in camera axes they come from the distance, blurred. Pixels that are black, saturated,
    grazing, farther than 99 mm or within 15/1080 of the image height of such are left out, so blur and saturation hide
    nothing. None where fewer than 200 pixels, or less than a hundredth of the image, remain.
    """
    height = image.shape[0]
    rays, rays_valid = camera.rays()
    known = rays_valid & (distance > 0) & (rays[..., 2] > 0)
    if valid is not None:
        known = known & valid
    inside = _tensor(known[..., None]).bool()
    blurred = masked_blur(_tensor(image.max(-1)[..., None]), inside, BLUR * height)[0, 0].numpy()
    if normals is None:
        smooth = masked_blur(_tensor(np.log(np.where(known, distance, 1))[..., None]), inside, BLUR * height).exp()
        normals = normals_from_distance(smooth, _tensor(rays))[0].permute(1, 2, 0).numpy()
    cosine = -(normals * rays).sum(-1)
    depth = distance * rays[..., 2]
    use = known & (blurred > V_RANGE[0]) & (blurred < V_RANGE[1]) & (cosine > LEAST_COSINE)
    use &= (depth > 1) & (depth < FARTHEST_MM)
    side = max(3, 2 * round(ERODED * height / 2) + 1)
    use = cv2.erode(use.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0).astype(bool)
    if use.sum() < max(200, use.size // 100):
        return None
    value = np.log(blurred[use])
    terms = np.stack([np.log(distance[use]), np.log(cosine[use]), rays[use][:, 2] - 1, np.ones(len(value))], -1)
    solution = np.linalg.lstsq(terms, value, rcond=None)[0]
    left = value - terms @ solution
    by_distance, by_cosine, by_spread = (float(x) for x in solution[:3])
    explained = float(1 - left.var() / max(value.var(), 1e-12))
    return Exponents(by_distance, by_cosine, by_spread, explained, len(value))


def scene_exponents(
    config: TubeConfig, seeds: range, size: tuple[int, int] = (160, 128), views: int = 2, lenses: tuple[str, ...] = ()
) -> np.ndarray:
    """(n, 3) exponents b1, b2, b3 of every view that allows a fit, of one colon a seed."""
    rows = []
    for seed in seeds:
        camera = lens(lenses[seed % len(lenses)] if lenses else "c3vd", *size)
        for frame in render_sequence(seed, views, camera, 60.0, config).frames:
            assert frame.true_distance is not None
            found = fit_exponents(frame.image, frame.true_distance, camera, frame.valid)
            if found is not None:
                rows.append(found[:3])
    return np.array(rows).reshape(-1, 3)


def table(exponents: np.ndarray) -> str:
    """Quantiles of exponents (n, 3), beside what real frames gave."""
    at = (0.05, 0.25, 0.5, 0.75, 0.95)
    lines = [f"{len(exponents)} views" + "".join(f"{f'{100 * q:.0f} %':>9}" for q in at) + "     real"]
    for name, column in zip(REAL_RANGES, exponents.T, strict=True):
        low, high = REAL_RANGES[name]
        quantiles = "".join(f"{v:9.2f}" for v in np.quantile(column, at))
        inside = ((column >= low) & (column <= high)).mean()
        lines.append(f"{name:<9}{quantiles}   {low:.2f} to {high:.2f} ({100 * inside:.0f} % inside)")
    return "\n".join(lines)


def _tensor(array: np.ndarray) -> torch.Tensor:
    """(H, W, C) -> (1, C, H, W) float32."""
    return torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)[None], np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description="Exponents of brightness in synthetic colons")
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--plain", action="store_true", help="the plain colons of TubeConfig() instead")
    arguments = parser.parse_args()
    config = TubeConfig() if arguments.plain else realistic()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.scenes)
    print(table(scene_exponents(config, seeds)))


if __name__ == "__main__":
    main()
