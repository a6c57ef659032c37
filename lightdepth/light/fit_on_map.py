"""The light of an endoscope that nobody measured, found from a sparse map of what it lit.

Notation: a distance of a map point from its keyframe (one scale per submap), V brightness, blurred as the closed form
blurs it, psi the angle of its ray from the axis, c one constant per keyframe (exposure and scale). The closed form

    log a = c - gamma/2 log V - mu/2 (1 - cos psi)

is linear in gamma and mu. A map knows no normals, so every wall is taken as facing. What is found is the light with
which the closed form errs least, not the endoscope's own: in a tube, where far walls are seen at a grazing angle, its
gamma is the smaller one, by a third in the ideal case (cos ~ 1/a makes V^gamma ~ a^-3), and light from wall to wall
makes it larger. lightdepth.light.fit_on_truth finds the endoscope's own, from frames with known depth.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.decline import BLUR, V_FLOOR, masked_blur
from lightdepth.errors import InputError
from lightdepth.frame import Frame, check_image_size, to_batch
from lightdepth.models import ConstantModel, DeclineModel, working_size
from lightdepth.observations import observed_distances
from lightdepth.photometry import DEFAULT_GAMMA, DEFAULT_MU, PhotometricCalibration, brightness
from lightdepth.prediction import DepthPrediction
from lightdepth.reporting.run import Run, plain
from lightdepth.robust import lmeds_scale, mad_sigma, robust_weights
from lightdepth.sparse_map import Keyframe, SparseMap, Submap

Model = Callable[[Frame], DepthPrediction]

SATURATED = 0.97
GAMMAS, MUS = np.arange(0.6, 4.01, 0.2), np.arange(0.0, 6.01, 0.5)
GAMMA_RANGE, MU_RANGE = (0.5, 5.0), (0.0, 10.0)
PRIOR_GAMMA, PRIOR_MU = 0.6, 2.0  # deviations from the defaults that nobody would be surprised at
POINTS_PER_WITNESS = 50.0  # neighbouring points share texture and slant: so many count as one against the prior


@dataclass(frozen=True)
class LightSamples:
    """Points of one keyframe whose brightness says something: log distance, log V and 1 - cos psi, (n,) each."""

    name: str
    log_distance: np.ndarray
    log_v: np.ndarray
    off_axis: np.ndarray

    def __len__(self) -> int:
        return len(self.log_distance)


@dataclass(frozen=True)
class LightFit:
    """A fitted light and what keyframes that took no part in the fit say about it.

    `errors` of constant, default and fitted on the withheld keyframes, in the words of `measure`; `light` is the
    fitted one where it is better than the default there, else the default. `uncertainty` holds standard deviations
    (bootstrap over keyframes), `points` the number fitted, `shown` (n, 3) what a plot needs: log distance, log V freed
    of everything but distance, residual of log distance. `cosine_exponent` and `candidates` (name, error on withheld
    frames, calibration, exponent) where normals were known.
    """

    fitted: PhotometricCalibration
    uncertainty: dict[str, float]
    errors: dict[str, float]
    measure: str
    keyframes: tuple[int, int]
    points: int
    shown: np.ndarray
    cosine_exponent: float | None = None
    candidates: tuple[tuple[str, float, PhotometricCalibration, float], ...] = ()

    @property
    def better(self) -> bool:
        return self.errors["fitted"] < self.errors["default"]

    @property
    def light(self) -> PhotometricCalibration:
        return self.fitted if self.better else PhotometricCalibration()

    def summary(self) -> str:
        e = self.errors
        text = (
            f"gamma {self.fitted.gamma:.2f} ± {self.uncertainty['gamma']:.2f}, mu {self.fitted.mu:.2f} ± "
            f"{self.uncertainty['mu']:.2f}; withheld keyframes {e['fitted']:.1%} against {e['default']:.1%} with the "
            f"defaults, {e['constant']:.1%} with a constant"
        )
        return text if self.better else f"{text}: not better, so the defaults (gamma 2.2, mu 2.767) are kept"


@dataclass(frozen=True)
class LightView:
    """A keyframe with its image, both reduced to few rows."""

    submap: Submap
    keyframe: Keyframe
    frame: Frame


def map_views(
    frames: FrameSequence, sparse_map: SparseMap, camera: CameraModel | None = None, most: int = 32, rows: int = 256
) -> list[LightView]:
    """Keyframes, evenly chosen among those with an image, `most` in all; `camera` replaces the map's."""
    numbers = set(frames.numbers)
    having = [(s, k) for s in sparse_map.submaps for k in s.keyframes if k.number in numbers]
    chosen = np.unique(np.linspace(0, len(having) - 1, min(most, len(having))).round().astype(int))
    views = []
    for submap, keyframe in (having[i] for i in chosen):
        try:
            frame = frames.by_number(keyframe.number)
        except InputError:
            continue  # an unreadable image is reported where every frame is needed
        if frame is not None:
            views.append(_reduced(submap, keyframe, frame, camera or keyframe.camera, rows))
    return views


