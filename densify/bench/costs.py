"""About how long a benchmark takes, for a dry run, by the table of what surfaces cost (densify.costs)."""

from __future__ import annotations

from densify.bench.completion.scenes import completion_scenes
from densify.bench.scenes import scenes
from densify.bench.work import BenchConfig
from densify.costs import known_cost
from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.judge_colons import JUDGE_COLONS
from lightdepth.reporting.plan import Work, slowness

_COLON_FRAME, _COLON_JUDGED, _COLON_SPOILT = 4.0, 0.3, 8.0
"""Seconds of a frame of the judge's colons, on the machine of the tables: rendered; judged, and spoilt too, by a
model."""
_JUDGED = 2.3
"""How many times longer a keyframe takes whose surface is judged against the truth, in maps as long as these."""
_COMPLETED = 3.0
"""How many times longer a keyframe takes that is completed in every way than one that is made dense."""


def bench_plan(config: BenchConfig) -> tuple[str, Work]:
    """What a run of the benchmark is of, and its steps."""
    chosen = scenes(config.size, config.first_seed)
    keyframes, rows = sum(s.keyframes for s in chosen), sum(config.rows_of(s) for s in chosen)
    fused = sum(config.rows_of(s) * s.keyframes for s in chosen)
    models = counted(len(config.checkpoints), "model")
    what = (
        f"{counted(len(chosen), 'scene')} with {counted(keyframes, 'keyframe')}, {models}: {counted(rows, 'surface')}"
    )
    width, height = config.image_size
    made = f"rendering {counted(keyframes, 'keyframe')}, and {fused} made dense, {width}x{height}"
    worth = keyframes + _JUDGED * fused
    return what, lambda: [Step(made, known_cost().cost.of(worth, width * height / 1e6, 0))]


def per_frame_plan(models: int, rendered: bool, spoilt: bool) -> tuple[str, Work]:
    """What `bench per-frame` is of, and its steps."""
    count = sum(colon.frames for colon in JUDGE_COLONS)
    what = f"{counted(count, 'frame')} of {len(JUDGE_COLONS)} colons, {counted(models, 'model')}"

    def steps() -> list[Step]:
        each = models * (_COLON_JUDGED + _COLON_SPOILT * spoilt)
        first = [Step(f"rendering {counted(count, 'frame')}", slowness() * count * _COLON_FRAME)] if rendered else []
        return [*first, Step(f"judging {counted(count, 'frame')}", slowness() * count * each)]

    return what, steps


def completion_plan(errors: int, image_size: tuple[int, int]) -> tuple[str, Work]:
    """What `bench completion` is of, and its steps."""
    chosen = completion_scenes()
    keyframes = errors * sum(scene.keyframes for scene in chosen)
    what = f"{len(chosen)} colons, {counted(errors, 'map')} of each: {counted(keyframes, 'keyframe')} to be completed"
    step, megapixels = f"completing {counted(keyframes, 'keyframe')} in every way", image_size[0] * image_size[1] / 1e6
    return what, lambda: [Step(step, known_cost().cost.of(_COMPLETED * keyframes, megapixels, 0))]
