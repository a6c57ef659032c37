"""About how long surfaces take, for a dry run: the model is timed on a keyframe, what follows is by a table."""

from __future__ import annotations

from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence
from lightdepth.models import DepthModel
from lightdepth.reporting.plan import seconds_each, slowness, times
from lightdepth.sparse_map import SparseMap

_KEYFRAME, _MEGAPIXEL = 0.15, 9.0
"""Seconds of a keyframe besides its prediction, on the machine of the tables, and more by its pixels: alignment, judge,
fusion, extraction."""
_LIGHT = 26 * 3
"""Predictions that finding a light on the map takes at the most: keyframes, by as many lights."""


def keyframe_seconds(width: int, height: int) -> float:
    """Of a keyframe of that size that is made dense, its prediction left out."""
    return _KEYFRAME + _MEGAPIXEL * width * height / 1e6


def surfaces_of(sparse_map: SparseMap, frames: FrameSequence) -> str:
    """What surfaces would be made of, in words."""
    submaps = sparse_map.submaps
    keyframes, points = sum(len(s.keyframes) for s in submaps), sum(len(s.points) for s in submaps)
    made = f"{counted(len(submaps), 'submap')} with {counted(keyframes, 'keyframe')} and {counted(points, 'point')}"
    return f"{made}, of {counted(len(frames), 'frame')} of {frames.source}, would be made dense"


def surface_steps(
    sparse_map: SparseMap, frames: FrameSequence, model: DepthModel, fit_light: bool = False, polish: bool = False
) -> list[Step]:
    """The poses where they are polished, prediction, the light where it is to be found, and the surfaces."""
    keyframes = [k for s in sparse_map.submaps for k in s.keyframes if k.number in frames.numbers]
    count, camera = len(keyframes), keyframes[0].camera
    some = dict.fromkeys(frames.numbers.index(k.number) for k in keyframes[:5])
    each = seconds_each(frames.at(list(some)), model)
    steps = [Step(f"polishing the poses of {counted(count, 'keyframe')}")] * polish
    steps.append(Step(f"predicting {counted(count, 'keyframe')} by {model.name}", times(count, each)))
    if fit_light and frames.first().light.assumed:
        steps.append(Step("finding the light on the map, at the most", times(min(_LIGHT, 3 * count), each)))
    fused = slowness() * count * keyframe_seconds(camera.width, camera.height)
    steps.append(Step(f"aligning, judging and fusing {counted(count, 'keyframe')}", fused))
    return steps
