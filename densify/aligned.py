"""A keyframe brought into the map: aligned by itself, then together with the others of its submap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from densify.agreement import View, agree
from densify.alignment import Alignment, AlignmentConfig, align, bent
from densify.bending import Bend
from densify.config import MethodConfig
from densify.contradiction import ContradictionConfig, uncontradicted
from densify.gating import LEFT_OUT, GateConfig
from densify.predictions import SeenKeyframe
from lightdepth.observations import ObservedDistances, observed_distances, unobserved
from lightdepth.sparse_map import Keyframe, Submap

_MOST_DOUBTED = 0.5  # share of a submap's keyframes that may be left out; where more are doubted, the wall is as it is

_FINER_ROUNDS = 3  # from fields that agree: more change them by .002 (RMS of log distance; the grid adds .005)


@dataclass(frozen=True)
class AlignedKeyframe:
    """A keyframe, its alignment (or the reason why there is none), and what that rests on."""

    keyframe: Keyframe
    alignment: Alignment
    observed: ObservedDistances | None = None
    """all points that it observed, with their predicted distances; None where its image is not there"""
    view: View | None = None
    """what the agreement of keyframes sees of it"""
    bend: Bend | None = None
    """the field that the agreement found for it, also where the alignment does not trust it"""
    alone: Alignment | None = None
    """its one scale, from before it was bent; None where nothing was"""
    stays: np.ndarray | None = None
    """share (h, w) in [0, 1], coarsely, of its weight that each pixel keeps where nearer keyframes contradict it; None
    is all of it"""

    def unread(self, reason: str) -> AlignedKeyframe:
        """The keyframe where its image cannot be read (any more)."""
        return AlignedKeyframe(self.keyframe, Alignment(self.keyframe.name, reason=reason))


def align_alone(
    keyframe: Keyframe,
    submap: Submap,
    seen: SeenKeyframe,
    config: AlignmentConfig,
) -> AlignedKeyframe:
    """One scale for one keyframe, by the points that it observed."""
    prediction = seen.prediction
    if prediction is None:
        return AlignedKeyframe(keyframe, Alignment(keyframe.name, reason=seen.reason))
    observed = observed_distances(keyframe, submap, prediction)
    alignment = align(keyframe.name, observed, config)
    if not alignment.ok and len(observed) < config.min_points:
        lost = unobserved(keyframe, submap, prediction)
        alignment = replace(alignment, reason="; ".join(filter(None, [alignment.reason, lost])))
    return AlignedKeyframe(keyframe, alignment, observed, View.of(keyframe, observed, prediction, alignment.scale))


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
        alone = alignment = together[i].alignment
        if config.agreement.on:
            alignment = bent(alone, bend, view.observed, config.alignment)
        together[i] = replace(together[i], alignment=alignment, bend=bend, alone=alone)
    return together


def bent_finer(keyframes: Sequence[AlignedKeyframe], shared: np.ndarray, config: MethodConfig) -> dict[str, Bend]:
    """The bends of keyframes that are aligned together, by name, with the finer grid among their bumps."""
    rows = [i for i, each in enumerate(keyframes) if each.view is not None and each.bend is not None and each.alone]
    views = [view for i in rows if (view := keyframes[i].view) is not None]
    start = [bend.with_finer() for i in rows if (bend := keyframes[i].bend) is not None]
    finer = config.bending.with_finer()
    agreement = replace(config.agreement, rounds=min(_FINER_ROUNDS, config.agreement.rounds))
    bends = agree(views, shared[np.ix_(rows, rows)], agreement, finer, start) if rows else []
    return {keyframes[i].keyframe.name: bend for i, bend in zip(rows, bends, strict=True)}


def uncontradicted_keyframes(
    keyframes: Sequence[AlignedKeyframe], shared: np.ndarray, config: ContradictionConfig
) -> list[AlignedKeyframe]:
    """The same keyframes, each with the map of its pixels that no nearer keyframe contradicts."""
    used = [(i, k.view, k.bend) for i, k in enumerate(keyframes) if config.on and k.view and k.bend]
    rows, views, bends = zip(*used, strict=True) if used else ((), (), ())
    stays = dict(zip(rows, uncontradicted(views, bends, shared[np.ix_(rows, rows)], config), strict=True))
    return [replace(k, stays=stays.get(i)) for i, k in enumerate(keyframes)]


def undoubted(
    keyframes: Sequence[AlignedKeyframe], doubts: Mapping[str, str], config: GateConfig
) -> list[AlignedKeyframe]:
    """The same keyframes; where the gate is on, those that are doubted have the doubt (by name) as their reason to be
    left out, unless they are more than half."""
    if not config.on or len(doubts) > _MOST_DOUBTED * len(keyframes):
        return list(keyframes)
    return [_left_out(k, doubts.get(k.keyframe.name, "")) for k in keyframes]


def _left_out(aligned: AlignedKeyframe, doubt: str) -> AlignedKeyframe:
    if not doubt or not aligned.alignment.ok:
        return aligned
    return replace(aligned, alignment=replace(aligned.alignment, reason=f"{LEFT_OUT}: {doubt}"))


def unread(keyframes: Sequence[AlignedKeyframe]) -> dict[str, str]:
    """Keyframes whose image is missing or unreadable, with the reason."""
    return {k.keyframe.name: k.alignment.reason for k in keyframes if k.view is None}
