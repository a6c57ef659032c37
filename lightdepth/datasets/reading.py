"""open_sequence: whatever is at a path, as frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from lightdepth.calibration import read_camera, read_light
from lightdepth.camera import CameraModel
from lightdepth.datasets import c3vd, endomapper, endoslam, folder, hamlyn, scared, simcol
from lightdepth.datasets.checks import check_sequence
from lightdepth.datasets.format import Format
from lightdepth.datasets.sequence import FrameSequence, legible, list_images, no_images, read_mask
from lightdepth.datasets.video_sequence import check_turned, open_clip, read_video, video_at
from lightdepth.errors import InputError
from lightdepth.files.below import folders_in
from lightdepth.files.images import image_size
from lightdepth.files.reading import reading
from lightdepth.frame import check_image_size, frame_number
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration
from lightdepth.which_frame import Stamps

_DATA_SETS = (c3vd.FORMAT, simcol.FORMAT, hamlyn.FORMAT, scared.FORMAT, endoslam.FORMAT, endomapper.FORMAT)
_BY_NAME = {data_set.name: data_set for data_set in (folder.FORMAT, *_DATA_SETS)}
FORMATS = (*_BY_NAME, "video")
FormatName = Literal["folder", "c3vd", "simcol", "hamlyn", "scared", "endoslam", "endomapper", "video"]
_DEEP, _MANY = 3, 200  # folders within which sequences are looked for, to name them, and entries of each


def open_sequence(
    path: str | Path,
    format: str | None = None,
    camera: str | Path | None = None,
    light: str | Path | None = None,
    mask: str | Path | None = None,
    map_camera: CameraModel | None = None,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames at `path`, of a format found by looking or named; lazy but for a few frames that are checked.

    `light` and `mask` are files (light also `gamma=2.2,mu=0`) that win over what is in the folder; a light from here
    was given, even where its file calls it assumed. Camera, in order:
    the file given; the format's own; the map's. For EndoMapper the map's wins, because its maps were not made with the
    published calibration. `bit_depth` is that of pictures of more than 8 bits, found by looking where it is left out.
    `check_sequence` says what is doubtful.
    """
    path = Path(path)
    with reading(path, "frames that can be read", "expected files that are there and may be read"):
        try:
            return check_sequence(_open(path, format, camera, light, mask, map_camera, bit_depth))
        except InputError as error:
            cure = ""
            if path.is_dir() and not _is_cluster(path, format):
                cure = _other_format(path, format) if format is not None else _folders_below(path)
            if not cure:
                raise
            raise InputError(error.where, error.found, f"{error.cure}{cure}") from error


def stamps_of(path: str | Path, format: str | None = None) -> Stamps:
    """Which frames are at `path`, and when they were: of a video by its own times; of a folder by times.csv, by names
    that are times, else by the times that stand with its true poses. Nothing is looked up before it is asked for."""
    path = Path(path)
    images: Path = path
    if path.is_dir() and not _is_cluster(path, format):
        data_set = _BY_NAME.get(format) if format is not None else _looks_like(path)
        images = (data_set or folder.FORMAT).images(path)

    def load() -> tuple[np.ndarray, np.ndarray | None]:
        try:
            video = video_at(path) if format in (None, "video") else None
            if video is not None:
                times = open_clip(video).times
                return np.arange(len(times)), np.asarray(times, np.float64)
            return folder.stamps(path, list_images(images) if images.is_dir() else [])
        except (InputError, OSError):
            return np.zeros(0, int), None  # what is wrong is said when the frames are opened

    return Stamps(load, str(images))


def frames_at(path: Path, format: str | None = None) -> list[Path]:
    """The frames' files in order; none of a video, whose frames have no files."""
    if not path.is_dir() or (format in (None, "video") and video_at(path) is not None) or _is_cluster(path, format):
        return []
    data_set = _BY_NAME.get(format) if format is not None else _looks_like(path)
    chosen = data_set or folder.FORMAT
    images = chosen.images(path)
    files = list_images(images) if images.is_dir() else []
    return [file for file in files if chosen.word in file.name] or files


def image_files(path: Path, format: str | None = None) -> dict[int, str]:
    """Names of the frames' files by frame number; none of a video."""
    return {frame_number(p.name): p.name for p in frames_at(path, format)}


