"""How far a pixel's depth is expected to be off once it is bent to the map: what decides how much of it is fused.

Notation: u predicted standard deviation of log distance; s slope, change of log distance per radian of view; r distance
over that within which 90 % of the keyframe's inliers lie. The mean |error| of log distance is taken to be

    e = .026 (u / .09)^.5 (1 + (s / 4)^2)^1.1 exp(.54 (r - 1)+),

u / .09 held within [.6, 2], and 1 where a model predicts none; the slope's factor at most e^2.2, that of r at most
e^1.6. The numbers were fitted (most likely Laplace deviates) to the bent depth of two networks at once, one that says
nearly the same u everywhere and one that does not, on four colons under maps of two kinds, at 106 000 pixels up to
r = 2.5. For either the exponent of u may be .3 to .75 at no loss; that of the light is 0 (docs/far-field.md).
"""

from __future__ import annotations

import numpy as np

from lightdepth.prediction import DepthPrediction


def expected_share(prediction: DepthPrediction, reach: float) -> np.ndarray:
    """e (H, W) float32 of a prediction in map units; `reach` is the distance within which 90 % of the keyframe's
    inliers lie. Without meaning where the prediction is invalid."""
    distance = np.where(prediction.valid, prediction.distance, 1).astype(np.float32)
    down, across = np.gradient(np.log(np.maximum(distance, np.float32(1e-12))))
    slope = np.float32(prediction.camera.focal_length / 4) * np.hypot(down, across)
    error = np.float32(0.026) * np.exp(np.float32(1.1) * np.log1p(slope**2).clip(max=2))
    error *= np.exp(np.float32(0.54) * (distance / np.float32(max(reach, 1e-12)) - 1).clip(0, 3))
    if prediction.uncertainty is not None:
        error *= np.sqrt((prediction.uncertainty / np.float32(0.09)).clip(0.6, 2)).astype(np.float32)
    result: np.ndarray = error
    return result
