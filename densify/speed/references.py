"""What stages are measured against: the same with plain calls of a library, as one would write it first or tune it."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from lightdepth.robust import median_rank


def lmeds_by_partition(mapped: np.ndarray, predicted: np.ndarray) -> float:
    """The least lower median of |mapped - s predicted| over all n proposals s, one by one: the objective of
    lightdepth.robust.lmeds_scale, tuned as far as O(n²) goes: buffers are made once."""
    rank, best = median_rank(len(mapped)), np.inf
    residuals = np.empty_like(mapped)
    for scale in mapped / predicted:
        np.multiply(predicted, scale, out=residuals)
        np.subtract(mapped, residuals, out=residuals)
        np.abs(residuals, out=residuals)
        residuals.partition(rank)
        best = min(best, residuals[rank])
    return float(best)


@cache
def _equations(rows: int, unknowns: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(rows, unknowns)), rng.normal(size=rows)


def normal_equations(parts: tuple[tuple[int, int], ...], together: int, times: int = 1) -> None:
    """Products J' J and J' r of matrices of so many (rows, unknowns), then one solution for all unknowns together, by
    BLAS and LAPACK alone; all of it so many times."""
    for _ in range(times):
        for rows, unknowns in parts:
            jacobian, residual = _equations(rows, unknowns)
            _ = jacobian.T @ jacobian, jacobian.T @ residual
        cho_solve(cho_factor(_spread(together), lower=True, check_finite=False), np.ones(together), check_finite=False)


@cache
def _spread(unknowns: int) -> np.ndarray:
    return np.eye(unknowns) + 0.1 / unknowns


def exponentials(shape: tuple[int, int], count: int) -> None:
    """So many np.exp of an image of that shape."""
    values = np.zeros(shape, np.float32)
    for _ in range(count):
        np.exp(values)


@cache
def _places(count: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    across = min(count, 2**14)
    at = rng.uniform(0, 1, (2, -(-count // across), across)).astype(np.float32)
    return at[0] * (shape[1] - 1), at[1] * (shape[0] - 1)


def remapped(image: np.ndarray, count: int) -> None:
    """So many bilinear values of an image (h, w) at random places, by cv2.remap."""
    cv2.remap(image, *_places(count, image.shape[:2]), cv2.INTER_LINEAR)


def plane_by_gradients(distance: np.ndarray, rays: np.ndarray) -> None:
    """Normals (H, W, 3) of a surface by NumPy's gradients and product of vectors."""
    points = distance[..., None] * rays
    np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))


def three_errors(predicted: np.ndarray, true: np.ndarray, known: np.ndarray) -> tuple[float, float, float]:
    """AbsRel, RMSE and median error after the median scale, in plain NumPy."""
    p, q = predicted[known], true[known]
    error = np.abs(p * np.median(q / p) - q)
    return float((error / q).mean()), float(np.sqrt((error**2).mean())), float(np.median(error))


def nearest(vertices: np.ndarray, tree: cKDTree, true: np.ndarray) -> None:
    """The closest true point of every vertex, and back, by SciPy's trees on one thread."""
    tree.query(vertices)
    cKDTree(vertices).query(true)
