"""The verb `import`: a video, or a folder, becomes a sequence that every other verb reads.

The source is read twice: once to measure every frame, once to write those that were chosen. Nothing that tells the
patient is carried over: boxes of text are blacked out in the frames and invalid in the mask, all beyond the border is
black, the video's metadata stay behind, and neither run.json nor the report holds names of files or folders, unless
asked to (`--keep-names`).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from lightdepth.calibration import write_camera, write_light
from lightdepth.camera import CameraModel
from lightdepth.datasets.folder import write_times
from lightdepth.datasets.sequence import border_mask, border_region
from lightdepth.errors import InputError
from lightdepth.files.images import unit_range
from lightdepth.image_quality import Measures, Meter, eight_bits, one_field
from lightdepth.importing import findings as finding
from lightdepth.importing.findings import Finding
from lightdepth.importing.overlay import STRETCH, STRETCHES, Overlay, find_overlay
from lightdepth.importing.page import Picture, import_page
from lightdepth.importing.selection import BLURRED, FROZEN, KEPT, Choice, selected
from lightdepth.importing.source import Source, content_hash, open_source
from lightdepth.reporting.figures import thumbnail
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import Run, run_folder

DEFAULT_RATE = 5.0
_PICTURES, _EXAMPLES = 40, 8


def import_frames(
    source: Path,
    output: Path,
    format: str | None = None,
    camera: Path | None = None,
    light: str | None = None,
    mask: Path | None = None,
    rate: float | None = None,
    every: int | None = None,
    start: float = 0.0,
    end: float | None = None,
    blur: float = 0.6,
    max_frames: int | None = None,
    size: tuple[int, int] | None = None,
    crop: Literal["none", "auto"] = "none",
    deinterlace: bool = False,
    overlay_mask: Path | None = None,
    find_text: bool = True,
    frames: bool = True,
    keep_names: bool = False,
    overwrite: bool = False,
) -> None:
    """A video or a folder of frames as a sequence, without the patient's name, and a report on what is wrong with it.

    Args:
        source: video file, or folder of frames of any format that is read
        output: folder to make
        format: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found by looking if left out
        camera: calibration file that wins over what lies beside the frames
        light: light.json, photometric XML, or gamma=2.2,mu=0
        mask: image, white where tissue shows; left out, the black border is found
        rate: frames per second to keep, the sharpest of each interval; left out, 5 for a video, all of a folder
        every: keep every n-th frame instead
        start: seconds from the first frame
        end: seconds from the first frame
        blur: frames are left out whose sharpness is below this share of their neighbours'; 0 keeps all
        max_frames: keep at most so many, spread evenly
        size: width and height to resize to; the camera is rescaled
        crop: auto cuts the black border off; the camera is cropped
        deinterlace: keep one field and interpolate the rows between
        overlay_mask: image, white where text is to be blacked out, besides what is found
        find_text: look for burnt-in text
        frames: false writes the report alone, with no image of the patient, fit for mailing
        keep_names: let run.json and the report hold the names of files
        overwrite: replace a folder made before
    """
    given = {k: v for k, v in locals().items() if k not in ("overwrite", "source", "output")}
    choice = Choice(rate, every, blur, max_frames)
    if end is not None and end <= start:
        raise InputError(f"--start {start} --end {end}; expected an end after the start")
    if size is not None and min(size) < 1:
        raise InputError(f"--size {size}; expected a positive width and height")
    opened, files = open_source(source, format, camera, light, mask)
    if opened.video is not None and rate is None and every is None:
        choice = replace(choice, rate=DEFAULT_RATE)
    arguments = {"source": source, **given}
    if not keep_names:
        paths = ("source", "camera", "light", "mask", "overlay_mask")
        arguments |= {k: "(name left out)" for k in paths if arguments[k] is not None and "=" not in str(arguments[k])}
    with run_folder(output, "import", arguments, overwrite) as run:
        if not keep_names:
            run.record["command"] = ["lightdepth", "import", "(names left out; the options are in arguments)"]
        run.record["inputs"] = {"source": {"sha256_of_contents": content_hash(files)}}
        given_text = None if overlay_mask is None else _overlay_mask(overlay_mask, opened)
        regions = _regions(opened, find_text, given_text, deinterlace)
        scan = _scan(opened, regions.tissue, start, end, deinterlace)
        fate = selected(scan.times, scan.measures, choice)
        found = _findings(opened, scan, fate, regions, deinterlace, find_text)
        geometry = _Geometry.of(opened, regions.tissue, size, crop)
        chosen = scan.rows[fate == KEPT]
        pictures: list[Picture] = []
        if frames:
            if not len(chosen):
                raise InputError(f"{source}: no frame to keep; " + " ".join(f"{f.found} {f.cure}" for f in found))
            pictures = _write(run, opened, scan, fate, regions, geometry, deinterlace)
        facts = _facts(opened, scan, fate, regions, geometry, choice, source if keep_names else None)
        axis = (scan.times, "time [s]") if np.isfinite(scan.times).all() else (scan.rows, "frame")
        page = import_page(
            facts, found, scan.measures, fate, axis, pictures, _tissue_picture(regions) if frames else None
        )
        page.write(run.folder / "report.html")
        _write_measures(run.folder / "frames.csv", opened, scan, fate)
        run.record["findings"] = [{"found": f.found, "do": f.cure} for f in found]
        run.record["frames"] = {"measured": len(scan.rows), "kept": len(chosen)}
        for each in found:
            run.log(f"! {each.found} {each.cure}")
        run.log(f"{len(chosen)} of {len(scan.rows)} frames kept" + ("" if frames else "; the report alone was written"))
    print(f"{output / 'report.html'}")


@dataclass(frozen=True)
class _Regions:
    """Parts of the image, (H, W) bool: tissue is valid, shown is not blacked out."""

    tissue: np.ndarray
    shown: np.ndarray
    overlay: Overlay
    border_found: bool


@dataclass(frozen=True)
class _Scan:
    """Measures and times [s] of the frames that were looked at; `rows` are their indices in the source."""

    rows: np.ndarray
    times: np.ndarray
    measures: Measures


@dataclass(frozen=True)
class _Geometry:
    """How pictures are cut and resized, and the camera (None: none that fits) and mask after it."""

    window: tuple[slice, slice]
    size: tuple[int, int]
    camera: CameraModel | None
    mask: np.ndarray

    @staticmethod
    def of(source: Source, tissue: np.ndarray, size: tuple[int, int] | None, crop: str) -> _Geometry:
        camera = source.camera
        if camera is not None and (camera.width, camera.height) != (source.width, source.height):
            same_shape = abs(source.width / camera.width / (source.height / camera.height) - 1) < 0.01
            camera = camera.resized(source.width, source.height) if same_shape else None
        top, bottom, left, right = 0, source.height, 0, source.width
        if crop == "auto":
            rows, columns = np.flatnonzero(tissue.any(1)), np.flatnonzero(tissue.any(0))
            top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
            camera = (
                None if camera is None else camera.cropped(int(left), int(top), int(right - left), int(bottom - top))
            )
        window = (slice(top, bottom), slice(left, right))
        mask = tissue[window]
        size = size or (int(right - left), int(bottom - top))
        if size != mask.shape[::-1]:
            mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
            camera = None if camera is None else camera.resized(*size)
        return _Geometry(window, size, camera, mask)

    def applied(self, pixels: np.ndarray) -> np.ndarray:
        pixels = pixels[self.window]
        if self.size == pixels.shape[1::-1]:
            return pixels
        smaller = self.size[0] < pixels.shape[1] or self.size[1] < pixels.shape[0]
        return cv2.resize(pixels, self.size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def _regions(source: Source, find_text: bool, given_text: np.ndarray | None, deinterlace: bool) -> _Regions:
    images = []
    for i in source.sample(STRETCH * STRETCHES):
        try:
            pixels = eight_bits(source.read(i)[0])
        except InputError:
            continue  # the scan counts and reports it
        if pixels.shape[:2] == (source.height, source.width):
            images.append(one_field(pixels) if deinterlace else pixels)
    if not images:
        raise InputError("none of the frames looked at could be read; copy the data again")
    floats = [unit_range(image) for image in images]
    mask, region = border_mask(floats), border_region(floats)
    nothing = np.zeros(mask.shape, bool)
    overlay = find_overlay(images, region) if find_text else Overlay(nothing, True, [])
    tissue = mask if source.mask is None else source.mask
    if tissue.shape != mask.shape:
        raise InputError(
            f"the mask is {tissue.shape[1]}x{tissue.shape[0]}, the images {source.width}x{source.height}; expected the "
            "same size"
        )
    text = overlay.mask if given_text is None else overlay.mask | given_text
    shown = cv2.dilate((region | tissue).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return _Regions(tissue & ~text, shown & ~text, replace(overlay, mask=text), source.mask is None and not mask.all())


def _overlay_mask(path: Path, source: Source) -> np.ndarray:
    """(H, W) bool of a file that is white where text is. Unlike a mask's, its polarity is not guessed."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise InputError(f"{path}: not a readable image; expected one that is white where text is")
    if grey.shape != (source.height, source.width):
        size = f"{source.width}x{source.height}"
        raise InputError(f"{path}: {grey.shape[1]}x{grey.shape[0]}; expected {size}, as the images are")
    return grey > 127


