"""The images' own word on a submap: distances by parallax, half of them to judge bends by, half to judge the surface.

Whatever decides has seen its half, so the verdict rests on the other. Halves are fields of a chequerboard over the
image: neighbours err together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lightdepth.frame import Frame
from lightdepth.observations import ObservedDistances
from lightdepth.parallax import Look, ParallaxConfig, guessed, measured, parallax_neighbours
from lightdepth.prediction import DepthPrediction, shrunk
from lightdepth.relative_pose import as_the_images_say
from lightdepth.sparse_map import Keyframe, Submap

_FIELDS = (6, 5)  # across and down


@dataclass(frozen=True)
class Seen:
    """Distances that the images tell of one keyframe, in map units: those that bends are judged by, and the others."""

    deciding: ObservedDistances
    judging: ObservedDistances

    @property
    def every(self) -> ObservedDistances:
        """Both halves, for what neither has decided."""
        return self.deciding.with_others(self.judging)


class Images:
    """Collects the keyframes of a submap, small, and measures distances between them."""

    def __init__(self, config: ParallaxConfig) -> None:
        self._config = config
        self._seen: dict[str, tuple[Look, DepthPrediction]] = {}

    def see(self, keyframe: Keyframe, frame: Frame, prediction: DepthPrediction) -> None:
        """Keeps what is needed of a keyframe."""
        if self._config.on:
            look = Look.of(keyframe, frame, self._config.width)
            self._seen[keyframe.name] = look, shrunk(prediction, look.keyframe.camera)

    def measure(self, submap: Submap) -> dict[str, Seen]:
        """What the images tell of every keyframe that was seen, by name."""
        names = [k.name for k in submap.keyframes]
        found = {}
        neighbours = parallax_neighbours(submap, self._config) if self._seen else []
        for keyframe, beside in zip(submap.keyframes, neighbours, strict=bool(self._seen)):
            if keyframe.name not in self._seen:
                continue
            look, prediction = self._seen[keyframe.name]
            guess = guessed(look.keyframe, submap)
            others = [self._seen[names[j]][0] for j in beside if names[j] in self._seen]
            others = [as_the_images_say(look, other, guess, self._config) for other in others]
            found[keyframe.name] = _halves(measured(look, others, guess, prediction, self._config), keyframe)
        return found


def _halves(told: ObservedDistances, keyframe: Keyframe) -> Seen:
    """Both halves, at pixels of the keyframe's own camera."""
    place = told.pixels
    if len(told):
        field = (place * _FIELDS).astype(int)
        even = field.sum(1) % 2 == 0
    else:
        even = np.zeros(0, bool)
    told = replace(told, pixels=place * (keyframe.camera.width, keyframe.camera.height))
    return Seen(told.subset(even), told.subset(~even))
