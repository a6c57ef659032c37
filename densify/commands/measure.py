"""The verb measure: lengths and areas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from densify.evaluation.judged_map import read_run
from densify.measure import chosen_map, measured, places_in_frame, run_unit
from lightdepth.errors import InputError
from lightdepth.files.writing import write_whole
from lightdepth.reporting.run import plain


def measure(
    run: Path,
    points: list[tuple[float, float, float]] | None = None,
    frame: int | None = None,
    pixels: list[tuple[float, float]] | None = None,
    radius: float | None = None,
    map: int | None = None,
    mm_per_unit: float | None = None,
    output: Path | None = None,
) -> None:
    """Lengths and areas on a surface of a densify run: between two places, around one, inside an outline of more.

    Args:
        run: Run folder made by densify, or one of its map folders.
        points: Places on the surface, [[x, y, z], ...], in its unit (mm or map units). More than two outline an area.
        frame: Number of the keyframe that pixels are given in. Another one has other pixels.
        pixels: Places as pixels of that keyframe, [[u, v], ...], first centre at (0.5, 0.5), instead of points. More
            than two outline an area.
        radius: Radius of the disc of wall around a single place, in the surface's unit (mm or map units). A larger
            one measures more wall.
        map: Number of the map; needed where the run has several. Another one is another surface.
        mm_per_unit: Millimetres per unit of the surface, where the run did not know it. A larger one makes longer
            lengths.
        output: JSON file to write the lengths and areas to, besides showing them.
    """
    dense = chosen_map(read_run(run), map, run)
    unit = run_unit(run, mm_per_unit)
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
    found = measured(dense, places, radius, mm_per_unit or 1.0)
    result = {"run": str(run), "map": dense.id, "unit": unit, **found.record()}
    print(found.summary(unit))
    if output is not None:
        write_whole(output, json.dumps(plain(result), indent=1) + "\n")
