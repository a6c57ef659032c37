"""The endoscope's own light, from frames with known depth.

Notation: d distance, cos between ray and normal, psi the ray's angle from the axis, V brightness, c one constant per
frame (its gain), E_ind light from the wall (lightdepth.radiosity; it depends on mu and the reflectance rho).

    log V = c + 1/gamma log( exp(-mu (1 - cos psi)) cos^q / d² + E_ind )

With o = log(1 + E_ind / direct) this is linear in 1/gamma, mu/gamma and q/gamma; o follows by repetition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence
from lightdepth.decline import V_FLOOR, masked_blur
from lightdepth.errors import InputError
from lightdepth.frame import Frame, FrameBatch, readable, to_batch
from lightdepth.geometry import normals_from_distance
from lightdepth.light.fit_on_map import GAMMA_RANGE, MU_RANGE, LightFit, at_bound
from lightdepth.light.views import SATURATED
from lightdepth.models import working_size
from lightdepth.photometry import DEFAULT_GAMMA, DEFAULT_MU, PhotometricCalibration, brightness
from lightdepth.radiosity import indirect_irradiance
from lightdepth.robust import mad_sigma, robust_weights

V_RANGE = (0.05, 0.75)  # darker is noise, brighter is where tone curves bend
BLUR = 0.008  # of the image height: enough against noise, too little to mix a fold with what lies behind it
EXPONENTS = (0.05, 1.6)
GAIN_NEEDED = 0.95  # a freer model must leave at most this share of the withheld residual,
RESOLUTION = 0.0002  # and this much less: below it lies rounding, not light


@dataclass(frozen=True)
class _Pixels:
    """Pixels of a frame, all (n,): place in the flattened image, log V, log distance, log cosine, 1 - cos psi."""

    batch: FrameBatch
    place: np.ndarray
    log_v: np.ndarray
    log_distance: np.ndarray
    log_cosine: np.ndarray
    off_axis: np.ndarray

    def indirect(self, mu: float, rho: float) -> np.ndarray:
        """E_ind with gain 1."""
        if rho == 0:
            return np.zeros(len(self.place))
        light = PhotometricCalibration(mu=mu, reflectance=rho).terms()
        distance = torch.where(self.batch.true_valid, self.batch.true_distance, 1.0)
        found = indirect_irradiance(distance, self.batch.rays, self.batch.true_valid, light)
        result: np.ndarray = found.flatten().numpy()[self.place].astype(float)
        return result


@dataclass(frozen=True)
class _State:
    gamma: float = DEFAULT_GAMMA
    mu: float = DEFAULT_MU
    q: float = 1.0
    rho: float = 0.0

    def light(self) -> PhotometricCalibration:
        return PhotometricCalibration(gamma=self.gamma, mu=self.mu, reflectance=self.rho, source="measured")


def fit_on_truth(frames: FrameSequence, rng: np.random.Generator | None = None, most: int = 24) -> LightFit:
    """Gamma, mu, cosine exponent and reflectance: fitted on every other frame, judged on the rest.

    Lambert's cosine and no light from the wall are left only where that makes the residual of the withheld frames
    smaller by a twentieth. Raises InputError when fewer than four frames have enough pixels of known distance.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int))
    found = [_pixels_of(frame, rng) for frame in readable(frames, chosen.tolist())]
    usable = [pixels for pixels in found if pixels is not None]
    if len(usable) < 4:
        raise InputError(
            frames.source,
            f"{counted(len(usable), 'frame')} with known distance on pixels that are neither black nor saturated",
            "expected at least 4. Without depth, give a sparse map: --map MAP",
        )
    fit, judge = usable[::2], usable[1::2]
    candidates = []
    state = _State()
    for rho in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7):
        state = _fitted(fit, _State(state.gamma, state.mu, 1.0, rho), free_cosine=False)
        candidates.append((f"reflectance {rho:.1f}", _residual(judge, state), state))
    best = min(candidates, key=lambda c: c[1])
    if best[1] > GAIN_NEEDED * candidates[0][1] - RESOLUTION:
        best = candidates[0]
    free = _fitted(fit, best[2], free_cosine=True)
    candidates.append((f"{best[0]}, cosine exponent free", _residual(judge, free), free))
    if candidates[-1][1] <= GAIN_NEEDED * best[1] - RESOLUTION:
        best = candidates[-1]
    state = best[2]
    errors = {
        "constant": _residual(judge, None),
        "default": _residual(judge, _State()),
        "fitted": best[1],
    }
    again = []
    for _ in range(30):
        drawn = [fit[i] for i in rng.integers(len(fit), size=len(fit))]
        other = _fitted(drawn, state, state.q != 1.0, rounds=1)
        again.append((other.gamma, other.mu, other.q))
    deviation = np.std(again, axis=0)
    return LightFit(
        state.light(),
        {"gamma": float(deviation[0]), "mu": float(deviation[1]), "cosine_exponent": float(deviation[2])},
        errors,
        "robust standard deviation of log V - log model on the withheld frames",
        (len(fit), len(judge)),
        sum(len(p.place) for p in fit),
        _shown(fit, state),
        at_bound(state.gamma, state.mu),
        state.q,
        tuple((name, error, s.light(), s.q) for name, error, s in candidates),
    )


