"""`bench speed`: how far every stage is from what this machine allows, and what procedures cost by it."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import torch

from densify.bench.files import write_json, write_tables
from densify.speed.machine import machines_of, threads
from densify.speed.runs import Size, colons_of
from densify.speed.tables import notes, record, tables
from densify.speed.work import measured, parts
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.dry import Step
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.counting import counted
from lightdepth.errors import InputError
from lightdepth.models import NetworkModel
from lightdepth.ranges import above, at_least
from lightdepth.reporting.plan import slowness
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.record import git_revision, versions
from lightdepth.reporting.run import recorded, run_folder

_SIZES: tuple[Size, ...] = ((320, 256), (640, 512))
_PART = 2.0
"""Seconds of a part besides its timing, on the machine of the tables: colons, first times, whole runs."""


def measure_speed(
    output: Path = Path("runs/speed"),
    predicting: Group[ModelSource] = ModelSource(),
    image_sizes: Annotated[tuple[tuple[int, int], ...], at_least(64, up_to=4096)] = _SIZES,
    keyframes: Annotated[int, at_least(4, up_to=1000)] = 10,
    seconds: Annotated[float, above(0, up_to=3600)] = 0.7,
    overwrite: bool = False,
) -> None:
    """Each stage beside the least time it could take here and a plain reference, whole runs, and what procedures cost.

    Args:
        output: Folder to make, with speed.json, .md and report.html. Where it is runs/speed, dry runs in the same
            folder take their times from it; LIGHTDEPTH_SPEED names another speed.json.
        image_sizes: Widths and heights of the frames, pixels, each measured on its own; a whole run is made at twice
            the last one as well. Larger ones and more take longer; costs of other sizes are computed from these.
        keyframes: Number of keyframes of the map that is made for each size; the first size has a second map, with
            twice as many. More tell better what a keyframe costs and take longer.
        seconds: Time for which a stage and its reference are timed in turns, seconds, for each size; slow ones are
            timed three times whatever that takes. More make the medians more certain.
        overwrite: Replace a run made before.
    """
    arguments = recorded(predicting, output=output, image_sizes=image_sizes, keyframes=keyframes, seconds=seconds)
    if not image_sizes or len(set(image_sizes)) < len(image_sizes):
        raise InputError("--image-sizes", f"{list(image_sizes)}", "expected at least one, and none twice")
    model = predicting.load(details=False)
    count = parts(image_sizes, model)
    with run_folder(output, "bench speed", arguments, overwrite) as run:
        run.hash_inputs(checkpoint=Path(predicting.checkpoint))
        shown = ", ".join(f"{width}x{height}" for width, height in image_sizes)
        whole = counted(len(colons_of(image_sizes, keyframes)), "whole run")
        what = f"stages of densify at {shown}, and {whole}, would be timed"
        slow = slowness()
        taken = count * (seconds + _PART * slow)
        run.begins(what, lambda: [Step(f"timing {counted(count, 'part')}", taken)])
        machines = machines_of(model.device if isinstance(model, NetworkModel) else torch.device("cpu"))
        with TemporaryDirectory() as made, Progress("Speed", count) as bar:
            found = measured(image_sizes, keyframes, model, predicting, machines, seconds, Path(made), bar.advance)
        said = notes(machines, threads(), model.name, found[1])
        made_by = {"versions": versions(), "revision": git_revision(), "notes": said}
        write_json(run, "speed.json", record(machines, threads(), slow, *found) | made_by)
        write_tables(run, "speed", "Speed beside what the machine allows", tables(*found), said, [])
    end(output, then="lightdepth densify DATA -o OUT --dry-run", page=output / "report.html")
