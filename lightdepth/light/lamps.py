"""Where the lamps of an endoscope sit, from white paper at known places.

Notation: X a cell of white paper in camera axes [mm], n the paper's normal, psi the angle between the viewing ray and
the camera's axis, b = 1 - cos psi; lamp k at P_k [mm] with share s_k (sum 1); D the axis of all lamps,
l_k = (X - P_k) / |X - P_k|; V the code value, c one constant per frame (gain, exposure, the paper's albedo).

    log V = c + 1/gamma (log (E + a) - nu b - nu' b²)
    E     = sum_k s_k exp(-mu b_k - mu' b_k²) (n · -l_k) / |X - P_k|²,   b_k = 1 - D · l_k

nu and nu' are the lens's own darkening to the side, which stays with the camera where mu moves with the lamps; a is
light of the room and stray light, as a share of the typical E.

Objective: Tukey's biweight of what is left over, in deviations, by reweighted least squares; c is eliminated. Broad
priors keep apart what a set of poses does not tell apart: the interval, which has them in it, says how well it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lightdepth.light.board_pose import White
from lightdepth.photometry import DEFAULT_GAMMA
from lightdepth.robust import mad_sigma, robust_weights

PRIOR_MM, PRIOR_AXIS, PRIOR_MU, PRIOR_LENS, PRIOR_STRAY, PRIOR_GAMMA = 20.0, 0.2, 2.0, 1.0, 0.02, 0.15
"""Deviations; the last of 1 / gamma."""
MU_PRIOR = 2.0  # the middle of it
_FLOOR = 0.004  # deviation of log V that no averaging takes away: print, paper, pose
_TOGETHER = 10.0  # neighbouring cells share what is wrong with them: so many count as one against the priors
_ROUNDS = 3
_MOST_CELLS = 100  # of a frame: more say the same


@dataclass(frozen=True)
class Lamps:
    """Lamps of one kind: places (k, 3) [mm], shares (k,), axis (3,) unit, mu, gamma; `edge` is mu', `lens` (nu, nu'),
    `stray` a."""

    places: np.ndarray
    shares: np.ndarray
    axis: np.ndarray
    mu: float
    gamma: float
    edge: float = 0.0
    lens: tuple[float, float] = (0.0, 0.0)
    stray: float = 0.0

    @property
    def middle(self) -> np.ndarray:
        """(3,) the one lamp that is nearest to all of them: their mean, weighted by their shares."""
        found: np.ndarray = self.shares @ self.places
        return found

    def log_light(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """log of the light on paper at places (n, 3) with normals (n, 3)."""
        from_lamp = places[:, None] - self.places
        reach = np.linalg.norm(from_lamp, axis=-1)
        cosine = -np.einsum("nkj,nj->nk", from_lamp, normals) / reach
        off_axis = 1 - from_lamp @ self.axis / reach
        spread = np.exp(-self.mu * off_axis - self.edge * off_axis**2)
        light = (self.shares * spread * np.maximum(cosine, 1e-3) / reach**2).sum(-1)
        light = light + self.stray * float(np.median(light))
        aside = 1 - places[:, 2] / np.linalg.norm(places, axis=-1)
        darker = self.lens[0] * aside + self.lens[1] * aside**2
        found: np.ndarray = np.log(np.maximum(light, 1e-12)) - darker
        return found


@dataclass(frozen=True)
class Samples:
    """All frames' cells in one: see `White`. `frame` (n,) is the number of each one's frame."""

    places: np.ndarray
    normals: np.ndarray
    log_v: np.ndarray
    noise: np.ndarray
    frame: np.ndarray

    @classmethod
    def of(cls, every: Sequence[White]) -> Samples:
        whites = [white.thinned(_MOST_CELLS) for white in every]
        return cls(
            np.concatenate([white.places for white in whites]),
            np.concatenate([np.tile(white.pose.normal, (len(white), 1)) for white in whites]),
            np.concatenate([white.log_v for white in whites]),
            np.hypot(np.concatenate([white.noise for white in whites]), _FLOOR),
            np.repeat(np.arange(len(whites)), [len(white) for white in whites]),
        )

    def centred(self, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Values (n,) without the weighted mean of each one's frame."""
        count = int(self.frame.max()) + 1
        mass = np.maximum(np.bincount(self.frame, weights, count), 1e-12)
        found: np.ndarray = values - (np.bincount(self.frame, weights * values, count) / mass)[self.frame]
        return found

    def residuals(self, lamps: Lamps, weights: np.ndarray) -> np.ndarray:
        """What is left of log V (n,), in deviations."""
        left = self.log_v - lamps.log_light(self.places, self.normals) / lamps.gamma
        found: np.ndarray = self.centred(left, weights / self.noise**2) / self.noise
        return found


