"""A depth map bent by a smooth field: the network's errors are smooth, and a map knows more than one number about them.

Notation: b predicted distance, x pixel over the image's size, in [0, 1]²; d = b exp(f) the bent distance, with

    f(x, b) = phi(x, b)' w,   phi = (1, log b - log b0, g_i(x), h_k(b), h_k(b) c_j(x)),

b0 the median predicted distance of the keyframe; g and c Gaussian bumps on regular grids over the image, as wide as the
step of their grid, less their mean over the image; h Gaussian bumps over log b, the layers, a step `reach` apart about
log b0. So near and far wall in one part of the image are bent each by its own points, and far from all points in log
distance the field returns to w[0], the log of the keyframe's scale, and the slope. All but w[0] are pulled to 0 by a
ridge, each with the deviation that its part of the field is expected to have. A field is as smooth as its finest grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

import numpy as np

from lightdepth.brief import Brief
from lightdepth.errors import InputError
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import above, at_least, checked

_LEAST = 1e-6  # deviation: one that is smaller still bends nothing either, and its square leaves double precision


@dataclass(frozen=True)
@checked
class BendingConfig:
    """How a keyframe's depth may bend. Off, it is scaled only."""

    on: bool = True
    """Whether a keyframe's depth is multiplied by a smooth field over the image, its bend, so that it fits the map's
    points; switched off, it is multiplied by one number."""
    grids: Annotated[tuple[int, ...], at_least(2, up_to=64)] = (5,)
    """Number n of smooth bumps across and down the image that make up the bend, n x n of them, at least 2; several
    numbers lay several such grids over each other. More let depth bend in finer detail."""
    finer: Annotated[int, at_least(0, up_to=64)] = 9
    """Number n of bumps across and down, n x n, of one more grid, at least 2. The bends of a submap use it as far as
    the images confirm what it adds (judge.parallax). So a map whose points are right bends depth in finer detail than
    one whose points err together. More follow points more closely and take longer; 0 leaves the grid out, and live
    always does."""
    slope_deviation: Annotated[float, at_least(0)] = 0.25
    """How strongly the factor on distance is expected to change with distance itself (standard deviation, a ratio:
    change of the factor's log per change of the log of predicted distance), in addition to its change over the image; a
    soft limit, 0 for no such change. A larger one lets near wall be stretched against far wall more freely."""
    bump_deviation: Annotated[float, at_least(_LEAST)] = 0.1
    """Expected size (standard deviation) of each bump of the bend, in log distance (0.1 is 10 %). A larger one
    lets depth bend more strongly."""

    layers: Annotated[int, at_least(0, up_to=64)] = 7
    """Number of smooth bumps over log distance, `reach` apart, around a keyframe's median predicted distance, that the
    bend has besides those over the image: near wall and far wall each bend by their own points. More cover nearer and
    farther wall; 0 leaves them out."""
    columns: Annotated[int, at_least(0, up_to=64)] = 3
    """Number n of bumps across and down the image, n x n, that each layer has of its own, so that what is near and what
    is far in one part of the image bend apart. More bend in finer detail and take longer; 0 leaves them out."""
    reach: Annotated[float, above(0)] = 0.35
    """Step, in log distance (0.35 is a factor of 1.4), from layer to layer, and how far, in distance, wall has to be
    from points to keep the network's own shape. A larger one makes a smoother bend, which reaches farther from
    points."""
    layer_deviation: Annotated[float, at_least(_LEAST)] = 0.1
    """Expected size (standard deviation) of each bump of a layer, in log distance (0.1 is 10 %). A larger one lets near
    wall bend more strongly against far wall."""

    def __post_init__(self) -> None:
        if self.finer == 1:
            raise InputError("the bend's finer grid", "1 bump", "expected 0, for none, or 2 and more across the image")

    def with_finer(self) -> BendingConfig:
        """The same with the finer grid among the others."""
        return replace(self, grids=(*self.grids, self.finer), finer=0)

    @property
    def precision(self) -> np.ndarray:
        """Prior precision of each weight (m,); 0 for the scale, which has no prior."""
        if not self.on:
            return np.zeros(1)
        slope = [max(self.slope_deviation, _LEAST) ** -2] if self.slope_deviation else []
        bumps = [np.full(n * n, self.bump_deviation**-2) for n in self.grids]
        layers = np.full(self.layers * (1 + self.columns**2), self.layer_deviation**-2)
        return np.concatenate([[0.0], slope, *bumps, layers])


