"""Whole runs of densify, timed: what the model of cost rests on (densify.costs)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from densify.config import DensifyConfig
from densify.costs import WholeRun
from densify.dense_run import Asked, dense_run, unheard
from densify.inputs import MapSource, SurfaceFiles
from densify.joining import MergeConfig
from lightdepth.checkpoint import ModelSource
from lightdepth.datasets import SequenceSource
from lightdepth.files.schema import read_json
from lightdepth.models import DepthModel
from lightdepth.sfm.config import SfmConfig

Size = tuple[int, int]


@dataclass(frozen=True)
class Colon:
    """A colon that a whole run is made of."""

    size: Size
    keyframes: int
    staged: bool
    """whether its stages are timed too"""


def colons_of(sizes: Sequence[Size], keyframes: int) -> list[Colon]:
    """Each size; the first with twice as many keyframes, so that what a run and what a keyframe takes can be told
    apart; and the last at twice its width and height, as frames of endoscopes are large."""
    (width, height), more = sizes[-1], Colon(sizes[0], 2 * keyframes, False)
    return [*(Colon(size, keyframes, True) for size in sizes), more, Colon((2 * width, 2 * height), keyframes, False)]


def whole_run(colon: Path, output: Path, model: DepthModel, predicting: ModelSource) -> WholeRun:
    """Makes the run folder `output` of a colon (densify.speed.given.write_colon) and its map, by usual settings."""
    asked = Asked(
        source=SequenceSource(colon),
        mapped=MapSource(map=colon / "slam"),
        predicting=predicting,
        config=DensifyConfig(),
        sfm=SfmConfig(),
        files=SurfaceFiles(),
        fit_light=False,
        merge=False,
        merging=MergeConfig(),
    )
    start, used = time.perf_counter(), time.process_time()
    with unheard(["lightdepth", "bench", "speed"], ""):
        dense_run(asked, model, output)
    seconds, processor = time.perf_counter() - start, time.process_time() - used
    (made,) = read_json(output / "run.json")["maps"]
    camera = SequenceSource(colon).open().image_size()
    return WholeRun(
        size=camera,
        keyframes=made["keyframes"],
        seconds=seconds,
        processor=processor,
        bytes=sum(file.stat().st_size for file in output.rglob("*") if file.is_file()),
        steps=made["seconds"],
    )
