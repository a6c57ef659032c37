"""Why a frame found no place in a sparse map: what its image is like, what it matched, and how.

The likeliest reason is the first that holds, from the image to the geometry: too dark, saturated, blurred, few
features, no matches, no parallax, no agreement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lightdepth.image_quality import Measures

# What is below or above these is given as the reason. They choose words and change no map: nobody would set them.
_DARK = 25.0  # mean of the brightest channel, 0..255
_SATURATED = 0.4  # share of white pixels
_BLURRED = 0.5  # share of the sharpness that mapped frames have
_FEATURES = 60  # in the image
_MATCHES = 15  # with any other frame


@dataclass(frozen=True)
class Matching:
    """What matching found: features (n,) of each frame; verified pairs of frames (m, 2), their matches (m,), and
    whether a turn or a plane explains them (m,)."""

    features: np.ndarray
    pairs: np.ndarray
    matches: np.ndarray
    flat: np.ndarray


def reasons(measures: Measures, matching: Matching, mapped: np.ndarray) -> list[str]:
    """The likely reason for each frame (n,) that is not mapped (n,) bool; "" for those that are."""
    sharp = measures.sharpness[mapped] if mapped.any() else measures.sharpness
    sharp = sharp[np.isfinite(sharp)]
    # Without any mapped frame the sharpest have to say what is sharp.
    usual = float(np.median(sharp) if mapped.any() else np.quantile(sharp, 0.9)) if len(sharp) else 0.0
    best, flat = _best_matches(matching, len(mapped))
    return ["" if mapped[i] else _reason(i, measures, matching, usual, best[i], flat[i]) for i in range(len(mapped))]


def _best_matches(matching: Matching, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The most matches of each frame with any other (n,), and the share of its good pairs that are flat (n,)."""
    best, good, flat = np.zeros(count, int), np.zeros(count), np.zeros(count)
    for side in (0, 1):
        np.maximum.at(best, matching.pairs[:, side], matching.matches)
        many = matching.matches >= _MATCHES
        np.add.at(good, matching.pairs[many, side], 1)
        np.add.at(flat, matching.pairs[many, side], matching.flat[many])
    return best, flat / np.maximum(good, 1)


def _reason(i: int, measures: Measures, matching: Matching, usual: float, best: int, flat: float) -> str:
    brightness, white, sharpness = measures.brightness[i], measures.saturated[i], measures.sharpness[i]
    if not np.isfinite(brightness):
        return "nothing of it is inside the mask"
    if brightness < _DARK:
        return f"too dark: mean brightness {brightness:.0f} of 255"
    if white > _SATURATED:
        return f"saturated: {white:.0%} of its pixels are white"
    if sharpness < _BLURRED * usual:
        return f"blurred: {sharpness / usual:.0%} of the sharpness of the mapped frames"
    if matching.features[i] < _FEATURES:
        return f"few features: {matching.features[i]}"
    if best < _MATCHES:
        return f"no matches: {best} at most with any other frame"
    if flat > 0.5:
        return f"no parallax: a turn or a plane explains {flat:.0%} of its matched pairs"
    return f"no agreement: up to {best} matches with another frame, which fit no place in a map"


def summary(found: Sequence[str]) -> str:
    """Kinds of reasons with their counts, the most frequent first: "12 blurred, 3 too dark"."""
    kinds, counts = np.unique([r.split(":")[0] for r in found if r], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return ", ".join(f"{counts[k]} {kinds[k]}" for k in order)