@dataclass(frozen=True)
class Unknowns:
    """What is sought: so many lamps, their axis or the camera's, gamma or the given one."""

    lamps: int = 1
    axis: bool = True
    gamma: float | None = None

    def lamps_of(self, x: np.ndarray) -> Lamps:
        k = self.lamps
        shares = np.exp(np.concatenate([[0.0], x[3 * k : 4 * k - 1]]))
        rest = x[4 * k - 1 :]
        mu, edge, rest = float(rest[0]), float(rest[1]), rest[2:]
        tilt, rest = (rest[:2], rest[2:]) if self.axis else ((0.0, 0.0), rest)
        lens, stray, rest = rest[:2], rest[2], rest[3:]
        axis = np.array([*tilt, 1.0]) / np.linalg.norm([*tilt, 1.0])
        gamma = self.gamma or 1 / max(float(rest[0]), 0.05)
        places, beside = x[: 3 * k].reshape(k, 3), (float(lens[0]), float(lens[1]))
        return Lamps(places, shares / shares.sum(), axis, mu, gamma, edge, beside, float(stray))

    def start(self, places: np.ndarray) -> np.ndarray:
        free = [
            *[0.0] * (4 + 2 * self.axis),
            *([1 / DEFAULT_GAMMA] * (self.gamma is None)),
        ]
        return np.concatenate([places.ravel(), np.zeros(self.lamps - 1), [MU_PRIOR], free])

    def prior(self, x: np.ndarray) -> np.ndarray:
        """How far unknowns are from what is expected, in deviations."""
        k, start = self.lamps, self.start(np.zeros((self.lamps, 3)))
        wide = [*[PRIOR_MM] * 3 * k, *[1.0] * (k - 1), PRIOR_MU, PRIOR_LENS, *[PRIOR_AXIS] * 2 * self.axis]
        wide += [PRIOR_LENS, PRIOR_LENS, PRIOR_STRAY]
        found: np.ndarray = (x - start) / np.array([*wide, *[PRIOR_GAMMA] * (self.gamma is None)])
        return found


@dataclass(frozen=True)
class Fit:
    """The best lamps; x their unknowns, `sigma` what is left over, in deviations, and `deviation` (3,) [mm] of the
    lamps' middle as the curvature of the cost has it. `weights` are those of the cells,
    `jacobian` that of what is left over and, below, of the priors."""

    lamps: Lamps
    x: np.ndarray
    sigma: float
    deviation: np.ndarray
    weights: np.ndarray
    jacobian: np.ndarray


def fit_lamps(samples: Samples, unknowns: Unknowns, times: np.ndarray | None = None, start: Fit | None = None) -> Fit:
    """The lamps that explain the paper best. `times` (frames,) is how often each frame counts; with the `start` of an
    earlier fit it goes on from there."""
    counted = np.ones(len(samples.log_v)) if times is None else times[samples.frame].astype(float)
    if start is None:
        even = np.ones(len(counted))
        begun = [unknowns.start(places) for places in _starts(unknowns.lamps)]
        start = min((_from(samples, unknowns, counted, x, even, 1, 80) for x in begun), key=lambda fit: fit.sigma)
        return _from(samples, unknowns, counted, start.x, start.weights, _ROUNDS)
    return _from(samples, unknowns, counted, start.x, start.weights, 1)


