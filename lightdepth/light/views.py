"""Keyframes of a map with their images, at few rows, and how a model does on points of them that it has not seen.

Points are hidden in whole blocks of wall, from every keyframe at once (lightdepth.blocks): of two neighbouring points
one knows what the other says. What is judged is what is delivered: predictions placed in the map as the caller places
them, by one scale or bent, without the hidden points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from lightdepth.blocks import hidden_in_turn, submap_folds
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.decline import V_FLOOR
from lightdepth.errors import InputError
from lightdepth.frame import Frame, check_image_size
from lightdepth.models import working_size
from lightdepth.observations import ObservedDistances, observed_distances
from lightdepth.photometry import PhotometricCalibration
from lightdepth.prediction import DepthPrediction
from lightdepth.robust import lmeds_scale
from lightdepth.sparse_map import Keyframe, SparseMap, Submap

Model = Callable[[Frame], DepthPrediction]
Placed = Callable[[ObservedDistances], np.ndarray]
"""From predicted distances where a keyframe observed points to distances (n,) in map units."""
Place = Callable[[Submap, Sequence[DepthPrediction]], Sequence[Placed | None]]
"""Places the predictions of a submap's keyframes, one for each, by the points of that submap; None is a keyframe that
cannot be placed."""

SATURATED = 0.97
FOLDS = 3
"""Of blocks of wall, each hidden once."""


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


def parted(view: LightView, hidden: np.ndarray) -> tuple[LightView, LightView]:
    """The view without the points of its submap that are hidden (n,), and with these alone."""
    return _with_points(view, ~hidden), _with_points(view, hidden)


def _with_points(view: LightView, kept: np.ndarray) -> LightView:
    submap, keyframe = view.submap, view.keyframe
    rows, held = submap.rows_of(keyframe.point_ids)
    seen = held & kept[rows]
    part = replace(keyframe, pixels=keyframe.pixels[seen], point_ids=keyframe.point_ids[seen])
    return replace(view, keyframe=part)


def blind_share(views: Sequence[LightView]) -> tuple[float, float]:
    """Shares of the valid pixels that are saturated, and that are black: medians over the views."""
    brightest = [view.frame.image.max(-1)[view.frame.valid] for view in views]
    brightest = [v for v in brightest if len(v)]
    if not brightest:
        return 0.0, 1.0
    saturated = np.median([(v >= SATURATED).mean() for v in brightest])
    return float(saturated), float(np.median([(v <= V_FLOOR).mean() for v in brightest]))


def one_scale(submap: Submap, predictions: Sequence[DepthPrediction]) -> list[Placed | None]:
    """Each prediction at the LMedS scale of its keyframe."""
    placed: list[Placed | None] = []
    for keyframe, prediction in zip(submap.keyframes, predictions, strict=True):
        observed = observed_distances(keyframe, submap, prediction)
        scale = lmeds_scale(observed.mapped, observed.predicted).scale if len(observed) >= 8 else None
        placed.append(None if scale is None else partial(_scaled, scale))
    return placed


def _scaled(scale: float, observed: ObservedDistances) -> np.ndarray:
    return scale * observed.predicted


def hidden_error(
    views: Sequence[LightView],
    model: Model,
    lights: Sequence[PhotometricCalibration],
    place: Place = one_scale,
    seed: int = 0,
) -> float:
    """Median of |mapped - placed| / mapped over the points of the views, each while its fold of wall was hidden from
    `place`; the light under which a fold is predicted is that of its number."""
    errors = [np.zeros(0)]
    for map_id in sorted({view.submap.id for view in views}):
        of_map = [view for view in views if view.submap.id == map_id]
        fold_of = submap_folds(of_map[0].submap, FOLDS, seed)
        predictions = {
            light: [model(replace(view.frame, light=light)) for view in of_map] for light in dict.fromkeys(lights)
        }
        for (hidden, _), light in zip(hidden_in_turn(fold_of, range(FOLDS)), lights, strict=True):
            seen, judging = zip(*(parted(view, hidden) for view in of_map), strict=True)
            known = replace(of_map[0].submap, keyframes=tuple(view.keyframe for view in seen))
            placed = place(known, predictions[light])
            for view, prediction, found in zip(judging, predictions[light], placed, strict=True):
                if found is not None:
                    observed = observed_distances(view.keyframe, view.submap, prediction)
                    errors.append(np.abs(observed.mapped - found(observed)) / observed.mapped)
    pooled = np.concatenate(errors)
    return float(np.median(pooled)) if len(pooled) else float("inf")


def withheld_error(views: Sequence[LightView], model: Model, light: PhotometricCalibration) -> float:
    """Median of |mapped - s predicted| / mapped over all points of the views, s by LMedS per keyframe."""
    errors = []
    for view in views:
        observed = observed_distances(view.keyframe, view.submap, model(replace(view.frame, light=light)))
        if len(observed) >= 8:
            scale = lmeds_scale(observed.mapped, observed.predicted).scale
            errors.append(np.abs(observed.mapped - scale * observed.predicted) / observed.mapped)
    return float(np.median(np.concatenate(errors))) if errors else float("inf")


def with_light(frames: FrameSequence, light: PhotometricCalibration) -> FrameSequence:
    """The same frames under another light."""
    return FrameSequence(frames.names, lambda i: replace(frames[i], light=light), frames.source)
