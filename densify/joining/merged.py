"""The submaps of a run, joined and made dense as one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from densify.config import DensifyConfig
from densify.joining.join import Join, MergeConfig
from densify.joining.meeting import Meeting, join_maps
from densify.joining.submap import joined_submap
from densify.pipeline import OnKeyframe, SubmapResult, densify
from densify.predictions import Predictor
from densify.similarity import Similarity
from lightdepth.datasets import FrameSequence
from lightdepth.sparse_map import SparseMap


@dataclass(frozen=True)
class Merged:
    """How the submaps met, and the surface of each group of several, its submap numbered by its place in `results`."""

    meeting: Meeting
    results: tuple[SubmapResult, ...]

    @property
    def groups(self) -> list[dict[int, Similarity]]:
        return [g for g in self.meeting.groups if len(g) > 1]

    def record(self, unit: Callable[[int], float] = lambda map_id: 1.0) -> dict[str, object]:
        """For run.json. A transform is as `evaluate --join` reads it: X_second = scale · rotation X_first +
        translation, where the unit of a map, by its id, is written as `unit`."""
        joined = [_joined(result, g, unit) for result, g in zip(self.results, self.groups, strict=True)]
        joins = [{**asdict(replace(j, target_from_source=None)), "ok": j.ok} for j in self.tried]
        return {"joined": joined, "joins": joins, "alone": self.meeting.alone()}

    @property
    def tried(self) -> tuple[Join, ...]:
        return *self.meeting.joins, *self.meeting.refused


def joined_name(result: SubmapResult) -> str:
    return f"joined_{result.dense.submap.id:03d}"


def _joined(result: SubmapResult, group: Mapping[int, Similarity], unit: Callable[[int], float]) -> dict[str, object]:
    first = next(iter(group))
    transforms = [
        {"first": i, "second": first, **_numbers(s, unit(i), unit(first))} for i, s in group.items() if i != first
    ]
    return {"folder": joined_name(result), "maps": list(group), "unit_of": first, "transforms": transforms}


def _numbers(s: Similarity, first: float, second: float) -> dict[str, object]:
    """Of what takes coordinates in one written unit to another."""
    scale = s.scale if first == second else s.scale * second / first
    return {"scale": scale, "rotation": s.rotation.tolist(), "translation": (second * s.translation).tolist()}


def merge(
    results: Sequence[SubmapResult],
    frames: FrameSequence,
    model: Predictor,
    recipe: DensifyConfig,
    config: MergeConfig,
    on_keyframe: OnKeyframe | None = None,
) -> Merged:
    """Joins the submaps of a run, and makes each group of several dense as one."""
    rng = np.random.default_rng([recipe.judge.seed, 2])
    by_id = {r.dense.submap.id: r.dense.submap for r in results}
    meeting = join_maps([r.dense for r in results], frames, config, rng)
    groups = [g for g in meeting.groups if len(g) > 1]
    submaps = tuple(joined_submap([by_id[i] for i in g], g, k, config) for k, g in enumerate(groups))
    if not submaps:
        return Merged(meeting, ())
    joined = densify(frames, SparseMap(submaps, "joined maps"), model, recipe, on_keyframe)
    return Merged(meeting, tuple(joined))