def _scan(source: Source, tissue: np.ndarray, start: float, end: float | None, deinterlace: bool) -> _Scan:
    rows, times, meter, first = [], [], Meter(tissue), None
    last = np.inf if end is None else end
    for_sure = None if source.video is None else source.video.times - source.video.times[0]
    with Progress("Measuring", len(source)) as bar:
        for i in range(len(source)):
            bar.advance()
            if for_sure is not None and (for_sure[i] < start or for_sure[i] > last):
                continue
            try:
                pixels, time = source.read(i)
                if pixels.shape[:2] != tissue.shape:
                    raise InputError(f"frame {source.numbers[i]} has another size than the first")
            except InputError:
                rows.append(i)
                times.append(np.nan)
                meter.unreadable()
                continue
            first = time if first is None else first
            if for_sure is None and (time - first < start or time - first > last):
                continue
            rows.append(i)
            times.append(time)
            meter.add(one_field(pixels) if deinterlace else pixels)
    if not rows:
        raise InputError(f"no frames between --start {start:g} and --end {last:g} seconds")
    return _Scan(np.array(rows), np.array(times), meter.result())


def _findings(
    source: Source, scan: _Scan, fate: np.ndarray, regions: _Regions, deinterlace: bool, find_text: bool
) -> list[Finding]:
    camera = source.camera
    found = finding.of_camera(
        (source.width, source.height), None if camera is None else (camera.width, camera.height), source.no_camera
    )
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
                f"Burnt-in text or graphics in {len(regions.overlay.boxes)} place(s): {boxes}. They are "
                "black in the frames and invalid in the mask.",
                "Look at the frames before they leave the house: text that shows only briefly is not found; black it "
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
    measured = finding.of_frames(scan.measures, fate, scan.times)
    return found + [f for f in measured if not (deinterlace and "interlaced" in f.found)]


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
                f"The file says to show it turned by {video.rotation} degrees; the frames are turned so.",
                "The calibration must be of the turned picture.",
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


