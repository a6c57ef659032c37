"""The verb measure: lengths and areas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from densify.evaluation.judged_map import read_run
from densify.measure import chosen_map, measured, places_in_frame, run_unit, summary
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
        run: folder made by densify
        points: places on the surface, [[x, y, z], ...], in its unit
        frame: number of the keyframe that pixels are given in
        pixels: places as pixels of that keyframe, [[u, v], ...], first centre at (0.5, 0.5), instead of points
        radius: with one place, of the disc of wall around it
        map: number of the map; needed where the run has several
        mm_per_unit: millimetres per unit of the surface, where the run did not know it
        output: JSON file to write besides
    """
    dense = chosen_map(read_run(run), map, run)
    unit = run_unit(run, mm_per_unit)
    if (points is None) == (pixels is None) or (pixels is None) != (frame is None):
        raise InputError("give the places either by --points, or by --frame and --pixels")
    if points is not None:
        places = np.asarray(points, float).reshape(-1, 3)
    else:
        assert frame is not None and pixels is not None
        places = places_in_frame(dense, frame, np.asarray(pixels, float).reshape(-1, 2))
    found = measured(dense, places, radius, mm_per_unit or 1.0)
    result = {"run": str(run), "map": dense.id, "unit": unit, **found}
    print(summary(found, unit))
    if output is not None:
        write_whole(output, json.dumps(plain(result), indent=1) + "\n")
