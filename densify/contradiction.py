"""Pixels that nearer keyframes contradict take no part in the surface.

Depth errs in proportion to the distance or faster, so where two keyframes see the same tissue the nearer one knows
better. Notation: X a pixel of keyframe a placed in the map, d_a its distance; p its projection in keyframe b,

    gap = log |X - c_b| - log d_b(p).

A gap well below -tolerance says that b sees through X: one of the two pixels is wrong, and it is the farther one's
that gets a vote against it. A gap well within the tolerance is a vote for the farther pixel; between, votes change
steadily. A positive gap beyond it says nothing: X may be hidden from b. With votes v, a pixel keeps of its weight

    1 + 10 sum v / (1 + sum |v|),   in [0, 1],

so that one is left out where clearly more votes speak against it than for it; those around it keep less, so that
nothing ends in a step.
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

_SPREAD = 1.0  # of what is left out, cells
_STEEP = 10.0
"""How steeply the share falls: at 2, ghosts stay before far wall (RMS 3.3 mm on six colons, 3.04 at 10)."""


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
    points with it. More compare more of its pixels, so that more may be left out, and take longer."""
    samples: Annotated[int, at_least(1, up_to=10_000)] = 80
    """Number of pixels across the image that are compared, and in proportion down; each speaks for the cell around it.
    More find the edges of what is left out more finely and take longer."""


def uncontradicted(
    views: Sequence[View], bends: Sequence[Bend], shared: np.ndarray, config: ContradictionConfig
) -> list[np.ndarray]:
    """Share (h, w) float32 in [0, 1], coarse over the image, of its weight that each pixel keeps, for every view.
    `shared` as for `agree`."""
    shapes = [(max(2, round(config.samples * v.valid.shape[0] / v.valid.shape[1])), config.samples) for v in views]
    votes = [np.zeros((2, *shape)) for shape in shapes]
    for a, view in enumerate(views):
        x = view.grid(config.samples)
        if not len(x):
            continue
        camera = view.keyframe.camera
        rays, _ = camera.unproject(x * (camera.width, camera.height))
        log_b, _ = view.at(x)
        log_d = log_b + bends[a].along(x, log_b)
        own = _cells(x, shapes[a])
        for b in _judges(shared[a], a, config.judges):
            found = gap_between(view, views[b], bends[b], rays, log_d)
            nearer = log_d < found.log_reach
            vote = _vote(found.gap / config.tolerance) * found.known
            theirs = _cells(found.x, shapes[b])
            for into, cells, use in ((votes[a], own, ~nearer), (votes[b], theirs, nearer)):
                np.add.at(into[0], tuple(cells[use].T), vote[use])
                np.add.at(into[1], tuple(cells[use].T), np.abs(vote[use]))
    return [_kept(*v) for v in votes]


def share_at(stays: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The coarse map `stays` (h, w) at every pixel of an image of that shape (H, W)."""
    result: np.ndarray = cv2.resize(stays, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return result


def _vote(gap: np.ndarray) -> np.ndarray:
    """The vote (n,) in [-1, 1] of gaps (n,) in tolerances: 0 at one below, and beyond one and a half above."""
    result: np.ndarray = np.minimum(np.clip(2 + 2 * gap, -1, 1), np.clip(3 - 2 * gap, 0, 1))
    return result


def _kept(votes: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The share (h, w) that pixels keep, by the sums (h, w) of votes and of their sizes in cells."""
    share = np.clip(1 + _STEEP * votes / (1 + size), 0, 1)
    result: np.ndarray = np.minimum(share, cv2.GaussianBlur(share, (0, 0), _SPREAD)).astype(np.float32)
    return result


def _judges(shared: np.ndarray, own: int, most: int) -> list[int]:
    having = [int(j) for j in np.flatnonzero(shared) if j != own]
    return [having[k] for k in np.unique(np.linspace(0, len(having) - 1, min(most, len(having))).round().astype(int))]


def _cells(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Row and column (n, 2) of x (n, 2) in [0, 1]² on a grid of that shape."""
    result: np.ndarray = np.clip((x[:, ::-1] * shape).astype(int), 0, np.array(shape) - 1)
    return result
