"""densify(): the paper's method section as code. Predict, observe, align, rectify, fuse; submap by submap."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from densify.alignment import Alignment, AlignmentConfig, align
from densify.coverage import Coverage, CoverageConfig, contribution, coverage, looked_at
from densify.dense_map import Contribution, DenseMap
from densify.fusion import FusionConfig, TsdfVolume
from densify.rectify import RectifyConfig, surface_view
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame, check_image_size
from lightdepth.observations import ObservedDistances, observed_distances
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, SparseMap, Submap

Model = Callable[[Frame], DepthPrediction]


@dataclass(frozen=True)
class DensifyConfig:
    """The recipe. `withhold` is the share of each keyframe's observed points that takes no part in the alignment, so
    that the surface can be judged by them; `seed` draws them."""

    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    rectify: RectifyConfig = field(default_factory=RectifyConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    withhold: float = 0.2
    seed: int = 0
    coverage: CoverageConfig = field(default_factory=CoverageConfig)

    def __post_init__(self) -> None:
        if not 0 <= self.withhold < 1:
            raise InputError(f"withhold {self.withhold}; expected a share of at least 0 and below 1")


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
    it, seconds per step, summed over the keyframes, keyframes whose image is missing or unreadable, with the
    reason, and what of the wall was seen."""

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

    `on_keyframe` is shown every keyframe as it is done (progress, pictures).
    """
    return [densify_submap(submap, frames, model, config, on_keyframe) for submap in sparse_map.submaps]


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
    volume = TsdfVolume(voxel, config.fusion)
    alignments: list[Alignment] = []
    aligned: list[Keyframe] = []
    unread: dict[str, str] = {}
    withheld: list[tuple[Keyframe, ObservedDistances]] = []
    contributions: dict[str, Contribution] = {}
    for keyframe in submap.keyframes:
        with clock("read"):
            frame, reason = _frame_of(keyframe, frames)
        if frame is None:
            unread[keyframe.name] = reason
            alignments.append(Alignment(keyframe.name, reason=reason))
            if on_keyframe is not None:
                on_keyframe(KeyframeView(submap, keyframe, alignments[-1]))
            continue
        with clock("predict"):
            prediction = model(frame)
        with clock("align"):
            observed = observed_distances(keyframe, submap, prediction)
            used, kept_back = split_withheld(observed, config, submap.id, keyframe.number)
            alignment = align(keyframe.name, used, config.alignment)
        alignments.append(alignment)
        if alignment.ok:
            with clock("integrate"):
                reach = config.fusion.far * alignment.range_90
                view = surface_view(prediction.scaled(alignment.scale), frame.image, config.rectify, reach)
                volume.integrate(view, keyframe.cam_from_map)
                contributions[keyframe.name] = contribution(view, prediction)
            aligned.append(keyframe)
        withheld.append((keyframe, kept_back))
        if on_keyframe is not None:
            on_keyframe(KeyframeView(submap, keyframe, alignment, frame, prediction, observed))
    with clock("extract"):
        mesh = volume.extract_mesh()
    dense = DenseMap(
        submap,
        mesh.vertices,
        mesh.triangles,
        mesh.colors,
        tuple(alignments),
        voxel,
        "map units",
        mesh.weights,
        mesh.views,
    )
    with clock("cover"):
        dense = replace(dense, contributions={k.name: looked_at(dense, k, contributions[k.name]) for k in aligned})
        covered = coverage(dense, config.coverage)
    with clock("judge"):
        judged = withheld_error(dense, withheld) if config.withhold else None
        seen = seen_share(dense, aligned, frames)
    return SubmapResult(dense, judged, seen, dict(clock), unread, covered)


def _frame_of(keyframe: Keyframe, frames: FrameSequence) -> tuple[Frame | None, str]:
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
        frame, _ = _frame_of(keyframe, frames)
        assert frame is not None
        rows, columns = frame.valid[::stride, ::stride].nonzero()
        rays = keyframe.camera.rays()[0][::stride, ::stride][rows, columns]
        hits += int(np.isfinite(dense.surface.cast(keyframe.center, rays @ keyframe.cam_from_map[:3, :3])).sum())
        total += len(rays)
    return hits / max(total, 1)
