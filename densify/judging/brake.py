"""How much of its bend each keyframe keeps: as much as distances speak for that it was not fitted to.

A bend follows the points of the map, and these may err together: a side of the wall that is too far bends every
keyframe that sees it. So all of the bend, half of it and none (one scale) are held against distances by parallax. With
L_s the mean squared error in log distance with a share s of the bend, errors cut at 40 %, over the n distances of a
keyframe, and M_s that over all of its submap,

    loss_s = (n L_s + m M_s) / (n + m),

m distances of the submap standing in for what a keyframe with few of its own does not know. The keyframe keeps the
least share whose loss is within one standard error of the least loss: where the images can hardly tell, less is bent.

Where the images are silent, blocks of wall that were hidden from the bend decide, by the same losses, between all of it
and none. It must then be better by some, and no larger than its prior lets expect, since blocks beside the hidden ones
may share their error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

SHARES = (0.0, 0.5, 1.0)
"""Shares of a bend that are tried."""
_CUT = 0.4
_BORROWED = 100.0
_LEAST = 40
_GAIN_BY_MAP = 0.95
_LARGEST = 2.0


@dataclass(frozen=True)
class Tried:
    """One keyframe's bend: errors in log distance (n, 3) with each of SHARES by the images, errors as shares (m, 2)
    with none and all of it at hidden blocks, and the size of the bend in deviations of its prior (1 is usual)."""

    by_images: np.ndarray
    by_map: np.ndarray
    size: float


@dataclass(frozen=True)
class Kept:
    """The share of a bend that is kept, and why no more of it is; empty where all is."""

    share: float
    reason: str = ""


def kept(tried: Mapping[str, Tried]) -> dict[str, Kept]:
    """What each keyframe keeps of its bend, by name."""
    images = {name: _squared(t.by_images) for name, t in tried.items()}
    if sum(map(len, images.values())) >= _LEAST:
        return _least_within_error(images)
    blocks = {name: _squared(t.by_map) for name, t in tried.items()}
    if not sum(map(len, blocks.values())):
        return dict.fromkeys(tried, Kept(0.0, "nothing that it was not fitted to can judge the bend"))
    return {name: _by_blocks(losses[0], losses[1], tried[name].size) for name, losses in _losses(blocks).items()}


def _least_within_error(squared: Mapping[str, np.ndarray]) -> dict[str, Kept]:
    every = np.concatenate(list(squared.values()))
    found = {}
    for name, losses in _losses(squared).items():
        best = int(losses.argmin())
        error = (every - every[:, [best]]).std(0) / np.sqrt(len(squared[name]) + _BORROWED)
        least = int(np.flatnonzero(losses - losses[best] <= error)[0])
        share, whole = SHARES[least], SHARES.index(1.0)
        why = f"by the images {_shown(losses[least])} are left with {_part(share)}, {_shown(losses[whole])} with all"
        found[name] = Kept(share, "" if least == whole else why)
    return found


def _by_blocks(none: float, every: float, size: float) -> Kept:
    if size > _LARGEST:
        why = f"the bend is {size:.1f} times as large as is usual, and the images do not tell whether it is right"
        return Kept(0.0, why)
    if every >= _GAIN_BY_MAP**2 * none:
        return Kept(0.0, f"at hidden blocks of wall {_shown(none)} are left with one scale, {_shown(every)} with it")
    return Kept(1.0)


def _losses(squared: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    lent = _BORROWED * np.concatenate(list(squared.values())).mean(0)
    return {name: (of.sum(0) + lent) / (len(of) + _BORROWED) for name, of in squared.items()}


def _squared(errors: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.minimum(errors[np.isfinite(errors).all(1)] ** 2, _CUT**2)
    return result


def _part(share: float) -> str:
    return "one scale" if share == 0 else f"{share:.0%} of the bend"


def _shown(loss: float) -> str:
    return f"{np.sqrt(loss):.1%}"
