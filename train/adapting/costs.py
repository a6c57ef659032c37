"""About how long adapting takes, for a dry run: a step is tried on the spot."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.frame import FrameBatch, to_batch
from lightdepth.models import NetworkModel, working_size
from lightdepth.reporting.plan import seconds_each, times
from lightdepth.sparse_map import SparseMap

from ..costs import step_seconds
from .config import AdaptConfig

_JUDGED = 2
"""Times that the frames that judge are predicted: before and after."""


def learned_from(training: FrameSequence, held: FrameSequence, sparse_map: SparseMap | None) -> str:
    """What a network would learn from, in words."""
    known = "no map" if sparse_map is None else f"a map of {counted(len(sparse_map.submaps), 'submap')}"
    return f"{counted(len(training), 'frame')} of {training.source} to learn from, {len(held)} held out, with {known}"


def adapting_steps(
    source: SequenceSource,
    more: Sequence[Path],
    training: FrameSequence,
    held: FrameSequence,
    config: AdaptConfig,
    start: NetworkModel,
) -> list[Step]:
    """The other sequences, which are opened for it, the steps, and the judgements."""
    others = [replace(source, data=path).open() for path in more]
    besides = "".join(f", of {counted(len(each), 'frame')} of {each.source} too" for each in others)
    size = config.size or working_size(training.first().camera, start.rows)
    network = deepcopy(start.network).requires_grad_(True)

    def loss(batch: FrameBatch) -> Tensor:
        distance = network.estimate(batch.image, batch.mask, batch.rays, batch.light)[0]
        return distance.log().mean()

    each = step_seconds(loss, to_batch(training.first(), size).to(start.device), config.batch_size)
    judged = seconds_each(training, start)
    trained = f"{counted(config.steps, 'step')} of {counted(config.batch_size, 'frame')}{besides}"
    return [
        Step(trained, config.steps * each),
        Step("judging before and after, by frames held out", times(_JUDGED * len(held), judged)),
        Step("a light or a map, where they have to be found"),
    ]
