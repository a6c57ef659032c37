"""The verb live: a sequence against the clock."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from shlex import quote
from typing import Annotated

from densify.config import LiveConfig
from densify.costs import surface_steps, surfaces_of
from densify.inputs import MapSource, doubts_of_inputs, fitted_light, map_and_frames
from densify.live.play import play
from densify.live.record import PlayedRun
from densify.thumbnails import images_alone
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.datasets import SequenceSource
from lightdepth.errors import InputError
from lightdepth.ranges import above, at_least
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.sfm.config import SfmConfig


def live(
    source: Group[SequenceSource],
    output: Path,
    mapped: Group[MapSource] = MapSource(),
    predicting: Group[ModelSource] = ModelSource(),
    rate: Annotated[float | None, at_least(0.01, up_to=10_000)] = None,
    budget_ms: Annotated[float, above(0)] = 200.0,
    config: Group[LiveConfig] = LiveConfig(),
    sfm: SfmConfig = SfmConfig(),
    mm_per_unit: Annotated[float | None, above(0)] = None,
    fit_light: bool = True,
    overwrite: bool = False,
) -> None:
    """Plays a sequence against the clock: surfaces that grow keyframe by keyframe, and where their time goes.

    Args:
        output: Run folder to make, with the surfaces and the timings.
        rate: Number of keyframes that arrive per second, whether or not the last is done; left out, each arrives when
            the last is done. More leave less time for each: late ones queue, none is dropped.
        budget_ms: Time within which a keyframe counts as in time, from its image to the renewed surface, milliseconds;
            only the report uses it. A larger one counts more keyframes as in time.
        sfm: how frames are mapped when there is no map
        mm_per_unit: Millimetres per map unit, where known: lengths and surfaces are then written in mm, else in map
            units. It is one factor for all submaps, right for those that share a unit. A larger one makes a larger
            surface.
        fit_light: Where neither --light nor the folder gives the light, fit it on the map before the clock starts, and
            use it if its depth fits hidden blocks of wall better; switched off, a usual light is assumed.
        overwrite: Replace a run made before.
    """
    if not budget_ms > 0:
        raise InputError("--budget-ms", f"{budget_ms}", "expected milliseconds above 0")
    if rate is not None and not rate > 0:
        raise InputError("--rate", f"{rate}", "expected keyframes per second, above 0")
    model = predicting.load(details=False)
    arguments = recorded(
        source,
        mapped,
        predicting,
        config,
        output=output,
        rate=rate,
        budget_ms=budget_ms,
        sfm=sfm,
        mm_per_unit=mm_per_unit,
        fit_light=fit_light,
    )
    with run_folder(output, "live", arguments, overwrite) as run:
        sparse_map, frames = map_and_frames(run, source, mapped, sfm)
        run.hash_inputs(**source.files, map=mapped.map)
        doubts = doubts_of_inputs(run, sparse_map, frames)
        steps = partial(surface_steps, sparse_map, frames, model, fit_light, mapped.polish_map)
        run.begins(surfaces_of(sparse_map, frames), steps)
        frames = fitted_light(run, frames, sparse_map, model, config, fit_light)
        result = PlayedRun(run, config.coverage, mm_per_unit, config.judge.on, doubts)
        with Progress("Playing", sum(len(s.keyframes) for s in sparse_map.submaps)) as bar:
            played = play(frames, sparse_map, model, config, result.add, rate, lambda _: bar.advance())
        result.finish(played, model.name, rate, budget_ms, images_alone(frames, sparse_map))
    end(output, then=f"lightdepth view {quote(str(output))}", page=output / "report.html")
