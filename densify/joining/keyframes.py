"""Keyframes of two submaps: brought into one frame of reference, and compared pixel by pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from densify.similarity import Similarity
from lightdepth.sparse_map import Keyframe


def moved_keyframe(keyframe: Keyframe, similarity: Similarity) -> Keyframe:
    """The keyframe in the frame and unit that the similarity leads to: what it sees stays where it was in its image."""
    pose = np.eye(4)
    pose[:3, :3] = keyframe.cam_from_map[:3, :3] @ similarity.rotation.T
    pose[:3, 3] = similarity.scale * keyframe.cam_from_map[:3, 3] - pose[:3, :3] @ similarity.translation
    return replace(keyframe, cam_from_map=pose)


def same_pixels(one: np.ndarray, other: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of pixels (n, 2) and (m, 2) that are each other's nearest, at most `reach` apart."""
    if not len(one) or not len(other):
        return np.zeros(0, int), np.zeros(0, int)
    distance, there = cKDTree(other).query(one)
    back = cKDTree(one).query(other)[1]
    rows = np.flatnonzero((back[there] == np.arange(len(one))) & (distance <= reach))
    return rows, there[rows]
