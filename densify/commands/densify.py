"""The verb densify: dense surfaces from frames and a sparse map."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from densify.config import DensifyConfig
from densify.densified import Densified
from densify.inputs import MapSource, SurfaceFiles, doubts_of_inputs, fitted_light, map_and_frames
from densify.joining import MergeConfig
from densify.page import FILES, densify_page, joined_section
from densify.scale_file import MmPerUnit
from lightdepth.calibration import read_light
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.datasets import SequenceSource
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.sfm.config import SfmConfig


def densify(
    source: Group[SequenceSource],
    output: Path,
    mapped: Group[MapSource] = MapSource(),
    predicting: Group[ModelSource] = ModelSource(),
    config: Group[DensifyConfig] = DensifyConfig(),
    sfm: SfmConfig = SfmConfig(),
    files: Group[SurfaceFiles] = SurfaceFiles(),
    fit_light: bool = True,
    merge: bool = True,
    merging: MergeConfig = MergeConfig(),
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Dense surfaces from frames and a sparse map, one per submap, and one more for submaps that meet.

    Args:
        output: Run folder to make, with the surfaces and the report.
        sfm: how frames are mapped when there is no map
        fit_light: Where neither --light nor the folder gives the light, fit it on the map, and use it if depth by it
            fits hidden blocks of wall better; switched off, a usual light is assumed.
        merge: Join submaps that see the same tissue, and write one surface for each group besides the single ones;
            switched off, submaps stay apart.
        merging: when two submaps are one
        overwrite: Replace a run made before.
        resume: Go on with the run that was stopped there, as it was begun; a sparse map, a light and submaps that are
            done are not made again.
    """
    model = predicting.load(details=False)  # before minutes are spent on a sparse map
    arguments = recorded(
        source,
        mapped,
        predicting,
        config,
        files,
        output=output,
        sfm=sfm,
        fit_light=fit_light,
        merge=merge,
        merging=merging,
    )
    with run_folder(output, "densify", arguments, overwrite, resume) as run:
        run.hash_inputs(**source.files, map=mapped.map, checkpoint=Path(predicting.checkpoint))
        sparse_map, frames = map_and_frames(run, source, mapped, sfm)
        doubts = doubts_of_inputs(run, sparse_map, frames)
        frames = fitted_light(run, frames, sparse_map, model, config, fit_light)
        work = Densified.make(frames, sparse_map, model, config, merging if merge else None, run)
        work.doubts = doubts
        told = files.mm_per_unit
        mm_per_unit: MmPerUnit
        if told == "light":
            # As the file has it: a light that was given by hand counts as given, also where its file says assumed.
            light = frames.first().light if source.light is None else read_light(source.light)
            mm_per_unit = work.ask_light(run, frames, light, files.wall_mm)
        else:
            mm_per_unit = told
        work.write(run, files.formats, mm_per_unit)
        proposals = {} if mapped.map is None or mapped.repair_map else work.proposals()
        for map_id, proposal in proposals.items():
            run.log(f"map {map_id}: {proposal}")
        run.record["proposals"] = proposals
        notes = work.notes(f"{source.data}, {sparse_map.source}", frames, run.record.get("light_fit"))
        notes += [f"Warning: {said}" for said in run.record["warnings"]]
        notes += [f"Map {map_id}: {proposal}." for map_id, proposal in proposals.items()]
        page = densify_page("Densified maps", work.results, work.gallery, notes, None, mm_per_unit, merged=work.merged)
        if work.merged is not None:
            joined_section(page, work.merged)
        page.files(run.folder, FILES)
        page.write(run.folder / "report.html")
    end(output, then=f"lightdepth view {quote(str(output))}", page=output / "report.html")
