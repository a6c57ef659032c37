"""One submap, as it is compared with others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from densify.dense_map import DenseMap
from densify.joining.join import MergeConfig
from densify.joining.looks import descriptors
from densify.joining.shape import Shape, shape_of
from lightdepth.datasets import FrameSequence
from lightdepth.sparse_map import Keyframe, Submap, typical_distance


@dataclass(frozen=True, eq=False)
class Side:
    """A submap with its surface and images; what is compared of it is worked out once, when first asked for."""

    dense: DenseMap
    frames: FrameSequence | None
    config: MergeConfig

    @property
    def submap(self) -> Submap:
        return self.dense.submap

    @cached_property
    def reach(self) -> float:
        return typical_distance(self.submap)

    @cached_property
    def by_number(self) -> dict[int, Keyframe]:
        return {k.number: k for k in self.submap.keyframes}

    @cached_property
    def distance(self) -> np.ndarray:
        """Of each point (n,) from the nearest camera that observed it; from the nearest of all where none did."""
        result = np.full(len(self.submap.points), np.inf)
        for keyframe in self.submap.keyframes:
            ids, points, _ = self.submap.observed_points(keyframe)
            rows = self.submap.rows_of(ids)[0]
            np.minimum.at(result, rows, np.linalg.norm(points - keyframe.center, axis=1))
        centers = np.array([k.center for k in self.submap.keyframes])
        return np.where(np.isfinite(result), result, cKDTree(centers).query(self.submap.points)[0])

    @cached_property
    def some_keyframes(self) -> list[Keyframe]:
        chosen = np.unique(np.linspace(0, len(self.submap.keyframes) - 1, 8).astype(int))
        return [self.submap.keyframes[i] for i in chosen]

    @cached_property
    def looks(self) -> tuple[np.ndarray, np.ndarray]:
        assert self.frames is not None, "without images nothing can look alike"
        observed = any(len(self.submap.observed_points(k)[0]) for k in self.submap.keyframes)
        reach = self.reach if observed else 0.0  # nobody observed a point: there is none to describe, and no reach
        return descriptors(self.submap, self.frames, reach)

    def shape(self, ratio: float) -> Shape:
        if ratio not in self._shapes:
            self._shapes[ratio] = shape_of(self.dense, self.reach / ratio, self.config)
        return self._shapes[ratio]

    @cached_property
    def _shapes(self) -> dict[float, Shape]:
        return {}
