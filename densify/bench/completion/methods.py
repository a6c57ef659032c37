"""Ways to complete a prediction from sparse points. Each is given the same, and gives distance in map units.

Notation: b predicted, a mapped distance of a keyframe's points, s its LMedS scale (densify.alignment), by which every
way but the median begins: a keyframe whose scale is not trusted is left out for all.

    median scale        d = b median(a / b)
    LMedS scale         d = s b
    scale and shift     d = p b + q, and 1 / d = p / b + q; p, q minimise the sum of rho((d / a - 1) / sigma)
                        (of the inverse: (a / d - 1) / sigma)
    Poisson             densify.bench.completion.poisson
    bending             densify.bending, each keyframe by its own points
    ours                bending, and densify.agreement: the keyframes of a submap together

Errors are relative in all of them, and wrong points are told by the same rules (densify.agreement.point_weights).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from densify.agreement import AgreementConfig, cells_of, growth_of, inlier_deviation, point_weights
from densify.aligned import AlignedKeyframe, align_alone, align_together
from densify.bench.completion.poisson import poisson_completion
from densify.config import DensifyConfig
from densify.predictions import SeenKeyframe
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Submap, covisibility

MEDIAN, LMEDS, POISSON, BENDING, OURS = "median scale", "LMedS scale", "Poisson", "bending alone", "ours"
SHIFT, SHIFT_INVERSE = "scale and shift of distance", "scale and shift of 1 / distance"
Completed = Mapping[str, DepthPrediction]
"""Depth in map units by the name of the keyframe."""


@dataclass(frozen=True, eq=False)
class Task:
    """What every method is given: a submap, those of its keyframes whose LMedS scale is trusted with the points that
    they observed, and the predictions by the name of the keyframe. `left_out` has the reasons of the others."""

    submap: Submap
    keyframes: tuple[AlignedKeyframe, ...]
    seen: Mapping[str, SeenKeyframe]
    left_out: Mapping[str, str]
    config: DensifyConfig

    @classmethod
    def of(
        cls, submap: Submap, frames: FrameSequence, known: Mapping[str, DepthPrediction], config: DensifyConfig
    ) -> Task:
        """`known` has the predictions by the name of the frame."""
        seen = {}
        for keyframe in submap.keyframes:
            frame = frames.of_keyframe(keyframe)
            seen[keyframe.name] = SeenKeyframe(frame, known[frame.name])
        every = [align_alone(k, submap, seen[k.name], config.alignment) for k in submap.keyframes]
        left_out = {k.keyframe.name: k.alignment.reason for k in every if not k.alignment.ok}
        return cls(submap, tuple(k for k in every if k.alignment.ok), seen, left_out, config)

    def each(self, complete: Callable[[DepthPrediction, ObservedDistances, float], DepthPrediction]) -> Completed:
        """What a way says that completes a keyframe by itself, from its prediction, points and LMedS scale."""
        found = {}
        for k in self.keyframes:
            prediction = self.seen[k.keyframe.name].prediction
            assert prediction is not None and k.observed is not None
            found[k.keyframe.name] = complete(prediction, k.observed, k.alignment.scale)
        return found

    def bent(self, config: DensifyConfig) -> Completed:
        """What bends say, under settings of agreement and bending."""
        places = {k.name: i for i, k in enumerate(self.submap.keyframes)}
        rows = [places[k.keyframe.name] for k in self.keyframes]
        shared = covisibility(self.submap)[np.ix_(rows, rows)]
        found = {}
        for k in align_together(self.keyframes, shared, config):
            prediction = self.seen[k.keyframe.name].prediction
            assert prediction is not None
            found[k.keyframe.name] = k.alignment.applied(prediction)
        return found


def median_scale(prediction: DepthPrediction, observed: ObservedDistances, scale: float) -> DepthPrediction:
    """Times the median of a / b."""
    return prediction.scaled(float(np.median(observed.mapped / observed.predicted)))


def lmeds_scale(prediction: DepthPrediction, observed: ObservedDistances, scale: float) -> DepthPrediction:
    """Times the LMedS scale."""
    return prediction.scaled(scale)


WIDTH = 1.0
"""Of Geman-McClure's loss, sigmas, in scale and shift: the best on the tuning seeds of 1, 2, and of Huber's, Cauchy's
and Tukey's losses."""
_NEAREST = 0.1
"""Share of the LMedS scale's distance below which a shift brings no pixel, so that none lies behind the camera, and
one over which none beyond."""


def scale_and_shift(prediction: DepthPrediction, observed: ObservedDistances, scale: float) -> DepthPrediction:
    """p b + q."""
    columns = np.stack([observed.predicted, np.ones(len(observed))], -1) / observed.mapped[:, None]
    p, q = _robust(columns, observed, scale, prediction.camera)
    return _kept(prediction, p * prediction.distance + q, scale)


def scale_and_shift_of_inverse(
    prediction: DepthPrediction, observed: ObservedDistances, scale: float
) -> DepthPrediction:
    """1 / (p / b + q)."""
    columns = np.stack([1 / observed.predicted, np.ones(len(observed))], -1) * observed.mapped[:, None]
    p, q = _robust(columns, observed, 1 / scale, prediction.camera)
    inverse = p / np.where(prediction.valid, prediction.distance, 1) + q
    return _kept(prediction, 1 / np.maximum(inverse, 1e-12), scale)


def _kept(prediction: DepthPrediction, distance: np.ndarray, scale: float) -> DepthPrediction:
    one = scale * prediction.distance
    kept = np.clip(distance, _NEAREST * one, one / _NEAREST).astype(np.float32)
    return replace(prediction, distance=kept, unit="map units")


def _robust(
    columns: np.ndarray, observed: ObservedDistances, first: float, camera: CameraModel, rounds: int = 20
) -> tuple[float, float]:
    """p, q for which columns (n, 2) times (p, q) are near 1, by reweighting from (first, 0)."""
    growth = growth_of(observed.mapped)
    cells = cells_of(observed.pixels, (camera.width, camera.height))
    found = np.array([first, 0.0])
    most = inlier_deviation(1 - columns @ found)
    for _ in range(rounds):
        w = point_weights(1 - columns @ found, growth, cells, most, AgreementConfig.shared_error, WIDTH)
        before, found = found, np.linalg.lstsq(columns * np.sqrt(w)[:, None], np.sqrt(w), rcond=None)[0]
        if np.abs(columns @ (found - before)).max() < 1e-4:
            break
    return float(found[0]), float(found[1])


METHODS: dict[str, Callable[[Task], Completed]] = {
    MEDIAN: lambda task: task.each(median_scale),
    LMEDS: lambda task: task.each(lmeds_scale),
    SHIFT: lambda task: task.each(scale_and_shift),
    SHIFT_INVERSE: lambda task: task.each(scale_and_shift_of_inverse),
    POISSON: lambda task: task.each(poisson_completion),
    BENDING: lambda task: task.bent(replace(task.config, agreement=replace(task.config.agreement, overlap=0.0))),
    OURS: lambda task: task.bent(task.config),
}
"""By the name of the row; all judged alike."""