def _pixels_of(frame: Frame, rng: np.random.Generator, rows: int = 128, most: int = 1500) -> _Pixels | None:
    """Unsaturated pixels of known distance, away from edges of what is known; None when there are too few."""
    if frame.true_distance is None:
        return None
    batch = to_batch(frame, working_size(frame.camera, min(rows, frame.camera.height)))
    known, v = batch.true_valid, brightness(batch.image)
    log_v = masked_blur(v.clamp(min=V_FLOOR).log(), batch.mask, BLUR * v.shape[-2])
    # Nearest samples of the truth are rough at this size: a pixel of blur makes their normals usable.
    log_distance = masked_blur(torch.where(known, batch.true_distance, 1.0).log(), known, 1.0)
    batch = batch._replace(true_distance=torch.where(known, log_distance.exp(), 0.0))
    normals = normals_from_distance(log_distance.exp(), batch.rays)
    cosine = -(normals * batch.rays).sum(1, keepdim=True)
    near_edge = F.max_pool2d((~known).float(), 5, 1, 2) > 0
    near_white = F.max_pool2d((v >= SATURATED).float(), 3, 1, 1) > 0
    use = known & ~near_edge & ~near_white & (v > V_RANGE[0]) & (v < V_RANGE[1]) & (cosine > 0.1)
    place = use.flatten().nonzero()[:, 0].numpy()
    if len(place) < 50:
        return None
    place = np.sort(rng.choice(place, min(most, len(place)), replace=False))

    def at(values: torch.Tensor) -> np.ndarray:
        result: np.ndarray = values.flatten().numpy()[place].astype(float)
        return result

    return _Pixels(batch, place, at(log_v), at(log_distance), np.log(at(cosine)), 1 - at(batch.rays[:, 2:]))


def _log_light(pixels: _Pixels, state: _State) -> tuple[np.ndarray, np.ndarray]:
    """Log direct light, and o = log(1 + E_ind / direct)."""
    direct = -state.mu * pixels.off_axis + state.q * pixels.log_cosine - 2 * pixels.log_distance
    return direct, np.log1p(pixels.indirect(state.mu, state.rho) * np.exp(-direct))


def _residuals(pixels: _Pixels, state: _State | None) -> np.ndarray:
    """log V minus the model's, freed of the frame's constant; without a state, the model is a constant."""
    r = pixels.log_v - (0.0 if state is None else sum(_log_light(pixels, state)) / state.gamma)
    return r - np.median(r)


def _residual(frames: Sequence[_Pixels], state: _State | None) -> float:
    """Standard deviation of the residuals of all pixels, from their median size."""
    return mad_sigma(np.concatenate([_residuals(p, state) for p in frames]))


def _fitted(frames: Sequence[_Pixels], state: _State, free_cosine: bool, rounds: int = 3) -> _State:
    """Huber's estimate by reweighted least squares, from `state`; its reflectance stays."""
    for _ in range(rounds if state.rho else 1):
        bounced = [_log_light(p, state)[1] for p in frames]
        for _ in range(8):
            state = _step(frames, bounced, state, free_cosine)
    return state


def _step(frames: Sequence[_Pixels], bounced: Sequence[np.ndarray], state: _State, free_cosine: bool) -> _State:
    gram, right = np.zeros((3, 3)), np.zeros(3)
    tables = [
        np.stack([o - 2 * p.log_distance, -p.off_axis, p.log_cosine], 1) for p, o in zip(frames, bounced, strict=True)
    ]
    known = np.array([1.0, state.mu, state.q]) / state.gamma
    residuals = [p.log_v - t @ known for p, t in zip(frames, tables, strict=True)]
    residuals = [r - np.median(r) for r in residuals]
    sigma = mad_sigma(np.concatenate(residuals), least=1e-6)
    for p, t, r in zip(frames, tables, residuals, strict=True):
        size = np.abs(r) / sigma
        weight = np.where(size < 4, robust_weights(size, "huber"), 0)
        t = t - weight @ t / weight.sum()
        gram += t.T @ (weight[:, None] * t)
        right += t.T @ (weight * (p.log_v - weight @ p.log_v / weight.sum()))
    # The columns times what is free: with Lambert's cosine its column rides along with the distance's.
    basis = np.eye(3) if free_cosine else np.array([[1.0, 0.0], [0.0, 1.0], [state.q, 0.0]])
    gram = basis.T @ gram @ basis
    inverse_gamma, *rest = np.linalg.solve(gram + 1e-6 * np.trace(gram) * np.eye(len(gram)), basis.T @ right)
    gamma = float(np.clip(1 / max(inverse_gamma, 1e-6), *GAMMA_RANGE))
    mu = float(np.clip(rest[0] * gamma, *MU_RANGE))
    q = float(np.clip(rest[1] * gamma, *EXPONENTS)) if free_cosine else state.q
    return _State(gamma, mu, q, state.rho)


def _shown(frames: Sequence[_Pixels], state: _State) -> np.ndarray:
    """(n, 3): log distance [mm], log V freed of everything but distance, residual of log distance."""
    parts = []
    for p in frames:
        r = _residuals(p, state)
        parts.append(np.stack([p.log_distance, r - 2 / state.gamma * p.log_distance, state.gamma / 2 * r], 1))
    return np.concatenate(parts)
