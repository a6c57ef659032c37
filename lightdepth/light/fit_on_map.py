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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lightdepth.blocks import submap_folds
from lightdepth.camera import CameraModel
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.decline import BLUR, V_FLOOR, masked_blur
from lightdepth.errors import InputError
from lightdepth.frame import to_batch
from lightdepth.light.views import (
    FOLDS,
    SATURATED,
    LightView,
    Model,
    Place,
    blind_share,
    hidden_error,
    map_views,
    one_scale,
    parted,
)
from lightdepth.models import ConstantModel, DeclineModel
from lightdepth.photometry import DEFAULT_GAMMA, DEFAULT_MU, PhotometricCalibration, brightness
from lightdepth.reporting.run import Run, plain
from lightdepth.robust import mad_sigma, robust_weights
from lightdepth.sparse_map import SparseMap

GAMMAS, MUS = np.arange(0.6, 4.01, 0.2), np.arange(0.0, 6.01, 0.5)
GAMMA_RANGE, MU_RANGE = (0.5, 5.0), (0.0, 10.0)
MU_SLACK = 0.5  # below mu 0: noise pulls the fit of a light without spread as far
PRIOR_GAMMA, PRIOR_MU = 0.6, 2.0  # deviations from the defaults that nobody would be surprised at
MOST_BLIND = 0.4  # of the valid pixels saturated, or black; a real frame of C3VD, which light still tells, has .32
GAIN_NEEDED = 0.95  # a light must leave at most this share of the error of what it replaces, or it knows nothing
MOST_FITTED, MOST_JUDGING = 16, 10  # keyframes: more take longer, and changed no verdict on real maps
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
    """A fitted light, and what judges of it that took no part in the fit.

    `errors` of constant, default and fitted on what was withheld, in the words of `measure`; `light` is the fitted one
    where nothing speaks against it, else the default. `bound` is where the fit ended at the end of its range.
    `uncertainty` holds standard deviations (bootstrap over keyframes), `keyframes` how many were fitted and how many
    judged, `points` the number fitted, `shown` (n, 3) what a plot needs: log distance, log V freed of everything but
    distance, residual of log distance. `cosine_exponent` and `candidates` (name, error on withheld frames, calibration,
    exponent) where normals were known.
    """

    fitted: PhotometricCalibration
    uncertainty: dict[str, float]
    errors: dict[str, float]
    measure: str
    keyframes: tuple[int, int]
    points: int
    shown: np.ndarray
    bound: str = ""
    cosine_exponent: float | None = None
    candidates: tuple[tuple[str, float, PhotometricCalibration, float], ...] = ()

    @property
    def refused(self) -> str:
        """Why the fitted light is not used; empty where it is."""
        e = self.errors
        if self.bound:
            return f"{self.bound}, so it says nothing"
        gains = e["fitted"] <= GAIN_NEEDED * e["default"]
        # Where the defaults are plainly worse, a fit that is as good as a constant distance is the better light.
        if not GAIN_NEEDED * e["fitted"] <= e["constant"] or not (gains or self.beats_constant):
            return f"a constant distance does as well or better ({e['constant']:.1%})"
        return "" if gains else f"the default light does as well or better ({e['default']:.1%})"

    @property
    def beats_constant(self) -> bool:
        """Whether what was withheld is told better by the fitted light than by a constant distance."""
        return self.errors["fitted"] <= GAIN_NEEDED * self.errors["constant"]

    @property
    def better(self) -> bool:
        return not self.refused

    @property
    def light(self) -> PhotometricCalibration:
        return self.fitted if self.better else PhotometricCalibration()

    def summary(self) -> str:
        e = self.errors
        text = (
            f"gamma {self.fitted.gamma:.2f} ± {self.uncertainty['gamma']:.2f}, mu {self.fitted.mu:.2f} ± "
            f"{self.uncertainty['mu']:.2f}; {self.judges} {e['fitted']:.1%} against {e['default']:.1%} with the "
            f"defaults, {e['constant']:.1%} with a constant"
        )
        if self.better:
            return text if self.beats_constant else f"{text}; used, though a constant distance does as well here"
        text += f"; not used: {self.refused}; the defaults (gamma 2.2, mu 2.767) are kept"
        if e["default"] <= GAIN_NEEDED * e["constant"]:
            return text
        worse = not GAIN_NEEDED * e["default"] <= e["constant"]
        return f"{text}, which are {'worse than' if worse else 'about as good as'} a constant distance here"

    @property
    def advice(self) -> str:
        """What to do where the light that is left tells no more than a constant distance; empty where it does."""
        left = self.errors["fitted" if self.better else "default"]
        if left <= GAIN_NEEDED * self.errors["constant"]:
            return ""
        return "give the endoscope's own with --light, where it is known"

    @property
    def judges(self) -> str:
        """What the errors were taken on."""
        return "hidden blocks of wall" if self.cosine_exponent is None else "withheld frames"


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
    place: Place = one_scale,
) -> LightFit:
    """The light with which the closed form explains the map, judged by blocks of wall.

    They are hidden a fold at a time: the light is fitted to the other points, the judge (the closed form unless given)
    predicts the keyframes with each light, `place` brings that to the map as it will be delivered, by the other points
    alone, and the hidden ones say how well it did. A constant distance gets the same help. The light that is returned
    is fitted to all points. Raises InputError when fewer than four keyframes have `least` usable points, or when
    most of the image is saturated or black.
    """
    check_shared_frames(sparse_map, frames)
    every = map_views(frames, sparse_map, camera, most=MOST_FITTED)
    _check_lit(sparse_map.source, every)
    drawn = [(view, found) for view in every if len(found := samples_of(view)) >= least]
    if len(drawn) < 4:
        raise InputError(
            sparse_map.source,
            f"{counted(len(drawn), 'keyframe')} with at least {least} observed points on pixels that are neither "
            "black nor saturated",
            "expected at least 4 to find the light from",
        )
    views, samples = [view for view, _ in drawn], [found for _, found in drawn]
    gamma, mu, uncertainty, residuals, bound = fit_samples(samples, rng)
    fold_of = {submap.id: submap_folds(submap, FOLDS) for submap in sparse_map.submaps}
    hiding = [_fitted_without(views, {i: of == fold for i, of in fold_of.items()}, least) for fold in range(FOLDS)]
    judging = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(MOST_JUDGING, len(views))).astype(int))]
    judge, default = judge or DeclineModel(details=False), [PhotometricCalibration()] * FOLDS
    errors = {
        "constant": hidden_error(judging, ConstantModel(), default, place),
        "default": hidden_error(judging, judge, default, place),
        "fitted": hidden_error(judging, judge, hiding, place),
    }
    fitted = PhotometricCalibration(gamma=gamma, mu=mu, source="fitted")
    return LightFit(
        fitted,
        uncertainty,
        errors,
        "median |mapped - found| / mapped over the points in blocks of wall that nothing else saw, wrong points "
        "included",
        (len(views), len(judging)),
        sum(map(len, samples)),
        _shown(samples, residuals, gamma),
        bound,
    )


