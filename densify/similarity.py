"""Similarities: the one that fits points best, for many sets at once, and the one that most correspondences agree with.

Notation: X_target = s R X_source + t. Points are (n, 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightdepth.errors import InputError


@dataclass(frozen=True)
class Similarity:
    """x -> scale · rotation x + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        result: np.ndarray = self.scale * points @ self.rotation.T + self.translation
        return result

    def __matmul__(self, first: Similarity) -> Similarity:
        """self after first."""
        moved = self.apply(first.translation[None])[0]
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, moved)

    def inverse(self) -> Similarity:
        back = self.rotation.T / self.scale
        return Similarity(1 / self.scale, self.rotation.T, -back @ self.translation)

    @classmethod
    def identity(cls) -> Similarity:
        return cls(1.0, np.eye(3), np.zeros(3))


def fit_similarity(source: np.ndarray, target: np.ndarray, with_scale: bool = True) -> Similarity:
    """The Sim(3), or SE(3), with the least squared error from source to target points (n, 3), as `umeyama` finds it.

    Raises InputError when the points cannot fix it: fewer than three, or all on a line.
    """
    if len(source) < 3:
        raise InputError("poses", f"{len(source)} in common", "expected at least 3: a similarity needs them")
    for name, points in (("map", source), ("true", target)):
        spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if spread[1] < 1e-3 * max(spread[0], 1e-300):
            raise InputError(
                f"{name} camera centres",
                "they lie on a line (or in one place): the rotation cannot be found",
                "give frames of a path that bends",
            )
    scale, rotation, translation = umeyama(source, target, with_scale=with_scale)
    return Similarity(float(scale), rotation, translation)


def umeyama(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None, with_scale: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scales (...), rotations (..., 3, 3) and translations (..., 3) with the least weighted squared error from source
    to target points (..., n, 3), weights (..., n) (Umeyama 1991). Without scale, scales are 1.

    Thousands of triples are fitted in one call, which no library of ours does. Degenerate ones give any rotation.
    """
    w = np.ones(source.shape[:-1]) if weights is None else weights
    w = (w / w.sum(-1, keepdims=True))[..., None]
    mean_s, mean_t = ((w * points).sum(-2, keepdims=True) for points in (source, target))
    s, t = source - mean_s, target - mean_t
    u, d, vt = np.linalg.svd(np.swapaxes(w * t, -1, -2) @ s)
    sign = np.ones(d.shape)
    sign[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * sign[..., None, :]) @ vt
    stretched = (d * sign).sum(-1) / (w * s**2).sum((-1, -2)).clip(min=1e-300)
    scale = stretched if with_scale else np.ones_like(stretched)
    turned = (rotation @ np.swapaxes(mean_s, -1, -2))[..., 0]
    return scale, rotation, mean_t[..., 0, :] - scale[..., None] * turned


def robust_similarity(
    source: np.ndarray,
    target: np.ndarray,
    tolerance: np.ndarray,
    rng: np.random.Generator,
    trials: int = 2000,
    scales: tuple[float, float] = (0.0, np.inf),
) -> tuple[Similarity, np.ndarray] | None:
    """The Sim(3) that most of the correspondences agree with, and which do (n,): within `tolerance` (n,), in the
    target's unit.

    Triples whose sides are in proportion are tried, `trials` of them drawn by rng; the one of the least truncated
    squared error (MSAC; Torr and Zisserman 2000) is refined on what agrees with it, by Cauchy weights. None when no
    triple, or none with a scale in the range, will do.
    """
    n = len(source)
    if n < 3:
        return None
    rows = rng.integers(0, n, (trials, 3))
    three_s, three_t = source[rows], target[rows]
    sides = [np.linalg.norm(p - np.roll(p, 1, axis=1), axis=-1) for p in (three_s, three_t)]  # (trials, 3) each
    ratio = sides[1] / np.where(sides[0] > 0, sides[0], np.inf)
    long = sides[1].min(1) > 3 * tolerance[rows].max(1)
    ratio = ratio[long]
    alike = (ratio.max(1) < 1.3 * ratio.min(1)) & (ratio.mean(1) > scales[0]) & (ratio.mean(1) < scales[1])
    scale, rotation, translation = umeyama(three_s[long][alike], three_t[long][alike])
    if not len(scale):
        return None
    best, least = None, np.inf
    judges = rng.permutation(n)[:1000]
    for part in np.array_split(np.arange(len(scale)), -(-len(scale) // 256)):
        moved = np.einsum("hij,nj->hni", rotation[part] * scale[part, None, None], source[judges])
        error = ((moved + translation[part, None] - target[judges]) ** 2).sum(-1) / tolerance[judges] ** 2
        cost = np.minimum(error, 1).mean(1)
        if cost.min() < least:
            best, least = part[cost.argmin()], cost.min()
    found = Similarity(float(scale[best]), rotation[best], translation[best])
    for _ in range(10):
        error = np.linalg.norm(found.apply(source) - target, axis=1) / tolerance
        agrees = error <= 1
        if agrees.sum() < 3:
            return None
        weights = agrees / (1 + (3 * error) ** 2) / tolerance**2
        s, r, t = umeyama(source, target, weights)
        found = Similarity(float(s), r, t)
    return found, np.linalg.norm(found.apply(source) - target, axis=1) <= tolerance
