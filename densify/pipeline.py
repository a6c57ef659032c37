"""densify(): the paper's method section as code. Predict, observe, align, rectify, fuse; submap by submap."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from densify.agreement import AgreementConfig, View, agree
from densify.alignment import Alignment, AlignmentConfig, align, bent
from densify.bending import BendingConfig
from densify.contradiction import ContradictionConfig, uncontradicted, without
from densify.coverage import Coverage, CoverageConfig, contribution, coverage, looked_at
from densify.dense_map import Contribution, DenseMap
from densify.fusion.plain import PlainTsdf, undistorted
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame, check_image_size
from lightdepth.observations import ObservedDistances, observed_distances, unobserved
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, SparseMap, Submap, covisibility

Model = Callable[[Frame], DepthPrediction]


@dataclass(frozen=True)
class DensifyConfig:
    """How dense maps are made.

    `recipe` paper is the paper's: each keyframe's LMedS scale, one undistorted pinhole image, plain TSDF; the settings
    of agreement, bending, contradiction and rectify are then not looked at. `withhold` is the share of each keyframe's
    observed points that takes no part in the alignment, so that the surface can be judged by them; `seed` draws them.
    Frames and predictions of a submap are kept between the passes over it up to `keep_mb`; others are made again.
    """

    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    rectify: RectifyConfig = field(default_factory=RectifyConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    withhold: float = 0.2
    seed: int = 0
    recipe: Literal["full", "paper"] = "full"
    agreement: AgreementConfig = field(default_factory=AgreementConfig)
    bending: BendingConfig = field(default_factory=BendingConfig)
    contradiction: ContradictionConfig = field(default_factory=ContradictionConfig)
    coverage: CoverageConfig = field(default_factory=CoverageConfig)
    keep_mb: float = 1000.0

    def __post_init__(self) -> None:
        if not 0 <= self.withhold < 1:
            raise InputError(f"withhold {self.withhold}; expected a share of at least 0 and below 1")
        if self.recipe not in ("full", "paper"):
            raise InputError(f"recipe {self.recipe!r}; expected full or paper")


@dataclass(frozen=True)
class Withheld:
    """How far withheld points are from the surface along their rays, |surface - point| / point.

    A point whose ray misses the surface counts as infinitely far in `median` and `p90`, so that cropping cannot win;
    `miss` is the share of them, and `median_met` leaves them out. Keyframes that were left out are judged too: the
    surface that the others made should explain what they saw.
    """

    points: int
    median: float
    p90: float
    miss: float
    median_met: float


@dataclass(frozen=True)
class SubmapResult:
    """A surface, what withheld points say about it, the share of masked pixels of the aligned keyframes that look at
    it, seconds per step, summed over the keyframes, keyframes whose image is missing or unreadable, with the reason,
    and what of the wall was seen (the paper's fusion cannot tell)."""

    dense: DenseMap
    withheld: Withheld | None
    seen_share: float
    seconds: dict[str, float]
    unread: dict[str, str] = field(default_factory=dict)
    coverage: Coverage | None = None


class _Clock(dict[str, float]):
    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self[step] = self.get(step, 0.0) + time.perf_counter() - start


def densify(
    frames: FrameSequence,
    sparse_map: SparseMap,
    model: Model,
    config: DensifyConfig,
    on_keyframe: Callable[[KeyframeView], None] | None = None,
) -> list[SubmapResult]:
    """The dense map of every submap. Each keeps its own scale and frame of reference.

    `on_keyframe` is shown every keyframe as it is done (progress, pictures). A submap that cannot be densified has an
    empty surface, and the reason with every keyframe; the others go on.
    """
    results = []
    for submap in sparse_map.submaps:
        try:
            results.append(densify_submap(submap, frames, model, config, on_keyframe))
        except InputError as error:
            alignments = tuple(Alignment(k.name, reason=str(error)) for k in submap.keyframes)
            nothing = DenseMap(submap, np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)), alignments, 0.0)
            results.append(SubmapResult(nothing, None, 0.0, {}))
    return results


@dataclass(frozen=True)
class KeyframeView:
    """What there is to show of a keyframe when it is done; what it does not have is None."""

    submap: Submap
    keyframe: Keyframe
    alignment: Alignment
    frame: Frame | None = None
    prediction: DepthPrediction | None = None
    observed: ObservedDistances | None = None


