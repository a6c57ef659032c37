"""Predictions of a submap's keyframes, made when they are asked for and kept while there is room."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe

Predictor = Callable[[Frame], DepthPrediction]
"""Whatever predicts a frame's distance: a lightdepth.models.DepthModel, or any function that does."""


class Clock(dict[str, float]):
    """Seconds by step, summed over all keyframes."""

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self[step] = self.get(step, 0.0) + time.perf_counter() - start


@dataclass(frozen=True)
class SeenKeyframe:
    """A keyframe's image and what a model says of it; both are None where the image is missing or unreadable, and
    `reason` says why."""

    frame: Frame | None = None
    prediction: DepthPrediction | None = None
    reason: str = ""

    @property
    def size(self) -> int:
        """Bytes."""
        p = self.prediction
        return 0 if p is None or self.frame is None else self.frame.image.nbytes + p.distance.nbytes + p.valid.nbytes


class Predictions:
    """What `model` says of the keyframes of `frames`. The first `keep_mb` megabytes are kept, others are made again
    whenever they are asked for. Time goes to the steps "read" and "predict" of `clock`."""

    def __init__(self, frames: FrameSequence, model: Predictor, keep_mb: float, clock: Clock | None = None) -> None:
        self.frames, self._model, self._clock = frames, model, Clock() if clock is None else clock
        self._kept: dict[str, SeenKeyframe] = {}
        self._counted: set[str] = set()
        self._room = keep_mb * 2**20

    def of(self, keyframe: Keyframe) -> SeenKeyframe:
        """The keyframe's image under the map's own camera, with distance alone predicted (no albedo, no normals)."""
        if keyframe.name in self._kept:
            return self._kept[keyframe.name]
        seen = self._made(keyframe)
        if keyframe.name not in self._counted:
            self._counted.add(keyframe.name)
            self._room -= seen.size
            if self._room >= 0 or seen.frame is None:
                self._kept[keyframe.name] = seen
        return seen

    def _made(self, keyframe: Keyframe) -> SeenKeyframe:
        try:
            with self._clock("read"):
                frame = self.frames.of_keyframe(keyframe)
        except InputError as error:
            return SeenKeyframe(reason=str(error))
        with self._clock("predict"):
            return SeenKeyframe(frame, replace(self._model(frame), albedo=None, normals=None))
