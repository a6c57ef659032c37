"""Which frames may show the same place: those that follow each other, and those whose features are alike.

Notation: a frame is described by its VLAD (Jegou et al. 2010): the sum, word by word, of how its SIFT descriptors
differ from the nearest of K visual words, which are made from the sequence itself, so that no vocabulary is needed.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.cluster.vq import kmeans2, vq

WORDS = 32


def frame_pairs(descriptors: Sequence[np.ndarray], overlap: int, alike: int, seed: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, sorted: of each frame the next `overlap`, and the `alike` most similar beyond them.

    `descriptors` (n_i, 128) of each frame, in time.
    """
    count = len(descriptors)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + overlap, count - 1) + 1)}
    if alike and count > overlap + 1:
        looks = vlad(descriptors, seed)
        similar = looks @ looks.T
        apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
        similar[(apart <= overlap) | (similar <= 0)] = -np.inf
        for i, row in enumerate(similar):
            for j in np.argsort(-row, kind="stable")[:alike]:
                if np.isfinite(row[j]):
                    pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def vlad(descriptors: Sequence[np.ndarray], seed: int) -> np.ndarray:
    """(frames, WORDS * 128) unit vectors; zero for a frame without features."""
    rooted = [_rooted(d) for d in descriptors]
    words = _words(rooted, np.random.default_rng(seed))
    result = np.zeros((len(rooted), len(words), 128), np.float32)
    for i, features in enumerate(rooted):
        if len(features):
            nearest, _ = vq(features, words)
            np.add.at(result[i], nearest, features - words[nearest])
    length = np.linalg.norm(result, axis=2, keepdims=True)
    result /= np.where(length > 0, length, 1)  # so that a pattern that repeats counts once
    flat = result.reshape(len(rooted), -1)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return flat / np.where(length > 0, length, 1)


def _rooted(descriptors: np.ndarray) -> np.ndarray:
    found = np.asarray(descriptors, np.float32).reshape(-1, 128)
    result: np.ndarray = np.sqrt(found / found.sum(1, keepdims=True).clip(min=1e-9))
    return result


def _words(rooted: Sequence[np.ndarray], rng: np.random.Generator, rounds: int = 10, most: int = 20000) -> np.ndarray:
    """K-means of a sample of all features."""
    every = np.concatenate(rooted)
    if len(every) <= WORDS:
        return every if len(every) else np.zeros((1, 128), np.float32)
    sample = every[np.sort(rng.permutation(len(every))[:most])]
    words = sample[np.sort(rng.permutation(len(sample))[:WORDS])]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")  # its word stays where it was
        result: np.ndarray = kmeans2(sample, words, iter=rounds, minit="matrix")[0]
        return result
