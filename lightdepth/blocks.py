"""Blocks of wall: points that lie together, and folds of them that are withheld together.

Errors of a sparse map are shared by neighbouring points, which were tracked together. A point that is withheld beside
others that are used is no witness: what it says was said already. So points are withheld in blocks, from every
keyframe at once (Roberts et al. 2017, "Cross-validation strategies for data with temporal, spatial, hierarchical, or
phylogenetic structure").
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from lightdepth.sparse_map import Submap, typical_distance

BLOCK_SIZE = 0.5
"""Side of a block, in typical distances: about a quarter of what an image shows."""
_LEAST_BLOCKS_PER_FOLD = 2
_HALVINGS = 4


def wall_blocks(points: np.ndarray, size: float, seed: int = 0) -> np.ndarray:
    """The block (n,) that each point (n, 3) lies in, numbered from 0: cubes of the side `size`, in the points' unit.

    `seed` shifts and turns the cubes, so that no border is there every time.
    """
    rng = np.random.default_rng([seed, 2])
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    cells = np.floor(points @ turn / size + rng.random(3)).astype(np.int64)
    result: np.ndarray = np.unique(cells, axis=0, return_inverse=True)[1].reshape(len(points))
    return result


def wall_folds(points: np.ndarray, size: float, folds: int = 5, seed: int = 0) -> np.ndarray:
    """The fold (n,) of each point (n, 3), 0 to folds - 1: whole blocks, so that folds have about as many points each.

    Blocks of the side `size` are halved until there are two to a fold, four times at most.
    """
    blocks = wall_blocks(points, size, seed)
    for _ in range(_HALVINGS):
        if blocks.max(initial=0) + 1 >= folds * _LEAST_BLOCKS_PER_FOLD:
            break
        size /= 2
        blocks = wall_blocks(points, size, seed)
    counts = np.bincount(blocks)
    order = np.random.default_rng([seed, 3]).permutation(len(counts))
    fold_of, held = np.zeros(len(counts), int), np.zeros(folds)
    for block in order[np.argsort(-counts[order], kind="stable")]:
        fold_of[block] = int(held.argmin())
        held[fold_of[block]] += counts[block]
    result: np.ndarray = fold_of[blocks]
    return result


def submap_folds(submap: Submap, folds: int = 5, seed: int = 0) -> np.ndarray:
    """The fold (n,) of each point of a submap, by blocks of half a typical distance. Raises InputError where no
    keyframe observes a point."""
    return wall_folds(submap.points, _side(submap), folds, seed)


def submap_blocks(submap: Submap, seed: int = 0) -> np.ndarray:
    """The block (n,) of each point of a submap, of half a typical distance, which folds may halve. Raises InputError
    where no keyframe observes a point."""
    return wall_blocks(submap.points, _side(submap), seed)


def hidden_in_turn(folds: np.ndarray, judging: Iterable[int] | None = None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each fold the points (n,) bool that are hidden, and those that may be used meanwhile.

    Folds are those of the points (n,), but for numbers below 0, which are never hidden; or those in `judging`, also
    where they have no points.
    """
    for fold in np.unique(folds[folds >= 0]).tolist() if judging is None else judging:
        hidden: np.ndarray = folds == fold
        yield hidden, ~hidden


def _side(submap: Submap) -> float:
    return BLOCK_SIZE * typical_distance(submap)
