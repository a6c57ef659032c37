"""A sequence becomes a run folder of dense surfaces: what the verb densify does, batch for each of many, and `bench
speed` against the clock."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from densify.config import DensifyConfig
from densify.costs import surface_steps, surfaces_of
from densify.densified import Densified
from densify.inputs import MapSource, SurfaceFiles, doubts_of_inputs, fitted_light, map_and_frames
from densify.joining import MergeConfig
from densify.page import FILES, densify_page, joined_section
from densify.scale_file import MmPerUnit
from lightdepth.calibration import read_light
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.outcome import OUTCOME, Outcome
from lightdepth.counting import full_stop
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.light.millimetres import unplaced
from lightdepth.models import DepthModel
from lightdepth.photometry import PhotometricCalibration
from lightdepth.reporting.names import KEPT
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.sfm.config import SfmConfig


@dataclass(frozen=True)
class Asked:
    """What is to be made of one sequence: the options of densify."""

    source: SequenceSource
    mapped: MapSource
    predicting: ModelSource
    config: DensifyConfig
    sfm: SfmConfig
    files: SurfaceFiles
    fit_light: bool
    merge: bool
    merging: MergeConfig


def dense_run(asked: Asked, model: DepthModel, output: Path, overwrite: bool = False, resume: bool = False) -> None:
    """Makes the run folder `output`; `model` is the one that `asked.predicting` names. Raises as `run_folder` does."""
    source, mapped, config, files = asked.source, asked.mapped, asked.config, asked.files
    arguments = recorded(
        source,
        mapped,
        asked.predicting,
        config,
        files,
        output=output,
        sfm=asked.sfm,
        fit_light=asked.fit_light,
        merge=asked.merge,
        merging=asked.merging,
    )
    with run_folder(output, "densify", arguments, overwrite, resume) as run:
        run.hash_inputs(**source.files, map=mapped.map, checkpoint=Path(asked.predicting.checkpoint))
        sparse_map, frames = map_and_frames(run, source, mapped, asked.sfm)
        if files.mm_per_unit == "light" and (untold := unplaced(_light_given(source, frames))) is not None:
            run.warn(f"surfaces will be in map units: {untold.refused}; {untold.cure}")
        doubts = doubts_of_inputs(run, sparse_map, frames)
        steps = partial(surface_steps, sparse_map, frames, model, asked.fit_light, mapped.polish_map)
        run.begins(surfaces_of(sparse_map, frames), steps)
        frames = fitted_light(run, frames, sparse_map, model, config, asked.fit_light)
        work = Densified.make(frames, sparse_map, model, config, asked.merging if asked.merge else None, run)
        work.doubts = doubts
        told = files.mm_per_unit
        mm_per_unit: MmPerUnit
        if told == "light":
            mm_per_unit = work.ask_light(run, frames, _light_given(source, frames), files.wall_mm)
        else:
            mm_per_unit = told
        work.write(run, files.formats, mm_per_unit)
        proposals = {} if mapped.map is None or mapped.repair_map else work.proposals()
        for map_id, proposal in proposals.items():
            run.log(f"map {map_id}: {proposal}")
        run.record["proposals"] = proposals
        notes = work.notes(f"{source.data}, {sparse_map.source}", frames, run.record.get("light_fit"))
        notes += [f"Poses: {told['sentence']}." for told in run.record.get("polish", ())]
        notes += [f"Warning: {said}" for said in run.record["warnings"]]
        notes += [full_stop(f"Map {map_id}: {proposal}") for map_id, proposal in proposals.items()]
        page = densify_page("Densified maps", work.results, work.gallery, notes, None, mm_per_unit, merged=work.merged)
        if work.merged is not None:
            joined_section(page, work.merged)
        page.files(run.folder, FILES)
        page.write(run.folder / "report.html")
        if work.without_millimetres:  # it was warned of long ago
            run.log(work.without_millimetres)


@contextmanager
def unheard(words: Sequence[str], goes_on: str, keep_names: bool = False) -> Iterator[None]:
    """Runs made within it say nothing to the terminal (their logs have it), and note `words` as the command line: the
    real one may name patients. `goes_on` is how one that is stopped goes on, empty where none does."""
    with ExitStack() as ending:
        ending.callback(setattr, sys, "argv", sys.argv)
        sys.argv = list(words)
        for variable, value in ((KEPT, keep_names), (OUTCOME, Outcome(quiet=True, goes_on=goes_on))):
            ending.callback(variable.reset, variable.set(value))  # type: ignore[arg-type]  # each has its own type
        for redirected in (redirect_stdout, redirect_stderr):
            ending.enter_context(redirected(io.StringIO()))
        yield


def _light_given(source: SequenceSource, frames: FrameSequence) -> PhotometricCalibration:
    """As its file has it: a light that was given by hand counts as given, also where its file says assumed."""
    return frames.first().light if source.light is None else read_light(source.light)
