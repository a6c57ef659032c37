"""The cells of a run of `bench completion`, each a finished part: judged, its picture drawn, its inputs written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote, unquote

from densify.bench.completion.external import write_inputs
from densify.bench.completion.figures import CellFigures
from densify.bench.completion.methods import METHODS
from densify.bench.completion.pictures import keyframe_pictures
from densify.bench.completion.scenes import Errors, completion_scenes
from densify.bench.completion.tables import BEST_SHIFT, read_cell
from densify.bench.completion.work import DELIVERED, Cell, judged_cell
from densify.bench.scenes import render
from densify.bench.work import Predicted
from densify.config import DensifyConfig
from lightdepth.models import DepthModel
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.report import Tile
from lightdepth.reporting.run import Run

RESERVED = (*METHODS, DELIVERED, BEST_SHIFT)
"""Names of rows that no other program's completions can have."""


def completed_cells(
    run: Run,
    model: DepthModel,
    config: DensifyConfig,
    errors: Sequence[Errors],
    external: Mapping[str, Path],
    inputs: bool,
    image_size: tuple[int, int],
) -> tuple[list[CellFigures], list[tuple[list[Tile], str]]]:
    """The figures of every cell, and the pictures of a keyframe of each with their caption."""
    scenes, found, pictures = completion_scenes(), [], []
    rows = len(METHODS) + 1 + len(external)
    with Progress("Completion", len(scenes) * len(errors) * rows) as bar:
        for scene in scenes:
            seen = None
            for kind in errors:
                part, folder = f"{scene.name}, {kind}", run.folder / "pictures" / f"{scene.name}-{kind}"
                if not run.done(part):
                    seen = seen or Predicted.of(render(scene, image_size), [model])
                    cell = Cell(seen.rendered, kind, seen.predictions[model.name], config)
                    task = cell.task()
                    files = write_inputs(task, run.folder / "inputs" / scene.name / kind) if inputs else []
                    judged = judged_cell(cell, external, task, bar.advance)
                    files += _write(folder, keyframe_pictures(judged))
                    run.finish_part(part, files, judged.figures)
                else:
                    bar.advance(rows)
                found.append(read_cell(run.kept_of(part)))
                caption = (
                    f"{scene.name}, {kind}: points (green in, red out), true depth, then errors: red too far, blue too "
                    "near, full colour at 25 %"
                )
                pictures.append((_read(folder), caption))
    return found, pictures


def _write(folder: Path, tiles: Sequence[Tile]) -> list[Path]:
    """A file for each, by its place and label."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for place, tile in enumerate(tiles):
        files.append(folder / f"{place:02d} {quote(tile.label, safe=' ')}.jpg")
        files[-1].write_bytes(tile.picture)
    return files


def _read(folder: Path) -> list[Tile]:
    """What was written there."""
    return [Tile(file.read_bytes(), unquote(file.stem).partition(" ")[2]) for file in sorted(folder.iterdir())]