def _open(
    path: Path,
    format: str | None,
    camera: str | Path | None,
    light: str | Path | None,
    mask: str | Path | None,
    map_camera: CameraModel | None,
    bit_depth: int | None,
) -> FrameSequence:
    cluster = _is_cluster(path, format)
    video = video_at(path) if format in (None, "video") else None
    if video is not None:
        return _open_video(video, camera, light, mask, map_camera, bit_depth)
    if not path.is_dir() and not cluster:
        found = "is a file" if path.is_file() else "does not exist"
        raise InputError(path, found, "expected a folder of frames, or a video such as .mp4 or .mov")
    if format == "video":
        raise InputError(path, "no video in it, or images beside it", "give the video file itself")
    if format is not None and format not in _BY_NAME:
        raise InputError("format", f"{format!r} is not known", f"expected one of {', '.join(FORMATS)}")
    if cluster:
        data_set = endomapper.FORMAT
    elif format is not None:
        data_set = _BY_NAME[format]
    else:
        data_set = _looks_like(path) or folder.FORMAT
    images = data_set.images(path)
    chosen_light = None if light is None else _given(read_light(light))
    first = legible(list_images(images))
    chosen_mask = read_mask(Path(mask), first) if mask is not None else None
    chosen = _read_camera(Path(camera), images) if camera is not None else None
    if chosen is not None and first is not None:
        check_image_size(str(first), *image_size(first), chosen)
    if chosen is None and map_camera is not None and not data_set.has_camera(path):
        chosen = _at_size_of_images(map_camera, images)
    return data_set.read(path, chosen, chosen_light, chosen_mask, bit_depth=bit_depth)


def _given(light: PhotometricCalibration) -> PhotometricCalibration:
    """A light that somebody chose, which nothing that is found on a map replaces."""
    return replace(light, source="given") if light.assumed else light


def _is_cluster(path: Path, format: str | None) -> bool:
    """Whether the path is of a COLMAP cluster of EndoMapper's, which may be a file."""
    return format in (None, "endomapper") and endomapper.cluster_of(path) is not None


def _looks_like(path: Path) -> Format | None:
    """The data set whose files a folder has."""
    return next((data_set for data_set in _DATA_SETS if data_set.fits(path)), None)


def _other_format(path: Path, format: str) -> str:
    """What to try where the format that was named does not fit."""
    other = _looks_like(path)
    return (
        "" if other is None or other.name == format else f". By its files it looks like {option('format')} {other.name}"
    )


def _folders_below(path: Path) -> str:
    """What to give where a folder holds sequences, and is none."""
    if is_sequence(path):
        return ""
    found: list[Path] = []
    level = [path]
    for _ in range(_DEEP):
        below = [p for folder in level for p in folders_in(folder)[:_MANY] if p.name != "truth"]
        found += [p for p in below if is_sequence(p)]
        level = [p for p in below if p not in found]
    if not found:
        return ""
    names = ", ".join(str(p) for p in found[:3]) + (f" and {len(found) - 3} more" if len(found) > 3 else "")
    return f". It holds folders of frames: give one of them ({names})"


def is_sequence(path: Path) -> bool:
    """Whether a folder has frames as files, of any format."""
    return any(data_set.fits(path) for data_set in _BY_NAME.values())


def _read_camera(file: Path, folder: Path) -> CameraModel:
    """The camera of a file; one that holds no size, as intrinsics.txt, is for the images in the folder."""
    first = None if file.suffix.lower() == ".xml" else legible(list_images(folder))
    return read_camera(file, None if first is None else image_size(first))


def _open_video(
    video: Path,
    camera: str | Path | None,
    light: str | Path | None,
    mask: str | Path | None,
    map_camera: CameraModel | None,
    bit_depth: int | None,
) -> FrameSequence:
    """The frames of a video; a camera's file that holds no size, as intrinsics.txt, is for the video's."""
    chosen = None
    if camera is not None:
        opened = open_clip(video)
        chosen = read_camera(Path(camera), (opened.width, opened.height))
        check_turned(opened, chosen)
        check_image_size(str(video), opened.width, opened.height, chosen)
    chosen_light = None if light is None else _given(read_light(light))
    chosen_mask = read_mask(Path(mask)) if mask is not None else None
    return read_video(video, chosen, chosen_light, chosen_mask, map_camera, bit_depth)


def _at_size_of_images(camera: CameraModel, folder: Path) -> CameraModel:
    """A map's camera at the size of the images: a SLAM often works at half size. Cropped images are refused."""
    size = _size_of_images(folder)
    return camera if size is None else endomapper.at_size(camera, *size, str(folder))


def _size_of_images(folder: Path) -> tuple[int, int] | None:
    """Width and height of the first image, where there is one."""
    image = _first_image(folder)
    return None if image is None else image_size(image)


def size_of_frames(path: Path, format: str | None = None) -> tuple[int, int]:
    """Width and height of the frames at `path`, a video or a folder, as far as they need no camera."""
    video = video_at(path) if format in (None, "video") and path.exists() else None
    if video is not None:
        opened = open_clip(video)
        return opened.width, opened.height
    if not path.is_dir():
        found = "is a file" if path.is_file() else "does not exist"
        raise InputError(path, found, "expected a folder of frames, or a video such as .mp4 or .mov")
    data_set = _BY_NAME.get(format or "") or _looks_like(path) or folder.FORMAT
    first = legible(list_images(data_set.images(path)))
    if first is None:
        raise InputError(path, f"{no_images(data_set.images(path))}", "expected frames such as 000123.png")
    return image_size(first)


def _first_image(folder: Path) -> Path | None:
    return next(iter(list_images(folder)), None)
