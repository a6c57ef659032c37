"""Asks each keyframe's new points what they say of the depth that was there before them (densify.judging.ahead), and
the images of all keyframes, once they are there, what they say of the surface."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from densify.agreement import View
from densify.aligned import AlignedKeyframe
from densify.config import MethodConfig
from densify.judging.ahead import NOTHING
from densify.judging.columns import FourWays, Method
from densify.judging.images import Images, Seen
from densify.live.packed import PackedView
from lightdepth.frame import Frame
from lightdepth.observations import ObservedDistances
from lightdepth.parallax import ParallaxConfig
from lightdepth.sparse_map import Keyframe, Submap


class AheadJudge:
    """Goes along with a live surface: `asked` before a keyframe's points are used, `saw` after."""

    def __init__(self, config: MethodConfig, on: bool = True) -> None:
        self._method, self._on = Method(config.alignment, config.agreement, config.bending), on
        self._known: set[int] = set()
        self._last: AlignedKeyframe | None = None

    @property
    def last(self) -> str:
        """Name of the last keyframe that was aligned; empty before the first."""
        return "" if self._last is None else self._last.keyframe.name

    def asked(self, keyframe: Keyframe, points: np.ndarray, place: Keyframe | None) -> np.ndarray:
        """Errors (n, 5) of the last aligned keyframe, which is at `place` now, at those of a new keyframe's points
        (m, 3) that it sees and that nobody observed before."""
        if not self._on or self._last is None or place is None:
            return NOTHING
        view, bend, alone = self._last.view, self._last.bend, self._last.alone
        assert view is not None and bend is not None and alone is not None, "it was aligned"
        new = np.array([i not in self._known for i in keyframe.point_ids.tolist()], bool)
        if not new.any():
            return NOTHING
        at = _measured(view, place, keyframe.point_ids[new], points[new])
        four = FourWays.beside(alone.scale, bend, view, self._method).errors(at)
        return np.concatenate([four, four[:, [1 if self._last.alignment.bend else 0]]], 1)

    def saw(self, aligned: AlignedKeyframe) -> None:
        """Keeps what a new keyframe says of the wall, if it was aligned; its points are new no more."""
        if self._on:
            self.knows(aligned.keyframe)
            self._last = aligned if aligned.alignment.ok else self._last

    def saw_again(self, aligned: AlignedKeyframe) -> None:
        """The same of a keyframe whose points have moved."""
        if self._on and aligned.keyframe.name == self.last:
            self._last = aligned if aligned.alignment.ok else None

    def knows(self, keyframe: Keyframe) -> None:
        """Its points are not new any more."""
        if self._on:
            self._known.update(keyframe.point_ids.tolist())


def _measured(view: View, place: Keyframe, ids: np.ndarray, points: np.ndarray) -> ObservedDistances:
    """Points (n, 3) as a keyframe's view has them from its place: measured and predicted distances."""
    in_camera, camera = place.in_camera(points), place.camera
    pixels, seen = camera.project(in_camera)
    log_predicted, known = view.at(np.where(seen[:, None], pixels / (camera.width, camera.height), -1.0))
    mapped = np.linalg.norm(in_camera, axis=1)
    rays = in_camera / np.maximum(mapped, 1e-12)[:, None]
    found = ObservedDistances(ids, mapped, np.exp(log_predicted), pixels, rays)
    return found.subset(seen & known & (mapped > 0))


def images_of(views: Mapping[str, PackedView], submap: Submap, config: ParallaxConfig) -> dict[str, Seen]:
    """What the images of keyframes tell of distances, by name, from what is kept of them."""
    images = Images(config)
    for keyframe in submap.keyframes:
        view = views[keyframe.name]
        prediction = view.prediction()
        images.see(keyframe, Frame(keyframe.name, view.image(), keyframe.camera, mask=prediction.valid), prediction)
    return images.measure(submap)
