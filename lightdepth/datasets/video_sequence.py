"""A video as a sequence, with the calibration beside it: camera.json, light.json, mask.png, else EndoMapper's.

A video is a file that FFmpeg reads, or a DICOM one. What is odd about it is said when it is opened (`clip_checks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.datasets import endomapper
from lightdepth.datasets.clip import Clip, check_depth
from lightdepth.datasets.clip_checks import check_clip
from lightdepth.datasets.dicom import is_dicom, open_dicom
from lightdepth.datasets.no_camera import NoCamera
from lightdepth.datasets.sequence import FrameSequence, border_mask, list_images, read_mask, warn_of_border
from lightdepth.datasets.video import VideoFile
from lightdepth.datasets.video_calibration import VideoCalibration, found_calibration
from lightdepth.errors import InputError
from lightdepth.files.images import unit_range
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration

VIDEO_SUFFIXES = (
    ".mp4",
    ".mov",
    ".m4v",
    ".avi",
    ".mkv",
    ".webm",
    ".mpg",
    ".mpeg",
    ".m2v",
    ".vob",
    ".ts",
    ".mts",
    ".m2ts",
    ".wmv",
    ".asf",
    ".mxf",
    ".flv",
    ".mjpeg",
    ".ogv",
    ".dv",
)


def open_clip(path: Path, bit_depth: int | None = None) -> Clip:
    """The pictures of a video. Raises InputError where it cannot be read."""
    return open_dicom(path, bit_depth) if is_dicom(path) else VideoFile(path, bit_depth)


def video_at(path: Path) -> Path | None:
    """The video that a path means: the file itself, or the only one in a folder without images, such as EndoMapper's
    Seq_NNN. None where there is none; InputError where there are several."""
    if path.is_file():
        return path if _is_video(path) else None
    if not path.is_dir() or list_images(path) or list_images(endomapper.image_folder(path)):
        return None
    videos = sorted(file for file in path.iterdir() if file.is_file() and _is_video(file))
    if len(videos) > 1:
        names = ", ".join(v.name for v in videos[:4]) + (f" and {len(videos) - 4} more" if len(videos) > 4 else "")
        raise InputError(path, f"{len(videos)} videos ({names})", "give one of them")
    return videos[0] if videos else None


def _is_video(file: Path) -> bool:
    return not file.name.startswith(".") and (file.suffix.lower() in VIDEO_SUFFIXES or is_dicom(file))


def read_video(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    map_camera: CameraModel | None = None,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of a video file, named 000000, 000001, ... What is given wins over what lies beside the file; `map_camera`
    serves where there is no camera.json. Without any camera it is refused; without a mask the black border is found."""
    video = open_clip(path, bit_depth)
    if camera is None and map_camera is not None and not (path.parent / "camera.json").is_file():
        camera = endomapper.at_size(map_camera, video.width, video.height, path.name)
    if camera is None or light is None or mask is None:
        found = found_calibration(path, video.width, video.height) if camera is None else _without_camera(path, video)
        camera, light = camera or found.camera, light or found.light
        mask = found.mask if mask is None else mask
    if camera is None:
        raise NoCamera.at(path, "no camera.json beside it")
    check_turned(video, camera)
    images = spread_pictures(video)
    check_depth(video, images)
    if mask is None:
        mask = border_mask(images)
        if not mask.all():
            warn_of_border(path, mask)
    check_clip(video, mask)
    names = [f"{i:06d}" for i in range(len(video))]
    load = _Load(video, camera, light or PhotometricCalibration(), mask)
    return FrameSequence(names, load, str(path), combs_said=True)


def check_turned(video: Clip, camera: CameraModel) -> None:
    """Raises InputError where a camera is of the pictures as players turn them."""
    turned = (camera.width, camera.height) == (video.height, video.width) != (video.width, video.height)
    if video.rotation % 180 and turned:
        raise InputError(
            video.path,
            f"its pictures are stored as {video.width}x{video.height}, and a flag asks players to turn them by "
            f"{video.rotation} degrees: the calibration is of the turned {video.height}x{video.width}",
            "turn the pixels for good (`ffmpeg -i IN OUT` does), or give the calibration of the stored ones",
        )


def quick_sample(video: Clip, count: int) -> list[int]:
    """So many frames, spread over a video; keyframes where there are enough of them."""
    there = video.keyframes if len(video.keyframes) >= count else range(len(video) - video.missing)
    return [there[i] for i in np.unique(np.linspace(0, len(there) - 1, count).round().astype(int))]


def border_of(video: Clip, rows: slice = slice(None), count: int = 8) -> np.ndarray:
    """`border_mask` of these rows of some frames that decode."""
    return border_mask(spread_pictures(video, rows, count))


def spread_pictures(video: Clip, rows: slice = slice(None), count: int = 8) -> list[np.ndarray]:
    """These rows of some frames (H, W, 3) in [0, 1] that decode, spread over a video."""
    images = []
    for i in dict.fromkeys([0, *quick_sample(video, count)]):  # the first decodes, or the file would have been refused
        try:
            images.append(unit_range(video.read(i)[rows]))
        except InputError:
            continue  # refused by number when it is asked for
    return images


@dataclass(frozen=True)
class _Load:
    """Reads frame i. Can be pickled: every worker opens the file for itself."""

    video: Clip
    camera: CameraModel
    light: PhotometricCalibration
    mask: np.ndarray

    def __call__(self, i: int) -> Frame:
        time = float(self.video.times[i])
        image = unit_range(self.video.read(i))
        return Frame(f"{i:06d}", image, self.camera, self.light, self.mask, None if np.isnan(time) else time)


def _without_camera(path: Path, video: Clip) -> VideoCalibration:
    """Light and mask beside a video whose camera is given; an endoscope without calibration has neither."""
    try:
        return found_calibration(path, video.width, video.height)
    except InputError:
        mask = path.parent / "mask.png"
        return VideoCalibration(mask=read_mask(mask) if mask.is_file() else None)
