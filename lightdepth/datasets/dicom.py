"""DICOM files of one or many frames, as a video: frame n is the n-th picture, at the time that the header gives it.

Pixels may lie as they are, or in RLE, JPEG, JPEG 2000, or be a whole MPEG-2, H.264 or HEVC video, which is read in
place. Of the header only what describes the pictures is read (`_ELEMENTS`): names, dates, places and numbers that tell
a patient never get into memory, and what pydicom says of a broken file is not passed on, as it may quote them.

It needs the extra `dicom` (pydicom). Sizes are checked by the header before anything is decoded.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lightdepth.datasets.clip import Clip, brightened, white_level
from lightdepth.datasets.dicom_parts import (
    Part,
    Window,
    frames_in_items,
    items_of,
    native_frames,
    out_of_boxes,
    pixel_element,
)
from lightdepth.datasets.video import VideoFile
from lightdepth.errors import InputError
from lightdepth.files.headers import header_in
from lightdepth.regular import irregular

DICOM_SUFFIXES = (".dcm", ".dicom", ".dic")
_ELEMENTS = (
    *("Rows", "Columns", "NumberOfFrames", "SamplesPerPixel", "PhotometricInterpretation", "PlanarConfiguration"),
    *("BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation", "PixelAspectRatio", "BurnedInAnnotation"),
    *("FrameIncrementPointer", "FrameTime", "FrameTimeVector", "CineRate", "RecommendedDisplayFrameRate"),
)
_COLOURS = ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT")
_OTHERS = ("PALETTE COLOR", "HSV", "ARGB", "CMYK", "YBR_PARTIAL_422", "YBR_PARTIAL_420")
_GREYS = ("MONOCHROME1", "MONOCHROME2")
_NATIVE = {"1.2.840.10008.1.2": True, "1.2.840.10008.1.2.1": False}  # whether the VR is implicit
_COMPRESSED = "1.2.840.10008.1.2.4."
_VIDEOS = tuple(f"{_COMPRESSED}{n}" for n in range(100, 109))  # MPEG-2, H.264, HEVC, and their fragmented kin
_RLE = "1.2.840.10008.1.2.5"
_MOST_PIXELS, _MOST_FRAMES = 2**26, 10**6
_MOST_MISSING = 1000  # announced frames for each one that is there, from which the number is wrong and no file cut off
_LONGEST_MS = 1e5  # from a frame to the next
_CONVERT = "convert it without compression (dcmdjpeg of DCMTK, or gdcmconv --raw), or export a video"


@dataclass(frozen=True)
class DicomHeader:
    """What describes the pictures of a DICOM file, and where they are. `times` (n,) [s] of the announced frames are
    None where nothing tells them."""

    syntax: str
    syntax_name: str
    width: int
    height: int
    samples: int
    announced: int
    allocated: int
    stored: int
    colours: str
    planar: int
    pixel_aspect: float
    times: np.ndarray | None
    frames: list[tuple[Part, ...]]


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by its ending or its mark."""
    if path.suffix.lower() in DICOM_SUFFIXES:
        return True
    if irregular(path):
        return False
    try:
        with path.open("rb") as stream:
            return stream.read(132)[128:] == b"DICM"
    except OSError:
        return False


def open_dicom(path: Path, bit_depth: int | None = None) -> Clip:
    """The pictures of a DICOM file. Raises InputError where they cannot be read, and where pydicom is missing."""
    header = read_header(path)
    if not header.syntax.startswith(_VIDEOS):
        return DicomFile(path, header, bit_depth)
    parts = tuple(part for frame in header.frames for part in frame)
    video = VideoFile(path, bit_depth, Window(path, parts))
    if not video.timed and header.times is not None:
        steps = header.times[1] if len(header.times) > 1 else 0.0
        same = len(header.times) == len(video)
        video.times = header.times if same else steps * np.arange(len(video))
    video.tags = [*video.tags, "DICOM header"]
    return video


class DicomFile:
    """Pictures of a DICOM file by index (see `Clip`). Each is read from the file when it is asked for."""

    def __init__(self, path: Path, header: DicomHeader, bit_depth: int | None = None):
        self.path, self._header = path, header
        self.codec, self.pixel_aspect = header.syntax_name, header.pixel_aspect
        self.width, self.height, self.bits = header.width, header.height, header.stored
        self.white = white_level(self.bits, bit_depth)
        self.missing = header.announced - len(header.frames)
        self.times = np.full(header.announced, np.nan) if header.times is None else header.times
        steps = np.diff(self.times)
        self.rate = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else None
        self.keyframes = list(range(len(header.frames)))
        self.rotation, self.interlaced, self.tags = 0, False, ["DICOM header"]
        self.read(0)  # refused here where it cannot be decoded

    def __len__(self) -> int:
        return self._header.announced

    def read(self, index: int) -> np.ndarray:
        """Picture (H, W, 3) RGB, uint8, or uint16 where there are more than 8 bits."""
        index = range(len(self))[index]
        if index >= len(self._header.frames):
            raise InputError(
                self.path,
                f"frame {index} is not there: the header announces {len(self)} frames and {len(self._header.frames)} "
                "are in the file, which was cut off",
                "copy it again, or use the frames before",
            )
        data = Window(self.path, self._header.frames[index]).read()
        pixels = _decoded(data, self._header, f"{self.path}: frame {index}")
        return brightened(pixels, self.white, str(self.path))


