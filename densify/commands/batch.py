"""The verb batch: densify for many sequences."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from densify.batch.folder import PAGE, real_place
from densify.batch.make import Maker
from densify.batch.manifest import read_manifest
from densify.batch.units import check_contents_of_all, check_files_of_all, said_of_copies, units_of
from densify.batch.work import Batch, Running, batch_run, check_running, told_failures
from densify.config import DensifyConfig
from densify.dense_run import Asked
from densify.inputs import MapSource, SurfaceFiles
from densify.joining import MergeConfig
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.following import on_terminal
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end, outcome
from lightdepth.counting import counted, full_stop
from lightdepth.datasets import SequenceSource
from lightdepth.errors import PartialFailure
from lightdepth.foreign_text import for_line
from lightdepth.reporting.names import KEPT
from lightdepth.reporting.run import recorded
from lightdepth.sfm.config import SfmConfig

_MOST_NAMED = 20
"""Failures that the last line names; the table has all."""


@dataclass(frozen=True)
class ManySources(SequenceSource):
    """Sequences, and the files that serve for all of them."""

    data: Path
    """Manifest: a folder of sequences (folders of frames or videos, up to three folders down), a pattern in quotation
    marks ('data/*/frames'), or a CSV file with a column data and, for options of each sequence, columns such as map,
    mask, light, camera, mm_per_unit and name."""


@dataclass(frozen=True)
class MapInside(MapSource):
    """A sparse map of each sequence, and what is asked of it."""

    map: Path | None = None
    """Sparse map of each sequence, as a path that begins in its folder (slam, ../map), or for a video in the folder
    that it lies in; left out, pycolmap makes one from the frames."""


def batch(
    source: Group[ManySources],
    output: Path,
    running: Group[Running] = Running(),
    mapped: Group[MapInside] = MapInside(),
    predicting: Group[ModelSource] = ModelSource(),
    config: Group[DensifyConfig] = DensifyConfig(),
    sfm: SfmConfig = SfmConfig(),
    files: Group[SurfaceFiles] = SurfaceFiles(),
    fit_light: bool = True,
    merge: bool = True,
    merging: MergeConfig = MergeConfig(),
) -> None:
    """Densify many sequences, on several cores or machines, and go on where it was stopped; one table of all.

    Args:
        output: Folder with a run of each sequence and the table of all. What is already made there is kept; what failed
            is tried again.
        sfm: how frames are mapped when there is no map
        fit_light: Where neither --light nor the sequence gives the light, fit it on its map, and use it if its depth
            fits hidden blocks of wall better; switched off, a usual light is assumed.
        merge: Join submaps that see the same tissue, and write one surface for each group besides the single ones;
            switched off, submaps stay apart.
        merging: when two submaps are one
    """
    check_running(running)
    check_files_of_all(source, mapped)
    place = real_place(output)
    rows = read_manifest(source.data, place)
    predicting.load(details=False)  # what is wrong with it is better known before the night
    asked = Asked(source, mapped, predicting, config, sfm, files, fit_light, merge, merging)
    units = units_of(rows, asked)
    check_contents_of_all(source, units)
    inside = None if mapped.map is None else f"in each: {mapped.map}"
    settings = recorded(source, predicting, config, files, sfm=sfm, fit_light=fit_light, merge=merge, merging=merging)
    arguments = {**settings, **vars(mapped), "map": inside, "data": None}
    same = [f"The manifest repeats {counted(len(rows) - len(units), 'row')}."] * (len(rows) > len(units))
    if copies := said_of_copies(units, lambda unit: unit.name):  # logs and files name no paths
        named = said_of_copies(units, lambda unit: str(unit.row.data)) if on_terminal(sys.stderr) else copies
        print(for_line(f"warning: {named}"), file=sys.stderr, flush=True)
        outcome().warned(full_stop(copies))
        same.append(full_stop(copies))
    work = Batch(units, place, Maker(predicting, place, KEPT.get()), arguments, same)
    lines = batch_run(work, running)
    if failures := told_failures(lines):
        first = "; ".join(failures[:_MOST_NAMED]) + ("; ..." if len(failures) > _MOST_NAMED else "")
        said = f"{counted(len(failures), 'sequence')} of {len(lines)} failed: {first}"
        raise PartialFailure(f"{full_stop(said)} The rest is in {output}")
    end(output, then=f"cat {quote(str(output / 'table.csv'))}", page=output / PAGE)
