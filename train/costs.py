"""About how long training takes, for a dry run: a step and a colon are tried on the spot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from torch import Tensor

from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.frame import FrameBatch
from lightdepth.module import LightDepth
from lightdepth.reporting.plan import timed

from .colons import SceneMaker, TubeData, tube_scene, val_scene
from .datamodule import FrameDataModule
from .frame_sets import Opened
from .loader import collate

_UPDATE = 1.1
"""A step, with the change of the weights and what is logged, over its loss and gradient."""


def step_seconds(loss: Callable[[FrameBatch], Tensor], frame: FrameBatch, batch_size: int) -> float:
    """Seconds of a training step on a batch of copies of a frame. Leaves gradients behind."""
    batch = collate([frame] * batch_size)
    return _UPDATE * timed(lambda: loss(batch).backward())  # type: ignore[no-untyped-call]  # torch has no annotation


def training_steps(
    model: LightDepth, data: FrameDataModule, opened: Opened, options: Mapping[str, object], done: int = 0
) -> list[Step]:
    """Colons and steps, of which so many are done, of a run whose sequences are opened. The model is no good
    afterwards."""
    colons, frame = _colons(data)
    frame = opened.first() or frame
    if frame is None:
        return [Step("training: none of the first frames can be read")]
    each = step_seconds(lambda batch: model.batch_loss(batch)[0], frame, data.batch_size)
    count, epochs = options.get("max_steps"), options.get("max_epochs")
    in_epoch = max(1, opened.counts(data.tube)["train"] // data.batch_size)
    limits = [count] if isinstance(count, int) and count >= 0 else []
    limits += [epochs * in_epoch] if isinstance(epochs, int) and epochs >= 0 else []
    if not limits:
        return [*colons, Step("training, without a last step")]
    steps = max(0, min(limits) - done)
    return [*colons, Step(f"{counted(steps, 'step')} of {counted(data.batch_size, 'frame')}", steps * each)]


def _colons(data: FrameDataModule) -> tuple[list[Step], FrameBatch | None]:
    """What rendering the colons takes, and a frame of one; None where there are none."""
    kinds: list[tuple[int, SceneMaker, str]] = [
        (data.tube.scenes, tube_scene, "to train on"),
        (data.tube.val_scenes, val_scene, "to validate on"),
    ]
    steps, frame = [], None
    for scenes, make, purpose in kinds:
        if scenes:
            seconds, frame = _colon(make, data.tube, data.size)
            steps.append(Step(f"rendering {counted(scenes, 'synthetic colon')} {purpose}", scenes * seconds))
    return steps, frame


def _colon(make: SceneMaker, tube: TubeData, size: tuple[int, int]) -> tuple[float, FrameBatch]:
    """Seconds of a colon, by one of one frame and one of three; and a frame."""
    made: list[FrameBatch] = []

    def seconds(frames: int) -> float:
        return timed(lambda: made.extend(make(replace(tube, frames=frames), 0, 0, size)))

    one, three = seconds(1), seconds(3)
    return one + max(0.0, three - one) / 2 * (tube.frames - 1), made[0]