def _write(
    run: Run,
    source: Source,
    scan: _Scan,
    fate: np.ndarray,
    regions: _Regions,
    geometry: _Geometry,
    deinterlace: bool,
) -> list[Picture]:
    """The sequence; returns thumbnails for the contact sheet, some of them of frames that were left out."""
    kept = np.flatnonzero(fate == KEPT)
    left_out = np.flatnonzero(np.isin(fate, (BLURRED, FROZEN)))
    shown = {*kept[_spread(len(kept), _PICTURES)], *left_out[_spread(len(left_out), _EXAMPLES)]}
    (run.folder / "frames").mkdir()
    pictures: list[Picture] = []
    times = {}
    with Progress("Writing frames", len(kept)) as bar:
        for k in sorted({*kept, *shown}):
            pixels, time = source.read(int(scan.rows[k]))
            pixels = one_field(pixels) if deinterlace else pixels
            pixels = geometry.applied(np.where(regions.shown[..., None], pixels, 0).astype(pixels.dtype))
            name = f"{source.numbers[scan.rows[k]]:06d}"
            if k in shown:
                label = name if fate[k] == KEPT else f"{name} {fate[k]}"
                pictures.append((thumbnail(eight_bits(pixels), 160), label, fate[k] == KEPT))
            if fate[k] == KEPT:
                cv2.imwrite(str(run.folder / "frames" / f"{name}.png"), pixels[..., ::-1])
                if np.isfinite(time):
                    times[name] = time
                bar.advance()
    if times:
        write_times(run.folder / "times.csv", times)
    cv2.imwrite(str(run.folder / "mask.png"), geometry.mask.astype(np.uint8) * 255)
    if geometry.camera is not None:
        write_camera(geometry.camera, run.folder / "camera.json")
    if source.light is not None:
        write_light(source.light, run.folder / "light.json")
    return pictures


def _spread(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(int))


def _facts(
    source: Source,
    scan: _Scan,
    fate: np.ndarray,
    regions: _Regions,
    geometry: _Geometry,
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


def _tissue_picture(regions: _Regions) -> np.ndarray:
    height, width = regions.tissue.shape
    size = (min(480, width), max(1, round(height * min(480, width) / width)))
    return cv2.resize(regions.tissue.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _write_measures(path: Path, source: Source, scan: _Scan, fate: np.ndarray) -> None:
    columns = ("brightness", "saturated", "dark", "sharpness", "change", "combing")
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["number", "seconds", "fate", *columns])
        for k, row in enumerate(scan.rows):
            values = [f"{getattr(scan.measures, column)[k]:.5g}" for column in columns]
            writer.writerow([source.numbers[row], f"{scan.times[k]:.6f}", fate[k], *values])
