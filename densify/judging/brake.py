"""Which keyframes keep their bend: those that distances which it was not fitted to speak for.

A bend follows the points of the map, and these may err together: a side of the wall that is too far bends every
keyframe that sees it. So a bend is held against one scale at distances by parallax, and where the images are silent at
blocks of wall that were hidden from it. With e_b, e_s the errors of bend and scale, cut at 50 %, over the distances of
a keyframe, and E_b, E_s those of its whole submap,

    ratio = (sum e_b + m mean E_b) / (sum e_s + m mean E_s),

m distances of the submap standing in for what a keyframe with few of its own does not know. A bend is kept where the
ratio is below 1. Where hidden blocks alone decide, it must also be no larger than its prior lets expect, since blocks
beside the hidden ones may share their error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

_CUT = 0.5
_BORROWED = 50.0
_LEAST = 40
_GAIN_BY_MAP = 0.95
_LARGEST = 2.0


@dataclass(frozen=True)
class Tried:
    """One keyframe's bend beside its scale: errors of both (n, 2) by the images and (m, 2) at hidden blocks, as shares,
    and the size of the bend in deviations of its prior (1 is usual)."""

    by_images: np.ndarray
    by_map: np.ndarray
    size: float


def undone(tried: Mapping[str, Tried]) -> dict[str, str]:
    """Why the bend of a keyframe is undone, by name; the others keep theirs."""
    images = _cut([t.by_images for t in tried.values()])
    if len(images) >= _LEAST:
        return _worse(tried, {name: _cut([t.by_images]) for name, t in tried.items()}, images, 1.0, "the images")
    hidden = _cut([t.by_map for t in tried.values()])
    if not len(hidden):
        return dict.fromkeys(tried, "nothing that it was not fitted to can judge the bend")
    blocks = {name: _cut([t.by_map]) for name, t in tried.items()}
    found = _worse(tried, blocks, hidden, _GAIN_BY_MAP, "hidden blocks of wall")
    large = {
        name: f"the bend is {t.size:.1f} times as large as is usual, and the images do not tell whether it is right"
        for name, t in tried.items()
        if t.size > _LARGEST
    }
    return {**large, **found}


def _worse(
    tried: Mapping[str, Tried], errors: Mapping[str, np.ndarray], of_all: np.ndarray, most: float, judge: str
) -> dict[str, str]:
    lent = _BORROWED * of_all.mean(0)
    found = {}
    for name in tried:
        bent, scaled = errors[name].sum(0) + lent
        if bent >= most * scaled:
            count = len(errors[name]) + _BORROWED
            found[name] = f"by {judge} the bend is {bent / count:.1%} off, one scale {scaled / count:.1%}"
    return found


def _cut(errors: Sequence[np.ndarray]) -> np.ndarray:
    together = np.concatenate([np.zeros((0, 2)), *errors])
    result: np.ndarray = np.minimum(together[np.isfinite(together).all(1)], _CUT)
    return result
