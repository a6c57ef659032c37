"""Small pictures of keyframes: the image, what was predicted of it, and how well that meets the map's points."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from densify.aligned import AlignedKeyframe
from densify.predictions import SeenKeyframe
from densify.scene import KEYFRAMES
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.reporting.figures import (
    UNSURE,
    colored_distance,
    jpeg,
    marked_points,
    side_by_side,
    signed_colors,
    thumbnail,
    uncertainty_colors,
)
from lightdepth.reporting.scene import Picture
from lightdepth.sparse_map import SparseMap

OFF = 0.25
"""Share of its distance by which a map point is off the depth where its dot has its full colour."""
PICTURES = 24
"""The most keyframes whose pictures are in a report."""
_WIDTH = 240  # of such a picture
_ENOUGH = 2 * _WIDTH
"""Pixels across, about, of what is coloured before it is made smaller: of large frames every so manieth is taken."""
_LEVELS = 11  # colours of dots, an odd number: one is white


class Thumbnails:
    """Pictures of keyframes, taken as they pass: `found` has those of some, spread over all submaps, by name, and
    `rows` one row (JPEG) for every keyframe by its number: distance, uncertainty and residual beside each other."""

    def __init__(self, sparse_map: SparseMap, most: int = PICTURES):
        self._chosen = set(chosen(sparse_map, most))
        self.found: dict[str, Picture] = {}
        self.rows: dict[int, bytes] = {}

    def __call__(self, aligned: AlignedKeyframe, seen: SeenKeyframe) -> None:
        name, number = aligned.keyframe.name, aligned.keyframe.number
        if number in self.rows or seen.frame is None or seen.prediction is None:
            return
        few = (slice(None, None, max(1, seen.prediction.valid.shape[1] // _ENOUGH)),) * 2
        valid, sigma = seen.prediction.valid[few], seen.prediction.uncertainty
        sigma = None if sigma is None else sigma[few]
        distance = colored_distance(seen.prediction.distance[few], valid)
        unsure = None if sigma is None else uncertainty_colors(sigma, valid)
        residual = residual_picture(aligned, seen.frame.image)
        shown = [None if p is None else thumbnail(p, _WIDTH) for p in (distance, unsure, residual)]
        empty = np.zeros_like(thumbnail(distance, _WIDTH))
        self.rows[number] = jpeg(side_by_side([empty if p is None else p for p in shown]), 80)
        if name in self._chosen:
            small = (None if p is None else jpeg(p, 80) for p in shown)
            self.found[name] = Picture(jpeg(thumbnail(seen.frame.image, _WIDTH), 80), *small)

    def write(self, folder: Path) -> None:
        """The rows, in the folder of that name in a run's."""
        if self.rows:
            (folder / KEYFRAMES).mkdir()
        for number, row in self.rows.items():
            (folder / KEYFRAMES / f"{number:06d}.jpg").write_bytes(row)


def chosen(sparse_map: SparseMap, most: int = PICTURES) -> list[str]:
    """The names of some keyframes, spread over all submaps."""
    names = list(dict.fromkeys(k.name for s in sparse_map.submaps for k in s.keyframes))
    rows = np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int)
    return [names[i] for i in dict.fromkeys(rows.tolist())]


def images_alone(frames: FrameSequence, sparse_map: SparseMap) -> dict[str, Picture]:
    """The images of some keyframes by name, as far as they can be read: of a run that had no time for more."""
    keyframes = {k.name: k for s in sparse_map.submaps for k in s.keyframes}
    found = {}
    for name in chosen(sparse_map):
        with suppress(InputError):
            found[name] = Picture(jpeg(thumbnail(frames.of_keyframe(keyframes[name]).image, _WIDTH), 80))
    return found


def residual_picture(aligned: AlignedKeyframe, image: np.ndarray) -> np.ndarray | None:
    """The image (H, W, 3) in dark grey, and a dot at each map point that was observed: white where the depth, as it was
    aligned, meets it, red where the depth is too far for it, blue where too near. None where nothing was aligned."""
    residual = residuals(aligned)
    if residual is None or aligned.observed is None:
        return None
    small = cv2.cvtColor(thumbnail(image, _WIDTH), cv2.COLOR_RGB2GRAY)
    grey = np.rint(0.55 * np.repeat(small[..., None], 3, 2)).astype(np.uint8)
    levels = np.linspace(-1, 1, _LEVELS)
    nearest = np.abs(np.clip(residual / OFF, -1, 1)[:, None] - levels).argmin(1)
    colors = signed_colors(levels[None], np.ones((1, _LEVELS), bool))[0]
    order = sorted(range(_LEVELS), key=lambda k: abs(levels[k]))  # what is off lies on top
    groups = []
    for k in order:
        red, green, blue = map(int, colors[k])
        groups.append((aligned.observed.pixels[nearest == k] * (_WIDTH / image.shape[1]), (red, green, blue)))
    return marked_points(grey, groups, _WIDTH)


def residuals(aligned: AlignedKeyframe) -> np.ndarray | None:
    """Log of the depth, as it was aligned, over the distance (n,) of the map's points that the keyframe observed; None
    where it has no scale."""
    observed, a = aligned.observed, aligned.alignment
    if observed is None or not len(observed) or not a.scale > 0:
        return None
    field = np.log(a.scale) if a.bend is None else a.bend.at(observed.pixels, observed.predicted)
    found: np.ndarray = np.log(observed.predicted) + field - np.log(observed.mapped)
    return found


def said() -> Mapping[str, str]:
    """What the pictures of a row show, from the left, and how to read them."""
    return {
        "distance": "predicted distance (yellow near)",
        "uncertainty": f"its uncertainty (yellow: {UNSURE:.0%} and more)",
        "residual": f"map points (white: the depth meets them, red: it is too far, blue: too near, full at {OFF:.0%})",
    }
