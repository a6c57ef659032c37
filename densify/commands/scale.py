"""The verb scale: millimetres per map unit from the light."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from densify.scale_file import FOLDER, figures_in, replaced
from densify.scale_run import LengthGiven, ScaleAsked
from densify.scaling import WALL_MM
from lightdepth.command_line.following import PLACES, Input, command
from lightdepth.command_line.outcome import end
from lightdepth.counting import full_stop
from lightdepth.errors import PartialFailure
from lightdepth.ranges import above
from lightdepth.reporting.run import recorded, run_folder


def scale(
    run: Path,
    light: str | None = None,
    data: Path | None = None,
    length: LengthGiven = LengthGiven(),
    wall_mm: Annotated[float, above(0)] = WALL_MM,
    output: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Millimetres per map unit of a densify run, from the light beside the lens, with an interval, or why none.

    Args:
        run: Run folder made by `lightdepth densify`, in map units.
        light: Light of the endoscope, whose position_mm matters most: a light.json or a photometric XML; left out, the
            one that the run was given, else that of its frames.
        data: Frames of the run; left out, those that the run names, where they still are.
        length: a length that is known
        wall_mm: Median distance of the wall, mm, to start from: scales are tried that make the distance 0.4 to 2.5
            times this. A larger one looks for larger scales.
        output: Folder for scale.json; left out, scale/ in the run, where `measure` finds it.
        overwrite: Replace a folder made before (scale/ in a run is replaced without asking, and the figures that were
            there are said). Figures are replaced by figures alone: where no map has one, those of before stay.
    """
    folder = output or run / FOLDER
    arguments = recorded(run=run, light=light, data=data, length=length, wall_mm=wall_mm, output=folder)
    asked = ScaleAsked.of(run, light, data, wall_mm, length)
    before: dict[int, float] = {}
    untold = ""
    try:
        with run_folder(folder, "scale", arguments, overwrite or output is None) as out:
            out.hash_inputs(data=data, light=None if light is None or "=" in light else Path(light))
            before = figures_in(folder)
            found, under = asked.told()
            untold = "" if found.told else f"no map has a scale; {found.maps[0]}"
            for one in found.maps[1 if untold else 0 :]:  # the first reason of a failure is in the last line
                (out.log if one.mm_per_unit is not None or untold else out.warn)(str(one))
            if untold and before:
                raise PartialFailure(untold)
            if changed := replaced(before, found.told):
                out.log(changed)
                out.record["replaced"] = before
            found.write_file(out.folder, "map units", under, asked.length_record(length))
            out.record["maps"] = [asdict(one) for one in found.maps]
            if untold:
                out.fail("the scale", untold, now=False)
    except PartialFailure:
        left = "keeps the figures that it had" if before else "has the reason of each map"
        raise PartialFailure(f"{full_stop(untold)} {folder} {left}") from None
    end(folder, then=command("measure", Input("RUN", run), options={"--points": PLACES}))
