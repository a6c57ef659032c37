"""Which submaps meet: every way is tried between those that are not yet together, the strongest first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from densify.dense_map import DenseMap
from densify.joining.join import Join, MergeConfig
from densify.joining.side import Side
from densify.joining.ways import FINDERS
from densify.similarity import Similarity
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError


@dataclass(frozen=True)
class Meeting:
    """What came of it: groups of submaps, each {id: group_from_submap} in the unit of its largest, which comes first;
    the joins that hold them together; and those refused between submaps that stayed apart."""

    groups: tuple[dict[int, Similarity], ...]
    joins: tuple[Join, ...]
    refused: tuple[Join, ...]

    def alone(self) -> dict[int, str]:
        """Submaps that found no other, with the reasons."""
        reasons = {}
        for group in self.groups:
            if len(group) == 1:
                (own,) = group
                tried = [j for j in self.refused if own in (j.target, j.source)]
                texts = [f"map {j.source if j.target == own else j.target} by {j.by}: {j.reason}" for j in tried]
                reasons[own] = "; ".join(texts) or "it has nothing that could be compared with another map"
        return reasons


def join_maps(
    maps: Sequence[DenseMap], frames: FrameSequence | None, config: MergeConfig, rng: np.random.Generator
) -> Meeting:
    """Brings together the submaps that see the same tissue. Without frames, or without surfaces, what needs them is
    not tried."""
    sides = {m.submap.id: Side(m, frames, config) for m in maps}
    order = sorted(sides, key=lambda i: (-len(sides[i].submap.keyframes), i))
    group_of = {i: {i: Similarity.identity()} for i in order}
    joins: list[Join] = []
    refused: list[Join] = []
    for by in config.by:
        pairs = sorted(combinations(order, 2), key=lambda pair: _apart(sides[pair[0]], sides[pair[1]]))
        tried = 0
        for target, source in pairs:
            if group_of[target] is group_of[source]:
                continue
            tried += by in ("looks", "surface")
            if tried > config.max_pairs:
                refused.append(Join(target, source, by, reason=f"not compared, beyond max_pairs {config.max_pairs}"))
                continue
            join: Join | None
            try:
                join = FINDERS[by](sides[target], sides[source], rng)
            except InputError as error:  # a map without observations, say: the others go on
                join = Join(target, source, by, reason=str(error))
            if join is None:
                continue
            if not join.ok:
                refused.append(join)
                continue
            joins.append(join)
            assert join.target_from_source is not None
            first, second = group_of[target], group_of[source]
            link = first[target] @ join.target_from_source @ second[source].inverse()
            first.update({i: link @ own for i, own in second.items()})
            group_of.update(dict.fromkeys(second, first))
    groups = list({id(g): g for g in group_of.values()}.values())
    apart = [j for j in refused if group_of[j.target] is not group_of[j.source]]
    return Meeting(tuple(_to_largest(g, order) for g in groups), tuple(joins), tuple(apart))


def _apart(one: Side, other: Side) -> int:
    """Frames between two submaps; 0 where their times overlap."""
    (a0, a1), (b0, b1) = ((min(s.by_number), max(s.by_number)) for s in (one, other))
    return max(0, b0 - a1, a0 - b1)


def _to_largest(group: dict[int, Similarity], order: Sequence[int]) -> dict[int, Similarity]:
    first = next(i for i in order if i in group)
    back = group[first].inverse()
    return {first: Similarity.identity(), **{i: back @ s for i, s in group.items() if i != first}}
