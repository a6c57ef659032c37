"""Completions that another program made, and what it is given to make them.

`--external NAME=FOLDER`: FOLDER/SCENE/ERRORS/000012.npz for keyframe 12, with one array, `distance` along the ray or
`depth` along the axis, (H, W) of the frame's size or aspect, in the unit of the map; not finite or 0 where nothing is
said. What `--inputs true` writes has the same names:

    image (H, W, 3) uint8          predicted (H, W) float32, distance up to scale; valid (H, W) bool
    pixels (n, 2), the first pixel's centre at (0.5, 0.5); mapped (n,), distances of map points, in the unit of the map
    point_ids (n,)                 cam_from_map (4, 4)
    points (m, 3), ids (m,)        the whole map

and camera.json beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from densify.bench.completion.methods import Completed, Task
from densify.evaluation.depth_files import DepthKind, DepthReading
from lightdepth.calibration import write_camera
from lightdepth.datasets.sequence import numbered_files
from lightdepth.errors import InputError
from lightdepth.files.arrays import read_arrays

_KINDS: tuple[DepthKind, ...] = ("distance", "depth")


def external_folders(given: Sequence[str], taken: Sequence[str]) -> dict[str, Path]:
    """Folders by the names of their rows, of NAME=FOLDER. Raises InputError where one is none, or its name is `taken`
    or given twice, or its folder holds no completion."""
    found: dict[str, Path] = {}
    for each in given:
        name, equals, folder = each.partition("=")
        if not (name.strip() and equals and folder):
            raise InputError("--external", f"{each!r}", "expected NAME=FOLDER, such as mine=runs/mine")
        if name in found or name in taken:
            raise InputError("--external", f"{name!r} is the name of another row", "give it another name")
        found[name] = Path(folder)
        if not found[name].is_dir() or not any(found[name].glob("*/*/*.npz")):
            raise InputError(
                folder, "no completions", "expected SCENE/ERRORS/000012.npz in it, as --inputs true names them"
            )
    return found


def read_external(folder: Path, task: Task) -> tuple[Completed, int]:
    """What a folder of a cell's completions says of the task's keyframes, and how many it lacks."""
    files = numbered_files(folder, r".*?(\d+)\D*\.npz") if folder.is_dir() else {}
    found = {}
    for k in task.keyframes:
        path = files.get(k.keyframe.number)
        if path is not None:
            own = task.seen[k.keyframe.name].prediction
            assert own is not None
            read = DepthReading(_kind_of(path)).read(path, own.camera)
            # The fusion weighs all rows alike, by the model's uncertainty.
            found[k.keyframe.name] = replace(read, unit="map units", uncertainty=own.uncertainty)
    return found, len(task.keyframes) - len(found)


def _kind_of(path: Path) -> DepthKind:
    named = [kind for kind in _KINDS if kind in read_arrays(path)]
    if len(named) != 1:
        raise InputError(path, f"{len(named)} of the arrays distance and depth", "expected one of them")
    return named[0]


def write_inputs(task: Task, folder: Path) -> list[Path]:
    """Writes what another program is given of a cell into a folder, which is made. Gives the files."""
    folder.mkdir(parents=True)
    write_camera(task.submap.keyframes[0].camera, folder / "camera.json")
    for k in task.keyframes:
        seen = task.seen[k.keyframe.name]
        assert seen.frame is not None and seen.prediction is not None and k.observed is not None
        arrays: Mapping[str, np.ndarray] = {
            "image": np.rint(255 * seen.frame.image).astype(np.uint8),
            "predicted": seen.prediction.distance,
            "valid": seen.prediction.valid,
            "pixels": k.observed.pixels,
            "mapped": k.observed.mapped,
            "point_ids": k.observed.point_ids,
            "cam_from_map": k.keyframe.cam_from_map,
            "points": task.submap.points,
            "ids": task.submap.point_ids,
        }
        np.savez_compressed(folder / f"{k.keyframe.number:06d}.npz", **arrays)  # type: ignore[arg-type]
    return sorted(folder.iterdir())