def _starts(lamps: int) -> list[np.ndarray]:
    """Places to begin at: lamps around the lens."""
    if lamps == 1:
        return [np.zeros((1, 3))]
    found = []
    for turn in np.linspace(0, np.pi, 4, endpoint=False) if lamps == 2 else (0.0, np.pi / 3):
        angles = turn + 2 * np.pi * np.arange(lamps) / lamps
        found.append(2.5 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1))
    return found


def _from(
    samples: Samples,
    unknowns: Unknowns,
    counted: np.ndarray,
    x: np.ndarray,
    weights: np.ndarray,
    rounds: int,
    most: int = 250,
) -> Fit:
    sigma, solved = 1.0, None
    for _ in range(rounds):
        use = counted * weights
        root = np.sqrt(use)

        def left(x: np.ndarray, use: np.ndarray = use, root: np.ndarray = root, sigma: float = sigma) -> np.ndarray:
            pull = unknowns.prior(x) * np.sqrt(_TOGETHER)
            return np.concatenate([root * samples.residuals(unknowns.lamps_of(x), use) / sigma, pull])

        solved = least_squares(left, x, method="lm", x_scale="jac", max_nfev=most, xtol=1e-5, ftol=1e-6)
        x = solved.x
        residuals = samples.residuals(unknowns.lamps_of(x), use)
        sigma = mad_sigma(np.repeat(residuals, counted.astype(int)), least=0.3)
        weights = robust_weights(residuals / sigma, "tukey")
    assert solved is not None
    lamps = unknowns.lamps_of(x)
    return Fit(lamps, x, sigma, _deviation(solved.jac, x, unknowns), weights, solved.jac)


def _deviation(jacobian: np.ndarray, x: np.ndarray, unknowns: Unknowns) -> np.ndarray:
    """Of the lamps' middle (3,), mm."""
    covariance = np.linalg.pinv(jacobian.T @ jacobian / _TOGETHER)
    step = 1e-5
    middle = unknowns.lamps_of(x).middle
    slopes = np.stack([(unknowns.lamps_of(x + step * e).middle - middle) / step for e in np.eye(len(x))], -1)
    found: np.ndarray = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    return found


def drawn(samples: Samples, unknowns: Unknowns, fit: Fit, rng: np.random.Generator, draws: int) -> np.ndarray:
    """Middles of the lamps (draws, 3), of frames drawn anew each time.

    Each is one Gauss-Newton step from the fit: as every frame has a constant of its own, the normal equations are sums
    over frames.
    """
    frames, n = int(samples.frame.max()) + 1, len(fit.x)
    of_prior, root = fit.jacobian[len(samples.log_v) :], np.sqrt(fit.weights)
    slopes = fit.jacobian[: len(samples.log_v)]
    left = root * samples.residuals(unknowns.lamps_of(fit.x), fit.weights) / fit.sigma
    square, pull = np.zeros((frames, n, n)), np.zeros((frames, n))
    for i in range(frames):
        rows = samples.frame == i
        square[i], pull[i] = slopes[rows].T @ slopes[rows], slopes[rows].T @ left[rows]
    prior = of_prior.T @ of_prior
    found: list[np.ndarray] = []
    while len(found) < draws:
        times = rng.multinomial(frames, np.full(frames, 1 / frames))
        if (times > 0).sum() >= min(4, frames):
            curved = np.tensordot(times, square, 1) + prior
            step = np.linalg.lstsq(curved, (times - 1) @ pull, rcond=None)[0]  # all frames once pull to nowhere
            found.append(unknowns.lamps_of(fit.x - step).middle)
    return np.array(found)


def withheld(samples: Samples, unknowns: Unknowns, fit: Fit, folds: int = 4) -> float:
    """Median size of what is left over of frames that were kept from the fit, in deviations."""
    frames = np.arange(int(samples.frame.max()) + 1)
    left: list[np.ndarray] = []
    for fold in range(min(folds, len(frames))):
        kept = frames % folds != fold
        lamps = fit_lamps(samples, unknowns, kept.astype(int), fit).lamps
        hidden = ~kept[samples.frame]
        left.append(np.abs(samples.residuals(lamps, np.ones(len(hidden)))[hidden]))
    return float(np.median(np.concatenate(left)))
