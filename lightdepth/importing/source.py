"""What is imported: pictures by index, whatever they came from, with the calibration where there is one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.calibration import read_camera, read_light
from lightdepth.camera import CameraModel, Pinhole
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.clip import Clip, check_depth
from lightdepth.datasets.sequence import list_images, read_mask
from lightdepth.datasets.video_calibration import found_calibration
from lightdepth.datasets.video_sequence import open_clip, quick_sample, spread_pictures, video_at
from lightdepth.errors import InputError
from lightdepth.files.below import files_below
from lightdepth.files.images import image_size, to_bgr8
from lightdepth.photometry import PhotometricCalibration


@dataclass(frozen=True)
class Source:
    """Pictures to import. `read(i)` gives (H, W, 3) RGB, uint8 or uint16, and the time [s], NaN where unknown; numbers
    are the source's own. camera, light and mask are None where neither given nor found, camera at its own size."""

    numbers: list[int]
    read: Callable[[int], tuple[np.ndarray, float]]
    width: int
    height: int
    camera: CameraModel | None = None
    light: PhotometricCalibration | None = None
    mask: np.ndarray | None = None
    video: Clip | None = None
    no_camera: str = ""  # why there is none, where more can be said than that

    def __len__(self) -> int:
        return len(self.numbers)

    def sample(self, count: int) -> list[int]:
        """So many indices spread over it, such that are quick to read."""
        if self.video is not None:
            return quick_sample(self.video, count)
        result: list[int] = np.unique(np.linspace(0, len(self) - 1, count).round().astype(int)).tolist()
        return result


def open_source(source: SequenceSource) -> tuple[Source, list[Path]]:
    """A video, or any sequence that open_sequence reads, with or without camera; and its files."""
    path = source.data
    video = video_at(path) if source.format in (None, "video") else None
    if video is not None:
        clip = open_clip(video, source.bit_depth)
        check_depth(clip, spread_pictures(clip))
        return _of_video(clip, source.camera, source.light, source.mask), [video]
    if path.is_file():
        raise InputError(
            path,
            "neither a video that is known nor a folder",
            "expected a video such as .mp4 or .mov, or a folder of frames",
        )
    frames, missing = _sequence(source)
    first = frames.first()

    def read(i: int) -> tuple[np.ndarray, float]:
        frame = frames[i]
        time = np.nan if frame.time is None else frame.time
        return np.ascontiguousarray(to_bgr8(frame.image)[..., ::-1]), time

    found = Source(
        numbers=frames.numbers,
        read=read,
        width=first.camera.width,
        height=first.camera.height,
        camera=None if missing else first.camera,
        light=None if first.light.assumed else first.light,
        mask=first.mask,
        no_camera=missing,
    )
    return found, files_below(path)


def content_hash(files: list[Path]) -> str:
    """SHA-256 over contents alone: file names are often names of patients."""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def _of_video(video: Clip, camera: Path | None, light: str | None, mask: Path | None) -> Source:
    why, found = "", None
    try:
        found = found_calibration(video.path, video.width, video.height)
    except InputError as error:
        if camera is None:
            why = str(error).replace(str(video.path.parent), "the folder")
    chosen = found.camera if found is not None else None
    if camera is not None:
        chosen = read_camera(camera, (video.width, video.height))
    beside = found.mask if found is not None else None
    return Source(
        numbers=list(range(len(video))),
        read=lambda i: (video.read(i), float(video.times[i])),
        width=video.width,
        height=video.height,
        camera=chosen,
        light=read_light(light) if light is not None else (found.light if found is not None else None),
        mask=read_mask(mask) if mask is not None else beside,
        video=video,
        no_camera=why,
    )


def _sequence(source: SequenceSource) -> tuple[FrameSequence, str]:
    """Frames of a folder; where only the camera is missing, with one that stands in, and what was said of it."""
    try:
        return source.open().without_truth(), ""
    except InputError as error:
        images = [] if source.camera is not None or not source.data.is_dir() else _images(source.data)
        if not images:
            raise
        width, height = image_size(images[0])
        try:
            stand_in = Pinhole(width, height, width, width, width / 2, height / 2)
            return source.open(stand_in).without_truth(), "none was found"
        except InputError:
            raise error from None


def _images(path: Path) -> list[Path]:
    places = [path / name for name in ("frames", "img_train", "images", "image01", "color", "rgb")]
    return next((found for place in [*places, path] if place.is_dir() and (found := list_images(place))), [])
