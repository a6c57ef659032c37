"""Completion in the gradient domain: the depth whose gradients are the prediction's and which is pulled to the points.

Notation: l the log of a keyframe's predicted distance on a grid of cells, u the log of the completed one, f = u - l;
a_k the mapped distance of point k at x_k; s the keyframe's LMedS scale. f minimises

    sum_pq (f_p - f_q)² / gradient²          neighbouring cells: the gradients of u are those of l
    + sum_k w_k (log a_k - l(x_k) - f(x_k))²  points, f bilinear between the middles of cells
    + sum_p (f_p - log s)² / pull²            the screen

a screened Poisson equation (Bhat et al. 2008; Pérez et al. 2003 without the screen), which ends at the image's border
by itself. Wrong points are told as for the bends of densify.agreement: Geman-McClure, the deviation from the residuals'
lower quartile and never above that at the LMedS scale, points of one part of the image sharing an error. Solved anew in
every round with new weights w, by a sparse factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from densify.agreement import AgreementConfig, cells_of, growth_of, inlier_deviation, point_weights
from lightdepth.observations import ObservedDistances
from lightdepth.prediction import DepthPrediction


@dataclass(frozen=True)
class PoissonConfig:
    """How strongly the prediction's shape and the keyframe's scale hold against the points."""

    gradient: float = 0.5
    """Deviation of the difference of f between neighbouring cells. A larger one follows the points more closely."""
    pull: float = 10.0
    """Deviation of f from the LMedS scale, in log distance. A larger one lets it go farther where no point is."""
    columns: int = 40
    """Cells across the image, and as many down as keeps them square."""
    shared_error: float = AgreementConfig.shared_error
    """As for agreement: error in log distance that points in one part of the image have in common."""
    rounds: int = AgreementConfig.rounds
    """Largest number of rounds."""
    tolerance: float = AgreementConfig.tolerance
    """Change of f below which a round is the last."""


POISSON = PoissonConfig()
"""The best on densify.bench.completion.scenes.TUNING_SEEDS, by the mean log of AbsRel, RMSE and median error over both
kinds of wrong points: of gradients .003 to 1, pulls .1 to 10, and 40 or 80 columns, not every combination."""


def poisson_completion(
    prediction: DepthPrediction, observed: ObservedDistances, scale: float, config: PoissonConfig = POISSON
) -> DepthPrediction:
    """The prediction in map units, completed from its points; `scale` is its LMedS scale."""
    height, width = prediction.distance.shape
    columns = min(config.columns, width)
    shape = max(2, round(columns * height / width)), columns
    weights = _interpolation(observed.pixels / (width, height), shape)
    wanted = np.log(observed.mapped / observed.predicted)
    growth, cells = growth_of(observed.mapped), cells_of(observed.pixels, (width, height))
    smooth = _gradients(shape) / config.gradient**2 + sparse.identity(shape[0] * shape[1]) / config.pull**2
    level = float(np.log(scale))
    f = np.full(shape[0] * shape[1], level)
    most = inlier_deviation(wanted - level)
    for _ in range(config.rounds):
        w = point_weights(wanted - weights @ f, growth, cells, most, config.shared_error)
        matrix = (smooth + weights.T @ sparse.diags(w) @ weights).tocsc()
        before, f = f, level + spsolve(matrix, weights.T @ (w * (wanted - level)))
        if np.abs(f - before).max() < config.tolerance:
            break
    field = cv2.resize(f.reshape(shape).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    distance = np.where(prediction.valid, prediction.distance * np.exp(field), prediction.distance)
    return replace(prediction, distance=distance.astype(np.float32), unit="map units")


def _gradients(shape: tuple[int, int]) -> sparse.csc_matrix:
    """D'D (n, n), D taking the differences between neighbouring cells of a grid (h, w), n = h w."""
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    second = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    rows, ones = np.arange(len(first)), np.ones(len(first))
    triplets = np.concatenate([ones, -ones]), (np.concatenate([rows, rows]), np.concatenate([first, second]))
    d = sparse.csc_matrix(triplets, shape=(len(first), index.size))
    return d.T @ d


def _interpolation(x: np.ndarray, shape: tuple[int, int]) -> sparse.csc_matrix:
    """(points, cells): the weights of the four cells around x (points, 2) in [0, 1]²; at the border of the image the
    nearest cells."""
    height, width = shape
    place = np.clip(x * (width, height) - 0.5, 0, (width - 1, height - 1))
    low = np.minimum(place.astype(int), (width - 2, height - 2))
    part = place - low
    rows, columns, values = [], [], []
    for dx in (0, 1):
        for dy in (0, 1):
            rows.append(np.arange(len(x)))
            columns.append((low[:, 1] + dy) * width + low[:, 0] + dx)
            values.append(np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1]))
    triplets = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csc_matrix(triplets, shape=(len(x), height * width))