def _fitted_without(views: Sequence[LightView], hidden: Mapping[int, np.ndarray], least: int) -> PhotometricCalibration:
    """The light of the views' points that are not hidden, by submap; the default where they are too few."""
    seen = [samples_of(parted(view, hidden[view.submap.id])[0]) for view in views]
    seen = [samples for samples in seen if len(samples) >= least]
    if not seen:
        return PhotometricCalibration()
    gamma, mu, *_ = fit_samples(seen, draws=1)
    return PhotometricCalibration(gamma=gamma, mu=mu, source="fitted")


def _check_lit(source: str, views: Sequence[LightView]) -> None:
    """Raises InputError where most pixels are saturated or black: those say nothing of distance."""
    for share, kind in zip(blind_share(views), ("saturated", "black"), strict=True):
        if views and share > MOST_BLIND:
            raise InputError(
                source,
                f"{share:.0%} of the pixels of its frames are {kind} (median over {len(views)} keyframes)",
                f"expected at most {MOST_BLIND:.0%}: no light explains what has no brightness of its own",
            )


def at_bound(gamma: float, mu: float) -> str:
    """Which parameter the data pull to an end of its range or beyond, and the end; empty where they pull none.

    A light without any spread, mu 0, is a light like others: only a pull well below it counts.
    """
    for name, value, low, high, slack in (("gamma", gamma, *GAMMA_RANGE, 0.0), ("mu", mu, *MU_RANGE, MU_SLACK)):
        if value <= low - slack or value >= high:
            return f"{name} ended at its bound of {low if value <= low else high:g}"
    return ""