def read_header(path: Path) -> DicomHeader:
    """Raises InputError where the file is no DICOM file, or holds what is not read."""
    pydicom = _pydicom(path)
    size = os.path.getsize(path)
    with _private(path, "not a DICOM file that can be read"), path.open("rb") as stream:
        if stream.read(132)[128:] != b"DICM":
            raise InputError(path, "not a DICOM file: the mark DICM is missing", "copy it again, or export it anew")
        uid = pydicom.filereader.read_file_meta_info(str(path)).TransferSyntaxUID
        syntax, name = str(uid), str(uid.name) if str(uid).startswith("1.2.840.10008.") else "a private one"
        if syntax not in _NATIVE and not syntax.startswith((_COMPRESSED, _RLE)):
            raise InputError(path, f"DICOM in the transfer syntax {name}", _CONVERT)
        stream.seek(0)
        data = pydicom.dcmread(stream, stop_before_pixels=True, specific_tags=list(_ELEMENTS))
        said = {element: _value(data, element) for element in _ELEMENTS}
        start, length = pixel_element(stream, _NATIVE.get(syntax, False), path)
    announced = _whole(said, "NumberOfFrames", path, 1)
    return _checked(path, syntax, name, said, start, length, size, max(1, announced))


def _checked(
    path: Path, syntax: str, name: str, said: dict[str, Any], start: int, length: int | None, size: int, announced: int
) -> DicomHeader:
    height, width = _whole(said, "Rows", path), _whole(said, "Columns", path)
    samples, allocated = _whole(said, "SamplesPerPixel", path, 1), _whole(said, "BitsAllocated", path, 8)
    stored, colours = _whole(said, "BitsStored", path, allocated), str(said["PhotometricInterpretation"] or "").strip()
    video = syntax.startswith(_VIDEOS)
    if not 0 < width * height <= _MOST_PIXELS:
        raise InputError(path, f"DICOM pictures of {width}x{height}", f"expected up to {_MOST_PIXELS} pixels")
    if not video:
        if (colours not in _COLOURS or samples != 3) and (colours not in _GREYS or samples != 1):
            known = colours if colours in (*_COLOURS, *_GREYS, *_OTHERS) else "of another kind"  # or a name, astray
            raise InputError(
                path, f"DICOM colours {known}, of {samples} channels", "expected RGB, YBR or grey: export it as one"
            )
        if allocated not in (8, 16) or not 1 < stored <= allocated or _whole(said, "PixelRepresentation", path, 0):
            raise InputError(
                path, f"DICOM samples of {stored} bits in {allocated}", "expected unsigned samples of 8 or 16 bits"
            )
    frames = _frames(path, said, start, length, size, announced, syntax, width * height * samples * allocated // 8)
    lacking = not video and announced > min(_MOST_MISSING * len(frames), max(_MOST_FRAMES, len(frames)))
    if not frames or lacking:
        raise InputError(
            path,
            f"the header announces {announced} frames of {width}x{height}, and {len(frames)} are in the file",
            "copy it again, or export it anew",
        )
    if said["BurnedInAnnotation"] == "YES":
        warnings.warn(
            f"{path}: the file says that text is burnt into its pictures: look at them before you hand them on",
            stacklevel=6,
        )
    aspect = said["PixelAspectRatio"]
    ratio = float(aspect[1]) / float(aspect[0]) if aspect and len(aspect) == 2 and min(aspect) > 0 else 1.0
    planar = _whole(said, "PlanarConfiguration", path, 0)
    times = _times(said, min(announced, _MOST_FRAMES), path)
    return DicomHeader(
        syntax, name, width, height, samples, announced, allocated, stored, colours, planar, ratio, times, frames
    )


def _frames(
    path: Path,
    said: dict[str, Any],
    start: int,
    length: int | None,
    size: int,
    announced: int,
    syntax: str,
    frame_bytes: int,
) -> list[tuple[Part, ...]]:
    if syntax in _NATIVE:
        if length is None:
            raise InputError(path, "DICOM pixel data without a length", "copy it again, or export it anew")
        halved = str(said["PhotometricInterpretation"]).strip() == "YBR_FULL_422"
        return native_frames(start, length, size, frame_bytes * 2 // 3 if halved else frame_bytes, announced)
    if length is not None:
        raise InputError(path, "compressed DICOM pixel data that is not in items", "copy it again, or export it anew")
    with path.open("rb") as stream:
        offsets, items = items_of(stream, start, size, path)
        if syntax.startswith(_VIDEOS):
            return [tuple(items)] if items else []
        return frames_in_items(stream, offsets, items, announced)


def _decoded(data: bytes, header: DicomHeader, where: str) -> np.ndarray:
    """(H, W, 3) RGB of one frame's bytes."""
    pydicom = _pydicom(where)
    if header.syntax not in _NATIVE:
        data = out_of_boxes(data, where)  # pydicom stays in a box of length 0 for ever
        inside = header_in(data) if header.syntax != _RLE else None
        if inside is not None and (inside.width, inside.height) != (header.width, header.height):
            raise InputError(
                where,
                f"a picture of {inside.width}x{inside.height} where the header says {header.width}x{header.height}",
                "copy it again, or export it anew",
            )
    with _private(where, "does not decode"):
        decoder = pydicom.pixels.get_decoder(header.syntax)
        if not decoder.is_available:
            raise InputError(
                where,
                f"DICOM in {header.syntax_name}, for which no decoder is installed",
                f"pip install pylibjpeg pylibjpeg-libjpeg, or {_CONVERT}",
            )
        pixels, _ = decoder.as_array(
            data if header.syntax in _NATIVE else pydicom.encaps.encapsulate([data]),
            index=0,
            rows=header.height,
            columns=header.width,
            number_of_frames=1,
            samples_per_pixel=header.samples,
            bits_allocated=header.allocated,
            bits_stored=header.stored,
            photometric_interpretation=header.colours,
            pixel_representation=0,
            planar_configuration=header.planar if header.samples == 3 else None,
            pixel_keyword="PixelData",
        )
    return _eight_or_sixteen(np.asarray(pixels), header, where)


def _eight_or_sixteen(pixels: np.ndarray, header: DicomHeader, where: str) -> np.ndarray:
    if pixels.shape[:2] != (header.height, header.width):
        raise InputError(where, "a picture of another size than the header says", "copy it again, or export it anew")
    white = 2**header.stored - 1
    pixels = pixels & np.array(white, pixels.dtype)  # above them, old files keep drawings
    if header.colours == "MONOCHROME1":
        pixels = white - pixels  # where 0 is white
    if header.stored not in (8, 16):
        full = 255 if header.stored < 8 else 65535
        pixels = np.rint(pixels * (full / white)).astype(np.uint8 if header.stored < 8 else np.uint16)
    elif header.stored == 8:
        pixels = pixels.astype(np.uint8)
    return cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB) if pixels.ndim == 2 else np.ascontiguousarray(pixels)


def _times(said: dict[str, Any], count: int, path: Path) -> np.ndarray | None:
    """Times (n,) [s] of the frames: by the vector of their steps, by one step, or by a rate (PS3.3, C.7.6.5)."""
    steps = _numbers(said["FrameTimeVector"])
    if len(steps) == count and count > 1 and ((steps[1:] > 0) & (steps[1:] < _LONGEST_MS)).all():
        return np.asarray(np.cumsum(np.concatenate([[0.0], steps[1:]])) / 1000)
    if len(steps):
        warnings.warn(f"{path}: the header's FrameTimeVector does not fit {count} frames: it is ignored", stacklevel=7)
    for element in ("FrameTime", "CineRate", "RecommendedDisplayFrameRate"):
        value = _numbers(said[element])
        if len(value) == 1 and 0 < value[0] < _LONGEST_MS:
            step = float(value[0]) / 1000 if element == "FrameTime" else 1 / float(value[0])
            return np.asarray(step * np.arange(count))
    return None


def _numbers(value: Any) -> np.ndarray:
    """The finite numbers of a header's value; none where it is something else."""
    try:
        numbers = np.atleast_1d(np.asarray([] if value in (None, "") else value, np.float64))
    except (TypeError, ValueError):
        return np.zeros(0)
    return numbers if np.isfinite(numbers).all() else np.zeros(0)


def _value(data: Any, element: str) -> Any:
    """What the header says of one thing; None where that is broken, which matters for some things alone."""
    with suppress(Exception):
        return data.get(element)
    return None


def _whole(said: dict[str, Any], element: str, path: Path, otherwise: int | None = None) -> int:
    value = _numbers(said[element])
    if len(value) != 1 or value[0] != int(value[0]) or value[0] < 0:
        if otherwise is not None and len(value) == 0:
            return otherwise
        raise InputError(path, f"the DICOM header's {element} is no number", "copy it again, or export it anew")
    return int(value[0])


def _pydicom(where: str | Path) -> Any:
    try:
        import pydicom
        import pydicom.encaps
        import pydicom.pixels
    except ImportError as error:
        raise InputError(
            where, "a DICOM file, and pydicom is not installed", "install it: pip install 'lightdepth[dicom]'"
        ) from error
    return pydicom


@contextmanager
def _private(where: str | Path, found: str) -> Iterator[None]:
    """What pydicom raises becomes an InputError without its words, and what it warns of is not said: both may quote
    what the header says of a patient."""
    log = logging.getLogger("pydicom")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:
        kind = type(error).__name__
        raise InputError(where, f"{found} ({kind})", "copy it again, or export it anew") from None
    finally:
        log.setLevel(level)
