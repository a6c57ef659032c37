"""Whether map points have the colours that the images show where the map says: the vote of a map that has colours.

COLMAP gives a point the mean colour of the pixels that observed it, and so it may tell where patches cannot: by few
points, by points that one keyframe observed. White balance, gain and response change from frame to frame, and
brightness with the distance; which of a frame's points is the redder, bluer or brighter one hardly does. With q and q'
the ranks, from 0 to 1 among what a frame shows, of log R/G, of log B/G and of the mean logarithm, in the image and in
the map,

    vote = 1 - 3 mean |q - q'|     over the three,

which is 1 for the same order and in the mean 0 for none in common (Spearman's footrule).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lightdepth.brief import Brief
from lightdepth.datasets.counting import Counting
from lightdepth.detective.evidence import LEAST_POINTS, Fit
from lightdepth.detective.patches import Pictures
from lightdepth.detective.readings import Reading
from lightdepth.detective.witnesses import PixelMap
from lightdepth.sparse_map import Keyframe, Submap

_KEYFRAMES = 12  # looked at, where patches chose none
_OF_A_KEYFRAME = 8  # points, from which their order says something
_POINTS = 300  # of a keyframe: more tell no more
_DARK, _BRIGHT = 0.02, 0.98  # beyond which a pixel has no colour
_GRAIN = 2 / 255  # added to colours, or the dark ones would be all noise
_CLEAR = 0.12  # gain, as a share of what the reading at hand lacks; right readings have at most .02, wrong ones .22
_READS = 0.4  # votes from which colours are those of the images; right ones have at least .5, other clips at most .32
_UNLIKE = 0.3


@dataclass(frozen=True, eq=False, repr=False)
class Sightings(Brief):
    """n pixels (n, 2) at which a keyframe observed a point of known colour (n, 3); rows (n, 1) of the keyframes."""

    keyframes: tuple[Keyframe, ...]
    rows: np.ndarray
    pixels: np.ndarray
    colors: np.ndarray

    def votes(self, pictures: Pictures, counting: Counting, moved: PixelMap | None = None) -> np.ndarray:
        """(n,); NaN where a frame is missing, or shows too few of the points."""
        found = np.full(len(self.rows), np.nan)
        for row in np.unique(self.rows):
            of_row, keyframe = np.flatnonzero(self.rows[:, 0] == row), self.keyframes[row]
            picture = pictures.of(counting.number(keyframe))
            if picture is None:
                continue
            pixels = self.pixels[of_row] if moved is None else moved(self.pixels[of_row])
            height, width = picture.grey.shape
            shown = picture.color_at(pixels * (width / keyframe.camera.width, height / keyframe.camera.height))
            usable = (shown.max(1) > _DARK) & (shown.max(1) < _BRIGHT)  # a NaN is not
            if usable.sum() >= _OF_A_KEYFRAME:
                own = self.colors[of_row[usable]]
                found[of_row[usable]] = 1 - 3 * np.abs(_ranks(shown[usable]) - _ranks(own)).mean(1)
        return found


def _ranks(colors: np.ndarray) -> np.ndarray:
    """(n, 3), from 0 to 1, of colours (n, 3)."""
    red, green, blue = np.log(colors + _GRAIN).T
    kinds = np.stack([red - green, blue - green, (red + green + blue) / 3], 1)
    return np.stack([_places(kind) for kind in kinds.T], 1) / (len(colors) - 1)


def _places(values: np.ndarray) -> np.ndarray:
    """(n,) of each value its place in the order, from 0; equal ones share the mean of theirs. As scipy.stats.rankdata
    less 1, whose import takes every verb half a second."""
    _, kind, counts = np.unique(values, return_inverse=True, return_counts=True)
    result: np.ndarray = (np.cumsum(counts) - (counts + 1) / 2)[kind]
    return result


def colour_sightings(submap: Submap, usable: np.ndarray, chosen: Sequence[int]) -> Sightings | None:
    """Those of the `chosen` keyframes, or where none is, of some spread over those that are `usable` (k,). None where
    the map has no colours, or hardly any."""
    if submap.colors is None or len(np.unique(submap.colors.values, axis=0)) < _OF_A_KEYFRAME:
        return None
    if not len(chosen):
        able = np.flatnonzero(usable)
        chosen = able[np.unique(np.linspace(0, len(able) - 1, _KEYFRAMES).round().astype(int))].tolist()
    rows, pixels, colors = [], [], []
    for row in chosen:
        ids, _, seen = submap.observed_points(submap.keyframes[row])
        own = submap.colors.of(ids)
        known = np.flatnonzero(np.isfinite(own).all(1))
        known = known[np.unique(np.linspace(0, len(known) - 1, min(_POINTS, len(known))).round().astype(int))]
        rows.append(np.full((len(known), 1), row))
        pixels.append(seen[known])
        colors.append(own[known])
    if sum(map(len, rows)) < LEAST_POINTS:
        return None
    return Sightings(submap.keyframes, np.concatenate(rows), np.concatenate(pixels), np.concatenate(colors))


@dataclass(frozen=True)
class Colours:
    """What the colours of a submap's points say: of the reading at hand, and of others held against it."""

    at_hand: Fit
    tried: tuple[tuple[Reading, Fit], ...] = ()

    @property
    def alike(self) -> bool:
        """Whether the images have the colours of the points."""
        return self.at_hand.likeness >= _READS

    @property
    def unlike(self) -> bool:
        """Whether they have others, by all readings."""
        return max(fit.likeness for fit in (self.at_hand, *(fit for _, fit in self.tried))) < _READS and (
            self.at_hand.likeness < _UNLIKE
        )

    @property
    def best(self) -> tuple[Reading, Fit] | None:
        """The reading by which the images clearly have them rather than as it is; None where there is none."""
        able = [(reading, fit) for reading, fit in self.tried if self.clear(fit)]
        return max(able, key=lambda tried: round(tried[1].gain, 2), default=None)

    def clear(self, fit: Fit) -> bool:
        enough = fit.keyframes >= max(3, self.at_hand.keyframes / 2)
        lacking = max(1 - self.at_hand.likeness, 0.05)
        return enough and fit.agreed and fit.gain >= _CLEAR * lacking and fit.likeness >= _READS

    def denied(self) -> set[str]:
        """Names of the readings that are worse for sure."""
        return {reading.name for reading, fit in self.tried if fit.loses} if self.alike else set()

    def record(self) -> dict[str, object]:
        """As run.json holds it."""
        return {"at_hand": self.at_hand.record(), "others": [fit.record() for _, fit in self.tried]}
