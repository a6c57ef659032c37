"""Chosen frames as pictures of a sequence: cut, resized, blacked out, and written with camera, light and mask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np

from lightdepth.calibration import write_camera, write_light
from lightdepth.camera import CameraModel
from lightdepth.datasets.folder import write_times
from lightdepth.files.images import write_image
from lightdepth.image_quality import eight_bits, one_field
from lightdepth.importing.page import Picture
from lightdepth.importing.regions import Regions
from lightdepth.importing.scan import Scan
from lightdepth.importing.selection import BLURRED, DOUBLE, FROZEN, KEPT
from lightdepth.importing.source import Source
from lightdepth.ranges import PIXELS, checked
from lightdepth.reporting.batches import batches
from lightdepth.reporting.figures import thumbnail
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import Run

_PICTURES = 40


_EXAMPLES = 8


@dataclass(frozen=True)
@checked
class PictureConfig:
    """How pictures are cut, resized and freed of interlacing."""

    size: Annotated[tuple[int, int] | None, PIXELS] = None
    """Width and height to resize the frames to, pixels, after --crop, the camera with them; left out, they keep theirs.
    A larger one keeps finer detail, up to the frames' own size; other proportions than theirs stretch the picture."""
    crop: Literal["none", "auto"] = "none"
    """Whether the black border around the tissue is cut off: none keeps it; auto cuts it off and shifts the camera's
    centre to match."""
    deinterlace: bool = False
    """Keep the even rows of each frame and interpolate the odd ones, for interlaced video, where moving edges look like
    combs; switched off, frames stay as they are."""


@dataclass(frozen=True)
class Geometry:
    """How pictures are cut and resized, and the camera (None: none that fits) and mask after it."""

    window: tuple[slice, slice]
    size: tuple[int, int]
    camera: CameraModel | None
    mask: np.ndarray

    @staticmethod
    def of(source: Source, tissue: np.ndarray, config: PictureConfig) -> Geometry:
        camera = source.camera
        if camera is not None and (camera.width, camera.height) != (source.width, source.height):
            same_shape = abs(source.width / camera.width / (source.height / camera.height) - 1) < 0.01
            camera = camera.resized(source.width, source.height) if same_shape else None
        top, bottom, left, right = 0, source.height, 0, source.width
        if config.crop == "auto":
            rows, columns = np.flatnonzero(tissue.any(1)), np.flatnonzero(tissue.any(0))
            top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
            camera = (
                None if camera is None else camera.cropped(int(left), int(top), int(right - left), int(bottom - top))
            )
        window = (slice(top, bottom), slice(left, right))
        mask = tissue[window]
        size = config.size or (int(right - left), int(bottom - top))
        if size != mask.shape[::-1]:
            mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
            camera = None if camera is None else camera.resized(*size)
        return Geometry(window, size, camera, mask)

    def applied(self, pixels: np.ndarray) -> np.ndarray:
        pixels = pixels[self.window]
        if self.size == pixels.shape[1::-1]:
            return pixels
        smaller = self.size[0] < pixels.shape[1] or self.size[1] < pixels.shape[0]
        return cv2.resize(pixels, self.size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def write_pictures(
    run: Run,
    source: Source,
    scan: Scan,
    fate: np.ndarray,
    regions: Regions,
    geometry: Geometry,
    deinterlace: bool,
) -> list[Picture]:
    """The sequence; returns thumbnails for the contact sheet, some of them of frames that were left out."""
    kept = np.flatnonzero(fate == KEPT)
    left_out = np.flatnonzero(np.isin(fate, (BLURRED, DOUBLE, FROZEN)))
    shown = {*kept[_spread(len(kept), _PICTURES)], *left_out[_spread(len(left_out), _EXAMPLES)]}
    (run.folder / "frames").mkdir(exist_ok=True)
    pictures: list[Picture] = []
    times: dict[str, float] = {}
    every = sorted({*kept, *shown})
    with Progress("Writing frames", len(kept)) as bar:
        for batch in batches(run, "pictures", len(every)):
            if batch.finished:
                small = batch.arrays()
                pictures += [(small[str(n)], *label) for n, label in enumerate(batch.kept["labels"])]
                times |= batch.kept["times"]
                bar.advance(sum(fate[k] == KEPT for k in every[batch.start : batch.end]))
                continue
            before, stamps = len(pictures), {}
            for k in (every[i] for i in batch):
                pixels, time = source.read(int(scan.rows[k]))
                pixels = one_field(pixels) if deinterlace else pixels
                pixels = geometry.applied(np.where(regions.shown[..., None], pixels, 0).astype(pixels.dtype))
                name = f"{source.numbers[scan.rows[k]]:06d}"
                if k in shown:
                    label = name if fate[k] == KEPT else f"{name} {fate[k]}"
                    pictures.append((thumbnail(eight_bits(pixels), 160), label, bool(fate[k] == KEPT)))
                if fate[k] == KEPT:
                    batch.files.append(run.folder / "frames" / f"{name}.png")
                    write_image(batch.files[-1], pixels[..., ::-1])
                    if np.isfinite(time):
                        stamps[name] = time
                    bar.advance()
            new = pictures[before:]
            kept_of_it = {"labels": [label for _, *label in new], "times": stamps}
            batch.finish(kept_of_it, {str(n): small for n, (small, *_) in enumerate(new)})
            times |= stamps
    if times:
        write_times(run.folder / "times.csv", times)
    write_image(run.folder / "mask.png", geometry.mask.astype(np.uint8) * 255)
    if geometry.camera is not None:
        write_camera(geometry.camera, run.folder / "camera.json")
    if source.light is not None:
        write_light(source.light, run.folder / "light.json")
    return pictures


def _spread(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(int))