def _reduced(submap: Submap, keyframe: Keyframe, frame: Frame, camera: CameraModel, rows: int) -> LightView:
    height, width = frame.image.shape[:2]
    if abs(width / camera.width / (height / camera.height) - 1) > 0.01:
        check_image_size(frame.name, width, height, camera)
    size = working_size(camera, min(rows, height))
    small = camera if size == (camera.width, camera.height) else camera.resized(*size)
    image, mask = frame.image, frame.mask
    if size != (width, height):
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if mask is not None:
            mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    scale = (size[0] / keyframe.camera.width, size[1] / keyframe.camera.height)
    moved = replace(keyframe, camera=small, pixels=keyframe.pixels * scale)
    return LightView(submap, moved, Frame(frame.name, image, small, frame.light, mask))


def samples_of(view: LightView, most: int = 800) -> LightSamples:
    """Brightness at the projections of the points that a keyframe observed; saturated and black pixels are left out."""
    frame, keyframe = view.frame, view.keyframe
    batch = to_batch(frame)
    v = brightness(batch.image)
    log_v = masked_blur(v.clamp(min=V_FLOOR).log(), batch.mask, BLUR * v.shape[-2])[0, 0].numpy()
    usable = (batch.mask & (v > V_FLOOR) & (v < SATURATED))[0, 0].numpy()
    in_camera = keyframe.in_camera(view.submap.observed_points(keyframe)[1])
    pixels, seen = keyframe.camera.project(in_camera)
    distance = np.linalg.norm(in_camera, axis=1)
    inside = seen & (pixels >= 0).all(1) & (pixels < (frame.camera.width, frame.camera.height)).all(1) & (distance > 0)
    column, row = np.where(inside[:, None], pixels, 0).astype(int).T
    use = np.flatnonzero(inside & usable[row, column])
    use = use[:: max(1, -(-len(use) // most))]
    off_axis = 1 - in_camera[use, 2] / distance[use]
    return LightSamples(keyframe.name, np.log(distance[use]), log_v[row[use], column[use]].astype(float), off_axis)


def fit_on_map(
    frames: FrameSequence,
    sparse_map: SparseMap,
    judge: Model | None = None,
    camera: CameraModel | None = None,
    rng: np.random.Generator | None = None,
    least: int = 20,
) -> LightFit:
    """The light with which the closed form explains the map: fitted on every other keyframe, judged on the rest.

    The judge (the closed form unless given) predicts the withheld keyframes with each light. Raises InputError when
    fewer than four keyframes have `least` usable points.
    """
    check_shared_frames(sparse_map, frames)
    views, samples = [], []
    for view in map_views(frames, sparse_map, camera):
        found = samples_of(view)
        if len(found) >= least:
            views.append(view)
            samples.append(found)
    if len(views) < 4:
        raise InputError(
            sparse_map.source,
            f"{len(views)} keyframes with at least {least} observed points on pixels that are neither black nor "
            "saturated",
            "expected at least 4 to find the light from",
        )
    gamma, mu, uncertainty, residuals = fit_samples(samples[::2], rng)
    fitted = PhotometricCalibration(gamma=gamma, mu=mu, source="measured")
    judge = judge or DeclineModel(details=False)
    lights = {"default": PhotometricCalibration(), "fitted": fitted}
    errors = {"constant": withheld_error(views[1::2], ConstantModel(), fitted)}
    errors.update({name: withheld_error(views[1::2], judge, light) for name, light in lights.items()})
    used = len(samples[::2])
    return LightFit(
        fitted,
        uncertainty,
        errors,
        "median |mapped - s predicted| / mapped over the points of the withheld keyframes, wrong points included",
        (used, len(views) - used),
        sum(map(len, samples[::2])),
        _shown(samples[::2], residuals, gamma),
    )


def fit_assumed_light(
    run: Run, frames: FrameSequence, sparse_map: SparseMap, judge: Model
) -> PhotometricCalibration | None:
    """The light that the map tells, where the frames' is only assumed and the judge does better with it; else
    None.

    What was fitted goes into the run's record as `light_fit`, and why nothing was into its log.
    """
    if not frames[0].light.assumed:
        return None
    start = time.perf_counter()
    try:
        fit = fit_on_map(frames, sparse_map, judge)
    except InputError as error:
        run.log(f"light assumed, not fitted: {error}")
        return None
    run.record["light_fit"] = plain(
        {
            "summary": f"fitted on the map: {fit.summary()}",
            "fitted": fit.fitted,
            "uncertainty": fit.uncertainty,
            "errors": fit.errors,
            "used": fit.better,
            "seconds": round(time.perf_counter() - start, 3),
        }
    )
    run.log(f"light {run.record['light_fit']['summary']}")
    return fit.light if fit.better else None


def fit_samples(
    samples: Sequence[LightSamples], rng: np.random.Generator | None = None, draws: int = 200
) -> tuple[float, float, dict[str, float], list[np.ndarray]]:
    """(gamma, mu), their standard deviations, and the residuals of log distance per keyframe.

    Objective: the mean over keyframes of the length of the shortest half of the residuals, which up to half wrong
    points cannot move, on a grid; from there Tukey's biweight by reweighted least squares, with one constant per
    keyframe and a weak prior around the defaults that matters only where the points say little.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    gamma, mu = min(
        ((g, m) for g in GAMMAS for m in MUS),
        key=lambda light: np.mean([_shortest_half(r)[0] for r in _residuals(samples, *light)]),
    )
    moments, gram_prior, pull = np.zeros((len(samples), 3, 3)), np.zeros((2, 2)), np.zeros(2)
    for _ in range(30):
        residuals = [r - _shortest_half(r)[1] for r in _residuals(samples, gamma, mu)]
        sigma = mad_sigma(np.array([np.median(np.abs(r)) for r in residuals]), least=1e-6)
        moments = np.stack([_moments(s, r, sigma) for s, r in zip(samples, residuals, strict=True)])
        precision = POINTS_PER_WITNESS * sigma**2 / np.square([PRIOR_GAMMA / 2, PRIOR_MU / 2])
        gram_prior, pull = np.diag(precision), precision * (DEFAULT_GAMMA / 2, DEFAULT_MU / 2)
        before, (gamma, mu) = (gamma, mu), _solved(moments.sum(0), gram_prior, pull)
        if abs(gamma - before[0]) + abs(mu - before[1]) < 1e-5:
            break
    count = len(samples)
    again = [_solved(moments[rng.integers(count, size=count)].sum(0), gram_prior, pull) for _ in range(draws)]
    deviation = np.std(again, axis=0)
    uncertainty = {"gamma": float(deviation[0]), "mu": float(deviation[1])}
    residuals = [r - _shortest_half(r)[1] for r in _residuals(samples, gamma, mu)]
    return gamma, mu, uncertainty, residuals


def _residuals(samples: Sequence[LightSamples], gamma: float, mu: float) -> list[np.ndarray]:
    return [s.log_distance + 0.5 * (gamma * s.log_v + mu * s.off_axis) for s in samples]


def _shortest_half(values: np.ndarray) -> tuple[float, float]:
    """Length and middle of the shortest interval that holds half of the values: their spread and place."""
    ordered, half = np.sort(values), len(values) // 2
    lengths = ordered[half:] - ordered[: len(values) - half]
    first = int(lengths.argmin())
    return float(lengths[first]), float(ordered[first] + ordered[first + half]) / 2


def _moments(samples: LightSamples, residual: np.ndarray, sigma: float) -> np.ndarray:
    """(3, 3) weighted second moments of (log a, -log V, -(1 - cos psi)), free of the keyframe's constant."""
    weight = robust_weights(residual / sigma, "tukey")
    table = np.stack([samples.log_distance, -samples.log_v, -samples.off_axis], 1)
    table = table - weight @ table / max(float(weight.sum()), 1e-9)
    result: np.ndarray = table.T @ (weight[:, None] * table)
    return result


def _solved(moments: np.ndarray, gram_prior: np.ndarray, pull: np.ndarray) -> tuple[float, float]:
    """(gamma, mu) from the normal equations, mu not below zero."""
    gram, right = moments[1:, 1:] + gram_prior, moments[1:, 0] + pull
    half_gamma, half_mu = np.linalg.solve(gram, right)
    if not MU_RANGE[0] <= 2 * half_mu <= MU_RANGE[1]:
        half_mu = np.clip(half_mu, MU_RANGE[0] / 2, MU_RANGE[1] / 2)
        half_gamma = (right[0] - gram[0, 1] * half_mu) / gram[0, 0]
    return float(np.clip(2 * half_gamma, *GAMMA_RANGE)), float(2 * half_mu)


def withheld_error(views: Sequence[LightView], model: Model, light: PhotometricCalibration) -> float:
    """Median of |mapped - s predicted| / mapped over all points of the views, s by LMedS per keyframe."""
    errors = []
    for view in views:
        observed = observed_distances(view.keyframe, view.submap, model(replace(view.frame, light=light)))
        if len(observed) >= 8:
            scale = lmeds_scale(observed.mapped, observed.predicted).scale
            errors.append(np.abs(observed.mapped - scale * observed.predicted) / observed.mapped)
    return float(np.median(np.concatenate(errors))) if errors else float("inf")


def _shown(samples: Sequence[LightSamples], residuals: Sequence[np.ndarray], gamma: float) -> np.ndarray:
    """What a plot of brightness against distance needs, (n, 3): distance over its keyframe's median."""
    parts = []
    for s, r in zip(samples, residuals, strict=True):
        log_a = s.log_distance - np.median(s.log_distance)
        parts.append(np.stack([log_a, 2 / gamma * (r - log_a), r], 1))
    return np.concatenate(parts)


def with_light(frames: FrameSequence, light: PhotometricCalibration) -> FrameSequence:
    """The same frames under another light."""
    return FrameSequence(frames.names, lambda i: replace(frames[i], light=light), frames.source)