def densify_submap(
    submap: Submap,
    frames: FrameSequence,
    model: Model,
    config: DensifyConfig,
    on_keyframe: Callable[[KeyframeView], None] | None = None,
) -> SubmapResult:
    clock = _Clock()
    voxel = config.fusion.voxel or typical_distance(submap) / config.fusion.voxels_per_distance
    looks, room = [], config.keep_mb * 2**20
    for keyframe in submap.keyframes:
        look = _look(keyframe, submap, frames, model, config, clock)
        room -= look.size
        looks.append(look if room >= 0 else replace(look, frame=None, prediction=None))
    if config.recipe == "full":
        with clock("agree"):
            looks = _agreed(looks, submap, config)
    fuse = _Fusion(voxel, config)
    for look in looks:
        look = look if look.frame is not None or look.view is None else _again(look, frames, model, clock)
        if look.alignment.ok:
            with clock("integrate"):
                fuse(look)
        if on_keyframe is not None:
            on_keyframe(KeyframeView(submap, look.keyframe, look.alignment, look.frame, look.prediction, look.observed))
    alignments = [look.alignment for look in looks]
    aligned = [look.keyframe for look in looks if look.alignment.ok]
    withheld = [(look.keyframe, look.withheld) for look in looks if look.withheld is not None]
    unread = {look.keyframe.name: look.alignment.reason for look in looks if look.view is None}
    with clock("extract"):
        dense = fuse.dense_map(submap, tuple(alignments))
    covered = None
    if dense.weights is not None:
        with clock("cover"):
            given = fuse.contributions
            dense = replace(dense, contributions={k.name: looked_at(dense, k, given[k.name]) for k in aligned})
            covered = coverage(dense, config.coverage)
    with clock("judge"):
        judged = withheld_error(dense, withheld) if config.withhold else None
        seen = seen_share(dense, aligned, frames)
    return SubmapResult(dense, judged, seen, dict(clock), unread, covered)


@dataclass(frozen=True)
class _Look:
    """A keyframe read, predicted and aligned by itself; without an image it has only the reason. `stays` (h, w) is the
    coarse map of pixels that nobody contradicts."""

    keyframe: Keyframe
    alignment: Alignment
    frame: Frame | None = None
    prediction: DepthPrediction | None = None
    observed: ObservedDistances | None = None
    view: View | None = None
    withheld: ObservedDistances | None = None
    stays: np.ndarray | None = None

    @property
    def size(self) -> int:
        """Bytes of what need not be kept."""
        p = self.prediction
        return 0 if p is None or self.frame is None else self.frame.image.nbytes + p.distance.nbytes + p.valid.nbytes


def _look(
    keyframe: Keyframe, submap: Submap, frames: FrameSequence, model: Model, config: DensifyConfig, clock: _Clock
) -> _Look:
    with clock("read"):
        frame, reason = frame_of(keyframe, frames)
    if frame is None:
        return _Look(keyframe, Alignment(keyframe.name, reason=reason))
    with clock("predict"):
        prediction = replace(model(frame), albedo=None, normals=None)
    with clock("align"):
        observed = observed_distances(keyframe, submap, prediction)
        used, kept_back = split_withheld(observed, config, submap.id, keyframe.number)
        alignment = align(keyframe.name, used, config.alignment)
        if not alignment.ok and len(used) < config.alignment.min_points:
            lost = unobserved(keyframe, submap, prediction)
            alignment = replace(alignment, reason="; ".join(filter(None, [alignment.reason, lost])))
        view = View.of(keyframe, used, prediction, alignment.scale)
    return _Look(keyframe, alignment, frame, prediction, observed, view, kept_back)


def _again(look: _Look, frames: FrameSequence, model: Model, clock: _Clock) -> _Look:
    """A keyframe whose image and prediction were not kept."""
    with clock("read"):
        frame, reason = frame_of(look.keyframe, frames)
    if frame is None:  # readable a moment ago
        return replace(look, alignment=Alignment(look.keyframe.name, reason=reason), view=None)
    with clock("predict"):
        return replace(look, frame=frame, prediction=replace(model(frame), albedo=None, normals=None))


def _agreed(looks: list[_Look], submap: Submap, config: DensifyConfig) -> list[_Look]:
    rows = [i for i, look in enumerate(looks) if look.alignment.ok]
    views = [look.view for look in looks if look.alignment.ok and look.view is not None]
    if not rows:
        return looks
    shared = covisibility(submap)[np.ix_(rows, rows)]
    bends = agree(views, shared, config.agreement, config.bending)
    stays: Sequence[np.ndarray | None] = [None] * len(rows)
    if config.contradiction.on:
        stays = uncontradicted(views, bends, shared, config.contradiction)
    looks = list(looks)
    for i, view, bend, stay in zip(rows, views, bends, stays, strict=True):
        alignment = looks[i].alignment
        if config.agreement.on:
            alignment = bent(alignment, bend, view.observed, config.alignment)
        looks[i] = replace(looks[i], alignment=alignment, stays=stay)
    return looks


