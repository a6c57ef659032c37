"""Pixels that nearer keyframes contradict take no part in the surface.

Depth errs in proportion to the distance or faster, so where two keyframes see the same tissue the nearer one knows
better. Notation: X a pixel of keyframe a placed in the map, d_a its distance; p its projection in keyframe b,

    gap = log |X - c_b| - log d_b(p).

A gap below -tolerance says that b sees through X: one of the two pixels is wrong, and it is the farther one's that
gets a vote against it. A gap within the tolerance is a vote for the farther pixel. A positive gap says nothing: X may
be hidden from b. Pixels with more votes against them than for them are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from densify.agreement import View, gap_between
from densify.bending import Bend
from lightdepth.ranges import above, at_least, checked


@dataclass(frozen=True)
@checked
class ContradictionConfig:
    """When a pixel is contradicted."""

    on: bool = True
    """Whether a pixel is left out of the surface where keyframes nearer to the wall look through it and see wall
    farther on; switched off, it stays."""
    tolerance: Annotated[float, above(0)] = 0.05
    """Difference, in log distance (0.05 is 5 %), up to which two keyframes agree on a pixel; only beyond it can one
    contradict the other. A larger one leaves out fewer pixels."""
    judges: Annotated[int, at_least(1, up_to=1000)] = 8
    """Number of other keyframes that each keyframe is compared with, chosen evenly in time among those that share map
    points with it. More let more of its pixels be compared, so more may be removed, and take longer."""
    samples: Annotated[int, at_least(1, up_to=10_000)] = 80
    """Number of pixels across the image that are compared, and in proportion down; each speaks for the cell around it.
    More tell the edges of what is left out more finely and take longer."""


def uncontradicted(
    views: Sequence[View], bends: Sequence[Bend], shared: np.ndarray, config: ContradictionConfig
) -> list[np.ndarray]:
    """Share (h, w) float32, coarse over the image, of pixels that stay, for every view. `shared` as for `agree`."""
    shapes = [(max(2, round(config.samples * v.valid.shape[0] / v.valid.shape[1])), config.samples) for v in views]
    votes = [np.zeros(shape) for shape in shapes]
    for a, view in enumerate(views):
        x = view.grid(config.samples)
        if not len(x):
            continue
        camera = view.keyframe.camera
        rays, _ = camera.unproject(x * (camera.width, camera.height))
        log_b, _ = view.at(x)
        log_d = log_b + bends[a].basis(x, log_b) @ bends[a].weights
        own = _cells(x, shapes[a])
        for b in _judges(shared[a], a, config.judges):
            found = gap_between(view, views[b], bends[b], rays, log_d)
            nearer = log_d < found.log_reach
            vote = np.where(found.gap < -config.tolerance, -1.0, np.abs(found.gap) <= config.tolerance) * found.known
            np.add.at(votes[a], tuple(own[~nearer].T), vote[~nearer])
            theirs = _cells(found.x, shapes[b])
            np.add.at(votes[b], tuple(theirs[nearer].T), vote[nearer])
    return [(v >= 0).astype(np.float32) for v in votes]


def without(valid: np.ndarray, stays: np.ndarray) -> np.ndarray:
    """valid (H, W) where the coarse map `stays` (h, w) does not speak against it."""
    height, width = valid.shape
    return valid & (cv2.resize(stays, (width, height), interpolation=cv2.INTER_NEAREST) > 0.5)


def _judges(shared: np.ndarray, own: int, most: int) -> list[int]:
    having = [int(j) for j in np.flatnonzero(shared) if j != own]
    return [having[k] for k in np.unique(np.linspace(0, len(having) - 1, min(most, len(having))).round().astype(int))]


def _cells(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Row and column (n, 2) of x (n, 2) in [0, 1]² on a grid of that shape."""
    result: np.ndarray = np.clip((x[:, ::-1] * shape).astype(int), 0, np.array(shape) - 1)
    return result