@dataclass(frozen=True, repr=False)
class Bend(Brief):
    """The field of one keyframe: `weights` w (m,), `log_middle` log b0, image_size (width, height)."""

    config: BendingConfig
    log_middle: float
    weights: np.ndarray
    image_size: tuple[int, int]
    log_range: tuple[float, float] = (-np.inf, np.inf)
    """least and largest log predicted distance that points speak for; the slope goes no further"""

    def with_finer(self) -> Bend:
        """The same field, with the finer grid among its bumps, which adds nothing yet."""
        before = len(self.weights) - self._in_layers
        more = np.zeros(self.config.finer**2 if self.config.on else 0)
        weights = np.insert(self.weights, before, more)
        return replace(self, config=self.config.with_finer(), weights=weights)

    @property
    def scale(self) -> float:
        """Map units per predicted unit at the median distance, in the mean over the image."""
        if not self.config.on:
            return float(np.exp(self.weights[0]))
        middle, first = np.array([self.log_middle]), len(self.weights) - self._in_layers
        layers = [self.weights[first + k] * self._layer(middle, k)[0] for k in range(self.config.layers)]
        return float(np.exp(self.weights[0] + sum(layers)))

    @property
    def _in_layers(self) -> int:
        """How many of the weights, the last ones, are those of layers."""
        return self.config.layers * (1 + self.config.columns**2) if self.config.on else 0

    def basis(self, x: np.ndarray, log_distance: np.ndarray) -> np.ndarray:
        """phi (n, m) at x (n, 2) in [0, 1]² and log predicted distance (n,)."""
        parts = [np.ones((len(x), 1))]
        if not self.config.on:
            return parts[0]
        if self.config.slope_deviation:
            parts.append((np.clip(log_distance, *self.log_range) - self.log_middle)[:, None])
        for n in self.config.grids:
            across, down, mean = _bumps(x[:, 0], n), _bumps(x[:, 1], n), _mean(n)
            parts.append((down[:, :, None] * across[:, None, :] - np.outer(mean, mean)).reshape(len(x), n * n))
        count, n = self.config.layers, self.config.columns
        if count:
            layers = np.stack([self._layer(log_distance, k) for k in range(count)], 1)
            across, down, mean = _bumps(x[:, 0], n), _bumps(x[:, 1], n), _mean(n)
            own = (down[:, :, None] * across[:, None, :] - np.outer(mean, mean)).reshape(len(x), 1, n * n)
            parts += [layers, (layers[:, :, None] * own).reshape(len(x), count * n * n)]
        return np.concatenate(parts, 1)

    def along(self, x: np.ndarray, log_distance: np.ndarray) -> np.ndarray:
        """f (n,) at x (n, 2) in [0, 1]² and log predicted distance (n,): basis(...) @ weights, without the matrix."""
        value = np.full(len(x), self.weights[0])
        if not self.config.on:
            return value
        used = 1
        if self.config.slope_deviation:
            value += self.weights[1] * (np.clip(log_distance, *self.log_range) - self.log_middle)
            used = 2
        for n in self.config.grids:
            value += _on_grid(x, self.weights[used : used + n * n].reshape(1, n, n))[0]
            used += n * n
        count, n = self.config.layers, self.config.columns
        if count:
            own = _on_grid(x, self.weights[used + count :].reshape(count, n, n))
            for k in range(count):
                value += self._layer(log_distance, k) * (self.weights[used + k] + own[k])
        return value

    def _layer(self, log_distance: np.ndarray, k: int) -> np.ndarray:
        """The bump of layer k at log distances, of their shape and precision."""
        middle = self.log_middle + (k - (self.config.layers - 1) / 2) * self.config.reach
        dtype = log_distance.dtype.type
        result: np.ndarray = np.exp(dtype(-0.5) * ((log_distance - dtype(middle)) / dtype(self.config.reach)) ** 2)
        return result

    def at(self, pixels: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """f (n,) at pixels (n, 2) with predicted distance (n,)."""
        return self.along(pixels / self.image_size, np.log(predicted))

    def field(self, log_distance: np.ndarray) -> np.ndarray:
        """f (H, W) over an image of log predicted distances (H, W)."""
        height, width = log_distance.shape
        field, used = np.full(log_distance.shape, self.weights[0], np.float32), 1
        if not self.config.on:
            return field
        if self.config.slope_deviation:
            low, high = self.log_range
            within = np.clip(log_distance, np.float32(low), np.float32(high))
            field += np.float32(self.weights[1]) * (within - np.float32(self.log_middle))
            used = 2
        for n in self.config.grids:
            down = _bumps((np.arange(height) + 0.5) / height, n)
            across = _bumps((np.arange(width) + 0.5) / width, n)
            weights = self.weights[used : used + n * n].reshape(n, n)
            field += (down @ weights @ across.T - _mean(n) @ weights @ _mean(n)).astype(np.float32)
            used += n * n
        count, n = self.config.layers, self.config.columns
        down, across = (_bumps((np.arange(size) + 0.5) / size, n) for size in (height, width))
        own = self.weights[used + count :].reshape(count, n, n)
        for k in range(count):
            total = down @ own[k] @ across.T - _mean(n) @ own[k] @ _mean(n) + self.weights[used + k]
            field += self._layer(log_distance, k) * total.astype(np.float32)
        return field

    def applied(self, prediction: DepthPrediction) -> DepthPrediction:
        """The bent prediction, in map units."""
        log_distance = np.log(np.where(prediction.valid, prediction.distance, 1)).astype(np.float32)
        return replace(prediction, distance=np.exp(log_distance + self.field(log_distance)), unit="map units")


def _on_grid(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Bumps at x (n, 2), less their means, weighted in several ways (k, rows, columns): (k, n)."""
    n = weights.shape[1]
    across, down, mean = _bumps(x[:, 0], n), _bumps(x[:, 1], n), _mean(n)
    result: np.ndarray = ((down @ weights) * across).sum(-1) - (mean @ weights @ mean)[:, None]
    return result


def _bumps(x: np.ndarray, n: int) -> np.ndarray:
    """Gaussians (len(x), n) centred at n places from 0 to 1, as wide as their step."""
    result: np.ndarray = np.exp(-0.5 * ((x[:, None] - _places(n)) * (n - 1)) ** 2)
    return result


@lru_cache(maxsize=64)
def _places(n: int) -> np.ndarray:
    """n places from 0 to 1 (n,), not to be written to: thousands of short calls ask for the same."""
    places = np.linspace(0, 1, n)
    places.flags.writeable = False
    return places


@lru_cache(maxsize=8)
def _mean(n: int) -> np.ndarray:
    """Of each bump (n,) over [0, 1]."""
    result: np.ndarray = _bumps((np.arange(256) + 0.5) / 256, n).mean(0)
    return result
