"""The verb `import`: a video, or a folder, becomes a sequence that every other verb reads.

The source is read twice: once to measure every frame, once to write those that were chosen. Nothing that tells the
patient is carried over: boxes of text are blacked out in the frames and invalid in the mask, all beyond the border is
black, the video's metadata stay behind, and neither run.json nor the report holds names of files or folders, unless
asked to (`--keep-names`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote

import numpy as np

from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.counting import counted
from lightdepth.datasets import SequenceSource
from lightdepth.errors import InputError
from lightdepth.importing.costs import import_steps
from lightdepth.importing.doubts import doubts, facts
from lightdepth.importing.page import FILES, Picture, import_page
from lightdepth.importing.pictures import Geometry, PictureConfig, write_pictures
from lightdepth.importing.regions import find_regions, read_overlay_mask, tissue_picture
from lightdepth.importing.scan import scanned, write_measures
from lightdepth.importing.selection import KEPT, Choice, selected
from lightdepth.importing.source import content_hash, open_source
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.uncalibrated import with_camera

DEFAULT_RATE = 5.0


def import_frames(
    source: Group[SequenceSource],
    output: Path,
    choice: Group[Choice] = Choice(),
    shape: Group[PictureConfig] = PictureConfig(),
    overlay_mask: Path | None = None,
    find_text: bool = True,
    frames: bool = True,
    keep_names: bool = False,
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """A video or a folder of frames as a sequence, without the patient's name, and a report on what is wrong with it.

    Args:
        output: Folder to make, with the sequence and the report; with --no-frames, the report and its tables alone.
        overlay_mask: Image of the frames' size, white where text is to be blacked out, in addition to what --find-text
            finds.
        find_text: Look for text burnt into the frames, and black it out; switched off, only what --overlay-mask marks
            is.
        frames: Write the frames; switched off, only the report is written, with no image of the patient, so that it can
            be mailed.
        keep_names: Let run.json and the report hold the names of files; switched off, they are left out, because they
            may name the patient.
        overwrite: Replace a folder made before.
        resume: Go on with the run that was stopped there, as it was begun; frames that are done are not measured or
            written again.
    """
    arguments = recorded(
        source,
        choice,
        shape,
        overlay_mask=overlay_mask,
        find_text=find_text,
        frames=frames,
        keep_names=keep_names,
    )
    if not keep_names:
        paths = [name for name in (*source.files, "overlay_mask") if arguments[name] is not None]
        arguments |= {name: "(name left out)" for name in paths if "=" not in str(arguments[name])}
    with run_folder(output, "import", arguments, overwrite, resume, (source, overlay_mask), keep_names) as run:
        opened, files = open_source(with_camera(source, run))
        run.check_inputs(**source.files, overlay_mask=overlay_mask)
        if opened.video is not None and choice.rate is None and choice.every is None:
            choice = replace(choice, rate=DEFAULT_RATE)
        given_text = None if overlay_mask is None else read_overlay_mask(overlay_mask, opened)
        run.begins(f"{counted(len(opened), 'frame')} would be measured", partial(import_steps, opened, frames))
        if not keep_names:
            run.record["command"] = ["lightdepth", "import", "(names left out; the options are in arguments)"]
        run.record["inputs"] = {"source": {"sha256_of_contents": content_hash(files)}}
        regions = find_regions(opened, find_text, given_text, shape.deinterlace)
        scan = scanned(run, opened, regions.tissue, choice, shape.deinterlace)
        fate = selected(scan.times, scan.measures, choice)
        found = doubts(opened, scan, fate, regions, shape.deinterlace, find_text)
        geometry = Geometry.of(opened, regions.tissue, shape)
        chosen = scan.rows[fate == KEPT]
        pictures: list[Picture] = []
        if frames:
            if not len(chosen):
                raise InputError(
                    source.data,
                    "no frame to keep",
                    " ".join(f"{f.found} {f.cure}" for f in found) or "look at the frames",
                )
            pictures = write_pictures(run, opened, scan, fate, regions, geometry, shape.deinterlace)
        known = facts(opened, scan, fate, regions, geometry, choice, source.data if keep_names else None)
        axis = (scan.times, "time [s]") if np.isfinite(scan.times).all() else (scan.rows, "frame")
        page = import_page(
            known, found, scan.measures, fate, axis, pictures, tissue_picture(regions) if frames else None
        )
        write_measures(run.folder / "frames.csv", opened, scan, fate)
        page.files(run.folder, FILES)
        page.write(run.folder / "report.html")
        run.record["findings"] = [{"found": f.found, "do": f.cure} for f in found]
        run.record["frames"] = {"measured": len(scan.rows), "kept": len(chosen)}
        for each in found:
            run.log(f"! {each.found} {each.cure}")
        run.log(f"{len(chosen)} of {len(scan.rows)} frames kept" + ("" if frames else "; only the report was written"))
    camera = " --camera auto" if geometry.camera is None else ""
    then = (
        f"lightdepth densify {quote(str(output))}{camera} -o runs/dense"
        if frames
        else "lightdepth import VIDEO -o DATA"
    )
    end(output, then=then, page=output / "report.html")
