"""A keyframe brought into the map: aligned by itself, then together with the others of its submap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from densify.agreement import View, agree
from densify.alignment import Alignment, AlignmentConfig, align, bent
from densify.bending import Bend
from densify.config import MethodConfig
from densify.predictions import SeenKeyframe
from lightdepth.observations import ObservedDistances, observed_distances, unobserved
from lightdepth.sparse_map import Keyframe, Submap


@dataclass(frozen=True)
class AlignedKeyframe:
    """A keyframe, its alignment (or the reason why there is none), and what that rests on."""

    keyframe: Keyframe
    alignment: Alignment
    observed: ObservedDistances | None = None
    """all points that it observed, with their predicted distances; None where its image is not there"""
    withheld: ObservedDistances | None = None
    """those of them that took no part in the alignment"""
    view: View | None = None
    """what the agreement of keyframes sees of it"""
    bend: Bend | None = None
    """the field that the agreement found for it, also where the alignment does not trust it"""
    stays: np.ndarray | None = None
    """share (h, w) in {0, 1} of its pixels, coarsely, that no nearer keyframe contradicts; None is all of them"""

    def unread(self, reason: str) -> AlignedKeyframe:
        """The keyframe where its image cannot be read (any more)."""
        return AlignedKeyframe(self.keyframe, Alignment(self.keyframe.name, reason=reason))


def align_alone(
    keyframe: Keyframe,
    submap: Submap,
    seen: SeenKeyframe,
    config: AlignmentConfig,
    withhold: float = 0.0,
    seed: int = 0,
) -> AlignedKeyframe:
    """One scale for one keyframe, by the points that it observed less a share that is withheld."""
    prediction = seen.prediction
    if prediction is None:
        return AlignedKeyframe(keyframe, Alignment(keyframe.name, reason=seen.reason))
    observed = observed_distances(keyframe, submap, prediction)
    used, withheld = split_withheld(observed, withhold, [seed, submap.id, keyframe.number])
    alignment = align(keyframe.name, used, config)
    if not alignment.ok and len(used) < config.min_points:
        lost = unobserved(keyframe, submap, prediction)
        alignment = replace(alignment, reason="; ".join(filter(None, [alignment.reason, lost])))
    return AlignedKeyframe(
        keyframe, alignment, observed, withheld, View.of(keyframe, used, prediction, alignment.scale)
    )


def align_together(
    keyframes: Sequence[AlignedKeyframe], shared: np.ndarray, config: MethodConfig
) -> list[AlignedKeyframe]:
    """The same keyframes, with the depth of those that are aligned bent until they agree on the map's points and on the
    tissue that they see together. `shared` (n, n) counts the points that two keyframes share (sparse_map.covisibility).
    """
    rows = [i for i, each in enumerate(keyframes) if each.alignment.ok]
    views = [view for i in rows if (view := keyframes[i].view) is not None]
    bends = agree(views, shared[np.ix_(rows, rows)], config.agreement, config.bending) if rows else []
    together = list(keyframes)
    for i, view, bend in zip(rows, views, bends, strict=True):
        alignment = together[i].alignment
        if config.agreement.on:
            alignment = bent(alignment, bend, view.observed, config.alignment)
        together[i] = replace(together[i], alignment=alignment, bend=bend)
    return together


def split_withheld(
    observed: ObservedDistances, share: float, seed: Sequence[int]
) -> tuple[ObservedDistances, ObservedDistances]:
    """The points that take part in the alignment, and those kept back to judge the surface by."""
    back = np.random.default_rng(list(seed)).random(len(observed)) < share
    return observed.subset(~back), observed.subset(back)