def fit_assumed_light(
    run: Run, frames: FrameSequence, sparse_map: SparseMap, judge: Model, place: Place = one_scale
) -> PhotometricCalibration | None:
    """The light that the map tells, where nobody gave the frames' and the judge does better with it; else None.

    What was fitted, and whether it is used, or why nothing was fitted, is in the run's record as `light_fit`.
    """
    if not frames.first().light.assumed:
        return None
    if run.done("light"):
        light_fit, kept = run.kept_of("light")
        run.record["light_fit"] = light_fit
        return None if kept is None else PhotometricCalibration(**kept)
    start = time.perf_counter()
    run.log("light: fitting it on the map, and judging it on hidden blocks of wall")
    found: dict[str, object] = {"used": False}
    light = None
    try:
        fit = fit_on_map(frames, sparse_map, judge, place=place)
    except InputError as error:
        found["summary"] = f"assumed, not fitted: {error}"
    else:
        light = fit.fitted if fit.better else None
        found = {
            "summary": "; ".join(filter(None, [f"fitted on the map: {fit.summary()}", fit.advice])),
            "fitted": fit.fitted,
            "uncertainty": fit.uncertainty,
            "errors": fit.errors,
            "used": fit.better,
        }
    found["seconds"] = round(time.perf_counter() - start, 3)
    run.record["light_fit"] = plain(found)
    run.log(f"light {found['summary']}")
    run.finish_part("light", [], [found, light])
    return light


def fit_samples(
    samples: Sequence[LightSamples], rng: np.random.Generator | None = None, draws: int = 200
) -> tuple[float, float, dict[str, float], list[np.ndarray], str]:
    """(gamma, mu), their standard deviations, the residuals of log distance per keyframe, and which parameter is pulled
    to the end of its range (`at_bound`).

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
    return gamma, mu, uncertainty, residuals, at_bound(*_free(moments.sum(0), gram_prior, pull))


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


def _free(moments: np.ndarray, gram_prior: np.ndarray, pull: np.ndarray) -> tuple[float, float]:
    """(gamma, mu) from the normal equations, wherever they lie."""
    half_gamma, half_mu = np.linalg.solve(moments[1:, 1:] + gram_prior, moments[1:, 0] + pull)
    return 2 * float(half_gamma), 2 * float(half_mu)


def _solved(moments: np.ndarray, gram_prior: np.ndarray, pull: np.ndarray) -> tuple[float, float]:
    """(gamma, mu) from the normal equations, mu not below zero."""
    gram, right = moments[1:, 1:] + gram_prior, moments[1:, 0] + pull
    half_gamma, half_mu = np.linalg.solve(gram, right)
    if not MU_RANGE[0] <= 2 * half_mu <= MU_RANGE[1]:
        half_mu = np.clip(half_mu, MU_RANGE[0] / 2, MU_RANGE[1] / 2)
        half_gamma = (right[0] - gram[0, 1] * half_mu) / gram[0, 0]
    return float(np.clip(2 * half_gamma, *GAMMA_RANGE)), float(2 * half_mu)


def _shown(samples: Sequence[LightSamples], residuals: Sequence[np.ndarray], gamma: float) -> np.ndarray:
    """What a plot of brightness against distance needs, (n, 3): distance over its keyframe's median."""
    parts = []
    for s, r in zip(samples, residuals, strict=True):
        log_a = s.log_distance - np.median(s.log_distance)
        parts.append(np.stack([log_a, 2 / gamma * (r - log_a), r], 1))
    return np.concatenate(parts)
