"""The verb measure: lengths and areas."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np

from densify.evaluation.judged_map import read_run
from densify.measure import chosen_map, measured, places_in_frame, run_unit
from densify.scale_file import scale_of
from lightdepth.command_line.following import Input, command
from lightdepth.command_line.outcome import end, outcome
from lightdepth.errors import InputError
from lightdepth.files.replacing import check_rewritable
from lightdepth.files.writing import write_whole
from lightdepth.ranges import ANY, above, at_least
from lightdepth.reporting.names import told
from lightdepth.reporting.run import plain


def measure(
    run: Path,
    points: Annotated[list[tuple[float, float, float]] | None, ANY] = None,
    frame: Annotated[int | None, at_least(0, up_to=1e19)] = None,
    pixels: Annotated[list[tuple[float, float]] | None, ANY] = None,
    radius: Annotated[float | None, above(0)] = None,
    map: Annotated[int | None, at_least(0)] = None,
    mm_per_unit: Annotated[float | None, above(0)] = None,
    output: Path | None = None,
) -> None:
    """Lengths and areas on a surface of a densify run: between two places, around one, inside an outline of more.

    Args:
        run: Run folder made by `lightdepth densify`, or one of its map folders.
        points: Places on the surface, [[x, y, z], ...], in its own coordinates (mm where the run knew the scale, else
            map units). One, with --radius, gives the area around it, and two give the length between them. More give
            the area inside the outline whose corners they are.
        frame: Number of the keyframe in which --pixels are given, as in its name. Another one shows other places in
            these pixels.
        pixels: Places as pixels of the keyframe --frame, [[u, v], ...], u to the right and v down, with the centre of
            the first pixel at (0.5, 0.5); in place of --points. Two give the length between them. More give the area
            inside the outline whose corners they are.
        radius: Radius of the part of the wall around a single place, a straight distance, in mm where the run, its
            scale.json or --mm-per-unit gives the scale, else map units. A larger one measures more wall.
        map: Number of the map to measure on, as in the name of its folder; needed where the run has several. Another
            one is another surface.
        mm_per_unit: Millimetres that a unit of the surface stands for, where the run did not know it; lengths are then
            in mm. A larger one makes them longer in proportion. It is refused where the surface is in mm already. Left
            out, the factor that `lightdepth scale` found for the run, where it found one, with its interval.
        output: JSON file to write the lengths and areas to, besides showing them. Left out, they are shown only.
    """
    if output is not None:
        check_rewritable(output, '{\n "run": ', [run])
    dense = chosen_map(read_run(run), map, run)
    unit = run_unit(run, mm_per_unit)
    scale = None if mm_per_unit is not None else scale_of(run, dense.id)
    known = scale if scale is not None and scale.mm_per_unit is not None else None
    factor = mm_per_unit or 1.0
    if known is not None and known.mm_per_unit is not None and unit != "mm":
        unit, factor = "mm", known.mm_per_unit
    reach = None if known is None else known.reach
    if (points is None) == (pixels is None) or (pixels is None) != (frame is None):
        raise InputError(
            "--points, --frame, --pixels",
            "places given twice, or in part",
            "give the places either by --points, or by --frame and --pixels",
        )
    if points is not None:
        places = np.asarray(points, float).reshape(-1, 3)
    else:
        assert frame is not None and pixels is not None
        places = places_in_frame(dense, frame, np.asarray(pixels, float).reshape(-1, 2))
    found = measured(dense, places, radius, factor)
    result = {"run": told(str(run), run=run), "map": dense.id, "unit": unit, **found.record(reach)}
    result["scale"] = None if scale is None else asdict(scale)
    camera = dense.camera.provenance
    doubts = [camera.doubt] if camera is not None and camera.doubt else []
    result["warnings"] = doubts
    outcome().last(found.summary(unit, reach))
    if scale is not None:
        by = f"millimetres by {scale.by}; nine of ten such figures are right within the range in brackets"
        outcome().last(by if known is not None else str(scale))
    if output is not None:
        write_whole(output, json.dumps(plain(result), indent=1) + "\n")
    exported = command("export", Input("RUN", run), options={"-o": "runs/glb", "--to": "glb"})
    then = "the same command with -o lengths.json" if output is None else exported
    end(*([output] if output else []), then=then, result=plain(result), doubts=doubts)
