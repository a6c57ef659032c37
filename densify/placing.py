"""Predictions of a submap's keyframes, placed in it as `densify` places them: aligned together and bent.

By this a light is judged (lightdepth.light): by what is delivered, not by what one scale would give.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from densify.aligned import AlignedKeyframe, align_alone, align_together
from densify.alignment import AlignmentConfig
from densify.config import DensifyConfig, MethodConfig
from densify.predictions import SeenKeyframe
from lightdepth.light.views import Placed
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import LARGEST
from lightdepth.sparse_map import Submap


@dataclass(frozen=True)
class Placing:
    """A way of densifying, as a way to place predictions. Its gates are open: every keyframe counts, or a model would
    be praised for those that it loses. Keyframes are not compared where they overlap: that takes half of the time, and
    changed none of nine verdicts on real and synthetic maps."""

    config: MethodConfig

    def __call__(self, submap: Submap, predictions: Sequence[DepthPrediction]) -> list[Placed | None]:
        own = self.config
        config = replace(own, alignment=_open(own.alignment), agreement=replace(own.agreement, overlap=0.0))
        keyframes = [
            align_alone(keyframe, submap, SeenKeyframe(prediction=prediction), config.alignment)
            for keyframe, prediction in zip(submap.keyframes, predictions, strict=True)
        ]
        if not (isinstance(config, DensifyConfig) and config.recipe == "paper"):
            keyframes = align_together(keyframes, np.zeros((len(keyframes), len(keyframes)), int), config)
        return [_placed(each) for each in keyframes]


def _open(config: AlignmentConfig) -> AlignmentConfig:
    return replace(
        config,
        min_inliers=0,
        min_inlier_share=0.0,
        max_relative_sigma=LARGEST,
        min_spread_deg=0.0,
        min_distance_spread=0.0,
        max_second_mode=LARGEST,
    )


def _placed(keyframe: AlignedKeyframe) -> Placed | None:
    alignment = keyframe.alignment
    if not alignment.ok:
        return None

    def placed(observed: ObservedDistances) -> np.ndarray:
        if alignment.bend is None:
            return alignment.scale * observed.predicted
        result: np.ndarray = observed.predicted * np.exp(alignment.bend.at(observed.pixels, observed.predicted))
        return result

    return placed
