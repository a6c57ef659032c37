"""What the readers of folders share: the record by which `open_sequence` knows a data set, the checks of its images,
and frames made of them one by one."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.datasets.sequence import (
    FrameSequence,
    along_ray,
    check_files,
    check_one_size,
    found_mask,
    read_code,
    warn_of_border,
    warn_of_gaps,
    warn_of_orientation,
)
from lightdepth.errors import InputError
from lightdepth.files.depths import white_of
from lightdepth.files.images import read_image
from lightdepth.frame import Frame, frame_number
from lightdepth.photometry import PhotometricCalibration


class Reader(Protocol):
    """Reads the frames of a folder."""

    def __call__(
        self,
        path: Path,
        camera: CameraModel | None = None,
        light: PhotometricCalibration | None = None,
        mask: np.ndarray | None = None,
        *,
        bit_depth: int | None = None,
    ) -> FrameSequence: ...


Poses = Sequence[np.ndarray | None] | np.ndarray | InputError | None
"""True poses (4, 4) of images in order; an InputError where those that there are cannot be used."""


def poses_or_why(read: Callable[[], Poses]) -> Poses:
    """What `read` gives, or the InputError that it raises: what needs no truth goes on without it."""
    try:
        return read()
    except InputError as error:
        return error


_NEAREST_MM = 1.0  # no frame shows nothing but wall that is nearer than this


@dataclass(frozen=True)
class Format:
    """A data set: how its folders are told by their files, and how they are read."""

    name: str
    """What --format calls it."""
    fits: Callable[[Path], bool]
    """Whether a folder has the data set's files."""
    images: Callable[[Path], Path]
    """The folder in which the images of a sequence lie."""
    has_camera: Callable[[Path], bool]
    """Whether a sequence brings a camera that wins over a map's."""
    read: Reader
    """The frames of a folder; camera, light and mask win over the files in it where they are given;
    `bit_depth` is that of pictures of more than 8 bits, found by looking where it is left out."""
    word: str = ""
    """What is in the names of the frames, where pictures of their truth lie among them."""


@dataclass(frozen=True)
class DepthCode:
    """How a data set writes depth along the axis in 16 bits: full_mm * code / full; 0 is unknown, and `clipped` too."""

    whose: str
    """The data set's name, for messages."""
    full: int = 1
    """The code of `full_mm`."""
    full_mm: float = 1.0
    """Millimetres that `full` stands for."""
    clipped: int = 1 << 16
    """The least code that only says that the wall is farther; 65536, which no code reaches, where there is none."""

    def distance(self, file: Path, ray_z: np.ndarray) -> np.ndarray:
        """(H, W) float32 distance along the ray [mm], 0 where unknown, of an image with these rays' z."""
        code = read_code(file, ray_z, self.whose)
        farthest = float(code.max()) / self.full * self.full_mm
        if 0 < farthest < _NEAREST_MM:
            raise InputError(
                file,
                f"depth codes up to {code.max()}, which would be {farthest:.2g} mm",
                f"expected {self.whose}'s codes of 16 bits: these look like 8 bits kept in 16",
            )
        return along_ray(code.astype(np.float32) / self.full * self.full_mm, (code > 0) & (code < self.clipped), ray_z)


def checked_images(path: Path, images: Sequence[Path], depth: Container[int] | None = None) -> list[int]:
    """The frame numbers of a sequence's images. Raises InputError where their sizes differ; where `depth` holds the
    numbers of frames with depth, warns of the others."""
    check_files(images)
    check_one_size(images)
    numbers = [frame_number(image.name) for image in images]
    if depth is not None:
        warn_of_gaps(path, numbers, depth)
    return numbers


def frames_of(
    path: Path,
    images: Sequence[Path],
    camera: CameraModel,
    light: PhotometricCalibration,
    mask: np.ndarray | None,
    *,
    names: Sequence[str] | None = None,
    times: Sequence[float | None] | None = None,
    poses: Poses = None,
    distance: Callable[[int], np.ndarray | None] | None = None,
    bit_depth: int | None = None,
    bordered: bool = False,
) -> FrameSequence:
    """The images as frames. Names (the files' stems where left out), times [s], poses and what reads the true distance
    [mm] go by the image's place in the list; poses that are an InputError are refused with it where the truth is asked
    for. Without a mask the black border is found, and said unless the data set is known to have one (`bordered`)."""
    called = [image.stem for image in images] if names is None else names
    check_files(images)
    white = white_of(images, bit_depth)
    warn_of_orientation(path, images)
    if mask is None:
        mask = found_mask(images, white)
        if mask is not None and not bordered:
            warn_of_border(path, mask)

    def pose(i: int, with_truth: bool) -> np.ndarray | None:
        if isinstance(poses, InputError):
            if with_truth:
                raise InputError(poses.where, poses.found, poses.cure) from poses
            return None
        return None if poses is None else poses[i]

    def load(i: int, with_truth: bool = True) -> Frame:
        return Frame(
            called[i],
            read_image(images[i], white),
            camera,
            light,
            mask,
            time=None if times is None else times[i],
            true_distance=None if distance is None or not with_truth else distance(i),
            true_world_from_cam=pose(i, with_truth),
        )

    return FrameSequence(called, load, str(path), load_blind=partial(load, with_truth=False))
