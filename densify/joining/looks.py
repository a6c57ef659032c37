"""How map points look: descriptors of their surroundings in the images, and which are alike."""

from __future__ import annotations

import cv2
import numpy as np

from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.sparse_map import Submap


def descriptors(
    submap: Submap, frames: FrameSequence, reach: float, per_point: int = 3, window: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points (n,) and SIFT descriptors (n, 128) of their surroundings, in up to per_point of their keyframes.

    The distance of a point tells how large its surroundings are in the image, and their brightness which way is up, so
    that neither has to be guessed: `window` is the feature's size, in shares of the submap's `reach`.
    """
    seen = np.zeros(len(submap.points), int)
    rows, looks = [], []
    sift = cv2.SIFT.create()
    for keyframe in submap.keyframes[::2] if len(submap.keyframes) > 8 else submap.keyframes:
        ids, points, pixels = submap.observed_points(keyframe)
        own = submap.rows_of(ids)[0]
        wanted = seen[own] < per_point
        try:
            frame = frames.of_keyframe(keyframe)
        except InputError:  # missing, unreadable, or of another size: its reason is in keyframes.csv
            continue
        if not wanted.any():
            continue
        own, points, pixels = own[wanted], points[wanted], pixels[wanted]
        grey = cv2.cvtColor((frame.image * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        distance = np.linalg.norm(keyframe.in_camera(points), axis=1)
        sizes = (window * keyframe.camera.focal_length * reach / distance.clip(min=1e-9)).clip(2, 40)
        wished = [
            cv2.KeyPoint(float(x - 0.5), float(y - 0.5), float(size), _upwards(grey, x, y, 3 * size), 1, 0, i)
            for i, ((x, y), size) in enumerate(zip(pixels, sizes, strict=True))
        ]
        features, found = sift.compute(grey, wished)
        if found is None:
            continue
        index = [f.class_id for f in features]
        seen[own[index]] += 1
        rows.append(own[index])
        looks.append(np.sqrt(found / found.sum(1, keepdims=True).clip(min=1e-9)))  # RootSIFT
    if not rows:
        return np.zeros(0, int), np.zeros((0, 128), np.float32)
    return np.concatenate(rows), np.concatenate(looks).astype(np.float32)


def _upwards(grey: np.ndarray, x: float, y: float, radius: float) -> float:
    """Direction [degrees] from the pixel (x, y) to the centre of brightness of the disc around it (Rosin 1999)."""
    x0, x1 = max(0, int(x - radius)), min(grey.shape[1], int(x + radius) + 1)
    y0, y1 = max(0, int(y - radius)), min(grey.shape[0], int(y + radius) + 1)
    part = grey[y0:y1, x0:x1].astype(np.float32)
    dx, dy = np.arange(x0, x1) + 0.5 - x, np.arange(y0, y1)[:, None] + 0.5 - y
    part = part * (dx**2 + dy**2 <= radius**2)
    return float(np.rad2deg(np.arctan2((part * dy).sum(), (part * dx).sum())) % 360)


def alike(
    rows_a: np.ndarray, looks_a: np.ndarray, rows_b: np.ndarray, looks_b: np.ndarray, ratio: float = 0.9
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points of either side that look alike, each the other's likeliest, and clearly so."""

    def likeliest(
        looks: np.ndarray, others: np.ndarray, rows: np.ndarray, other_rows: np.ndarray
    ) -> dict[int, tuple[float, int]]:
        best: dict[int, tuple[float, int]] = {}
        for matches in cv2.BFMatcher(cv2.NORM_L2).knnMatch(looks, others, k=6):
            first = matches[0]
            point = int(other_rows[first.trainIdx])
            rival = next((m.distance for m in matches[1:] if other_rows[m.trainIdx] != point), np.inf)
            row = int(rows[first.queryIdx])
            if first.distance < ratio * rival and first.distance < best.get(row, (np.inf, 0))[0]:
                best[row] = (first.distance, point)
        return best

    forward, back = likeliest(looks_a, looks_b, rows_a, rows_b), likeliest(looks_b, looks_a, rows_b, rows_a)
    pairs = [(a, b) for a, (_, b) in sorted(forward.items()) if back.get(b, (0.0, -1))[1] == a]
    found = np.array(pairs, int).reshape(-1, 2)
    return found[:, 0], found[:, 1]
