"""What is known of a source and what is wrong with it, in sentences for the report."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightdepth.counting import counted, full_stop
from lightdepth.importing import findings as finding
from lightdepth.importing.findings import Finding
from lightdepth.importing.pictures import Geometry
from lightdepth.importing.regions import Regions
from lightdepth.importing.scan import Scan
from lightdepth.importing.selection import KEPT, Choice
from lightdepth.importing.source import Source


def doubts(
    source: Source, scan: Scan, fate: np.ndarray, regions: Regions, deinterlace: bool, find_text: bool
) -> list[Finding]:
    camera = source.camera
    found = finding.of_camera(
        (source.width, source.height), None if camera is None else (camera.width, camera.height), source.no_camera
    )
    doubt = "" if camera is None or camera.provenance is None else camera.provenance.doubt
    if doubt:
        found.append(Finding(full_stop(f"{doubt[0].upper()}{doubt[1:]}"), "A calibration of this endoscope is better."))
    if source.light is None:
        found.append(
            Finding(
                "No photometric calibration: light.json was not written, another endoscope's light will be assumed.",
                "With a map, densify fits the light; otherwise `lightdepth calibrate-light`.",
            )
        )
    share = float(regions.tissue.mean())
    if share < finding.SMALL_MASK:
        found.append(
            Finding(
                f"The mask leaves {share:.0%} of the image.",
                "Look at mask.png; if it is wrong, give --mask FILE, else consider --crop auto.",
            )
        )
    if regions.overlay.boxes:
        boxes = ", ".join(f"{w}x{h} at ({x}, {y})" for x, y, w, h in regions.overlay.boxes)
        found.append(
            Finding(
                f"Burnt-in text or graphics in {counted(len(regions.overlay.boxes), 'place')}: {boxes}. They are "
                "black in the frames and invalid in the mask.",
                "Look at the frames before you hand them on: text that shows only briefly is not found; black it "
                "out with --overlay-mask FILE.",
            )
        )
    if find_text and not regions.overlay.moved:
        found.append(
            Finding(
                "The camera hardly moved in the frames looked at, or they are too few: burnt-in text on the tissue "
                "cannot be told from tissue and was not looked for.",
                "Look at the frames; black text out with --overlay-mask FILE.",
            )
        )
    if source.video is not None:
        found += _of_video(source)
        if source.video.interlaced and not deinterlace and not finding.interlaced(scan.measures):
            found.append(
                Finding(
                    "The file says that its pictures are interlaced, and those that move are whole.",
                    "Nothing, if they look so; --deinterlace keeps one field.",
                )
            )
    measured = finding.of_frames(scan.measures, fate, scan.times)
    return found + [f for f in measured if not (deinterlace and "are interlaced" in f.found)]


def _of_video(source: Source) -> list[Finding]:
    video, found = source.video, []
    assert video is not None
    if video.missing:
        found.append(
            Finding(
                f"The video was cut off: {len(video) - video.missing} of {len(video)} frames are there.",
                "Copy it again from the recorder.",
            )
        )
    if video.rotation:
        found.append(
            Finding(
                f"The file says to show it turned by {video.rotation} degrees; frames are as stored.",
                "Right if the calibration, mask and map are of the stored pictures. Players, ffmpeg and OpenCV turn "
                "them: for a calibration of the turned ones, turn the file for good first (`ffmpeg -i IN OUT`).",
            )
        )
    if abs(video.pixel_aspect - 1) > 0.01:
        found.append(
            Finding(
                f"Pixels are not square (width to height {video.pixel_aspect:.3f}); frames are as stored.",
                "Right if fx and fy of the calibration differ by that ratio.",
            )
        )
    if video.tags:
        found.append(
            Finding(
                f"The video carries metadata ({', '.join(video.tags)}); none was carried over.",
                "The source file still has them, perhaps with a name or date: do not pass it on.",
            )
        )
    return found


def facts(
    source: Source,
    scan: Scan,
    fate: np.ndarray,
    regions: Regions,
    geometry: Geometry,
    choice: Choice,
    name: Path | None,
) -> list[list[str]]:
    rows = [["source", "name left out (--keep-names shows it)" if name is None else str(name)]]
    if (video := source.video) is not None:
        rate = "unknown" if video.rate is None else f"{video.rate:.4g} frames/s on average"
        rows.append(["video", f"{video.codec}, {video.bits} bit, {rate}, {len(video)} frames"])
    known = scan.times[np.isfinite(scan.times)]
    if len(known):
        rows.append(["time", f"{known[0]:.3f} to {known[-1]:.3f} s"])
    how = (
        f"every {choice.every}" if choice.every else f"{choice.rate:g} a second, the sharpest" if choice.rate else "all"
    )
    rows.append(["chosen", f"{how}; kept {int((fate == KEPT).sum())} of {len(fate)}"])
    rows.append(["size", f"{source.width}x{source.height}, written as {geometry.size[0]}x{geometry.size[1]}"])
    rows.append(["mask", f"{regions.tissue.mean():.1%} of the image" + (", border found" * regions.border_found)])
    rows.append(["text blacked out", f"{regions.overlay.mask.mean():.2%} of the image"])
    rows.append(["frame numbers", "the source's own, so that a map made on it still fits; a video's count from 0"])
    return rows