class _Fusion:
    """Aligned keyframes into one volume, by either recipe, and what each contributed, by name."""

    def __init__(self, voxel: float, config: DensifyConfig):
        self._config, self._voxel = config, voxel
        plain = config.recipe == "paper"
        self._volume = PlainTsdf(voxel, config.fusion.truncation) if plain else TsdfVolume(voxel, config.fusion)
        self.contributions: dict[str, Contribution] = {}

    def __call__(self, look: _Look) -> None:
        assert look.frame is not None and look.prediction is not None
        prediction, reach = look.alignment.applied(look.prediction), self._config.fusion.far * look.alignment.range_90
        pose, image = look.keyframe.cam_from_map, look.frame.image
        if isinstance(self._volume, PlainTsdf):
            self._volume.integrate(*undistorted(prediction, image, reach), pose)
            return
        if look.stays is not None:
            prediction = replace(prediction, valid=without(prediction.valid, look.stays))
        view = surface_view(prediction, image, self._config.rectify, reach)
        self._volume.integrate(view, pose)
        self.contributions[look.keyframe.name] = contribution(view, prediction)

    def dense_map(self, submap: Submap, alignments: tuple[Alignment, ...]) -> DenseMap:
        if isinstance(self._volume, PlainTsdf):
            return DenseMap(submap, *self._volume.extract_mesh(), alignments, self._voxel)
        mesh = self._volume.extract_mesh()
        made = DenseMap(submap, mesh.vertices, mesh.triangles, mesh.colors, alignments, self._voxel)
        return replace(made, weights=mesh.weights, views=mesh.views)


def frame_of(keyframe: Keyframe, frames: FrameSequence) -> tuple[Frame | None, str]:
    """The image of a keyframe with the map's own camera, which knows best; or None and the reason."""
    try:
        frame = frames.by_number(keyframe.number)
        if frame is None:
            return None, f"no frame number {keyframe.number} in {frames.source}"
        return replace(frame, camera=keyframe.camera), ""
    except InputError as error:
        return None, str(error)


def fitted_to_frames(sparse_map: SparseMap, width: int, height: int, camera: CameraModel | None = None) -> SparseMap:
    """The map with cameras and keypoints at the size of the frames, which a SLAM often halves; `camera` replaces the
    map's own. Raises InputError when sizes differ by more than a rescaling."""

    def fitted(keyframe: Keyframe) -> Keyframe:
        own = keyframe.camera
        sx, sy = width / own.width, height / own.height
        if abs(sx / sy - 1) > 0.01:
            check_image_size(f"{sparse_map.source}: keyframe {keyframe.name}", width, height, own)
        resized = own if (sx, sy) == (1, 1) else own.resized(width, height)
        return replace(keyframe, camera=camera or resized, pixels=keyframe.pixels * (sx, sy))

    submaps = (replace(s, keyframes=tuple(map(fitted, s.keyframes))) for s in sparse_map.submaps)
    return replace(sparse_map, submaps=tuple(submaps))


def typical_distance(submap: Submap) -> float:
    """A typical distance from the keyframes to the points that they observed, in map units: their 35th percentile.

    Wrong points are mostly too far; with 30 % of them this is the median of the right ones.
    """
    distances = [np.linalg.norm(k.in_camera(submap.observed_points(k)[1]), axis=1) for k in submap.keyframes]
    together = np.concatenate(distances)
    if not len(together):
        raise InputError(f"map {submap.id}: no keyframe observes any of its points; observations are needed")
    return float(np.quantile(together, 0.35))


def split_withheld(
    observed: ObservedDistances, config: DensifyConfig, submap_id: int, number: int
) -> tuple[ObservedDistances, ObservedDistances]:
    """The points that take part in the alignment, and those kept back to judge the surface by."""
    rng = np.random.default_rng([config.seed, submap_id, number])
    back = rng.random(len(observed)) < config.withhold
    return observed.subset(~back), observed.subset(back)


def withheld_error(dense: DenseMap, withheld: Sequence[tuple[Keyframe, ObservedDistances]]) -> Withheld | None:
    """The withheld-point error of a surface; None when no point was withheld."""
    errors = []
    for keyframe, observed in withheld:
        if len(observed):
            hit = dense.surface.cast(keyframe.center, observed.rays @ keyframe.cam_from_map[:3, :3])
            errors.append(np.abs(hit - observed.mapped) / observed.mapped)
    if not errors:
        return None
    error = np.concatenate(errors)
    met = error[np.isfinite(error)]
    median, p90 = (float(np.quantile(error, q, method="higher")) for q in (0.5, 0.9))
    median_met = float(np.median(met)) if len(met) else np.inf
    return Withheld(len(error), median, p90, 1 - len(met) / len(error), median_met)


def seen_share(dense: DenseMap, keyframes: Sequence[Keyframe], frames: FrameSequence, stride: int = 8) -> float:
    """Share of the masked pixels of keyframes whose rays meet the surface (every stride-th pixel each way)."""
    hits = total = 0
    for keyframe in keyframes:
        frame, _ = frame_of(keyframe, frames)
        assert frame is not None
        rows, columns = frame.valid[::stride, ::stride].nonzero()
        rays = keyframe.camera.rays()[0][::stride, ::stride][rows, columns]
        hits += int(np.isfinite(dense.surface.cast(keyframe.center, rays @ keyframe.cam_from_map[:3, :3])).sum())
        total += len(rays)
    return hits / max(total, 1)
