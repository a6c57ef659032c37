"""How far a pixel's depth is expected to be off once it is bent to the map: what decides how much of it is fused.

Notation: u predicted standard deviation of log distance; s slope, change of log distance per radian of view; r distance
over that within which 90 % of the keyframe's inliers lie. The mean |error| of log distance is taken to be

    e = .04 (u / .09)^.5 (1 + (s / 4)^2)^.56 exp(.22 (r - 1)+) l,   l = 1.08 where it is dark or clipped, else 1,

u / .09 held within [.6, 2], and 1 where a model predicts none. The numbers were fitted (most likely Laplace deviates)
to the bent depth of one network on six colons, at 128 000 pixels up to r = 2.5; but for the power of u, which two
networks decided, as that one says nearly the same u everywhere (docs/far-field.md).
"""

from __future__ import annotations

import numpy as np

from lightdepth.frame import brightest
from lightdepth.prediction import DepthPrediction

_DARK, _BRIGHT = 0.3, 0.98  # of the brightest channel


def expected_share(prediction: DepthPrediction, reach: float, image: np.ndarray) -> np.ndarray:
    """e (H, W) float32 of a prediction in map units with its image (H, W, 3); `reach` is the distance within which 90 %
    of the keyframe's inliers lie. Without meaning where the prediction is invalid."""
    distance = np.where(prediction.valid, prediction.distance, 1).astype(np.float32)
    down, across = np.gradient(np.log(np.maximum(distance, np.float32(1e-12))))
    slope = np.float32(prediction.camera.focal_length / 4) * np.hypot(down, across)
    error = np.float32(0.04) * (1 + slope**2) ** np.float32(0.56)
    error *= np.exp(np.float32(0.22) * (distance / np.float32(max(reach, 1e-12)) - 1).clip(0, 9))
    if prediction.uncertainty is not None:
        error *= (prediction.uncertainty / np.float32(0.09)).clip(0.6, 2).astype(np.float32) ** np.float32(0.5)
    light = brightest(image)
    result: np.ndarray = np.where((light < _DARK) | (light >= _BRIGHT), np.float32(1.08), np.float32(1)) * error
    return result
