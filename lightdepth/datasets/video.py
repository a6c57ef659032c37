"""A video file: frame n is the n-th picture that it shows, counting from 0, at the time [s] the file gives it.

Opening reads the packets once without decoding them: their presentation times, in order, are the frames. Reading goes
forward from where it is, or from the keyframe before; a decoded picture is known by its own time, so what comes back is
exact after any jump. Frames that the file lacks or that do not decode are refused by number, the others are given.

Pixels are the stored ones: a flag that asks players to turn the pictures is left aside, as with pictures' EXIF. They
keep 16 bits where the file has more than 8.
"""

from __future__ import annotations

import os
import threading
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np

from lightdepth.datasets.clip import brightened, white_level
from lightdepth.errors import InputError
from lightdepth.files.reading import check_pixels, reading

# Formats that hold pictures themselves. Playlists, which name other files or hosts, are not among them.
_FORMATS = "mov,matroska,avi,mpeg,mpegts,mpegvideo,asf,mxf,flv,mjpeg,ogg,dv,h264,hevc,m4v,nut,ivf,yuv4mpegpipe"


_MOST_FRAMES = 10**7
"""Days of video: a header that announces more is broken."""
_TECHNICAL = {
    "major_brand",
    "minor_version",
    "compatible_brands",
    "encoder",
    "handler_name",
    "vendor_id",
    "language",
    "duration",
    "software",
}


@dataclass(frozen=True)
class _Index:
    """What the packets say. pts (n,) increasing [time_base]; keyframes are positions in it, the first is 0."""

    pts: list[int]
    keyframes: list[int]
    by_time: bool  # False: times are missing or double, pictures are counted from the start


class _Decoder:
    """A file open in one process: `at` is the least index that may come next, `pending` what came and was not taken."""

    def __init__(self, container: Any, stream: Any, pid: int):
        self.container, self.stream, self.pid = container, stream, pid
        self.restart()

    def restart(self) -> None:
        """From where the container was put."""
        self.frames = _decoded(self.container, self.stream)
        self.pending: tuple[int, Any] | None = None
        self.at = 0


class VideoFile:
    """Pictures of a video by index. One reader at a time decodes; every process opens the file for itself.

    `times` (n,) [s], NaN where the file does not tell; `missing` frames at the end are announced by the file's header
    and not in it; `keyframes` are indices that are quick to reach; `tags` name the metadata that may tell a patient;
    `timed`: pictures have times of their own; `rotation` is by how many degrees players are asked to turn them,
    `interlaced` what the first one says. `content` opens the video where it is a part of the file alone; `bit_depth`
    says which samples of more than 8 bits are white, where that is not the highest of their type.
    """

    def __init__(self, path: str | Path, bit_depth: int | None = None, content: Callable[[], BinaryIO] | None = None):
        self.path = Path(path)
        self._content = content
        self._lock = threading.Lock()
        self._decoder: _Decoder | None = None
        self._last: tuple[int, np.ndarray] | None = None
        with reading(self.path, "a video that can be read"):
            self._look(bit_depth)

    def _look(self, bit_depth: int | None) -> None:
        """What the packets and the first picture say."""
        container, stream = self._opened()
        with container:
            codec = stream.codec_context
            self.codec, self.format = codec.name, container.format.name
            self.rate = None if stream.average_rate is None else float(stream.average_rate)
            self.pixel_aspect = float(stream.sample_aspect_ratio or 1)
            self.tags = sorted({key.lower() for key in (*container.metadata, *stream.metadata)} - _TECHNICAL)
            time_base, expected = stream.time_base, stream.frames
            index, stamps = _index_of(container, stream)
        self.missing = max(0, expected - len(stamps)) if "mov" in self.format else 0  # others only estimate
        if self.missing > min(_MOST_FRAMES, 1000 * (len(stamps) + 1)):
            found = f"the header announces {expected} frames, and {len(stamps)} are in the file"
            raise InputError(self.path, found, "copy it again")
        first = self._first_decoded()
        if index is not None and first.pts in index.pts:
            index = _from(index, index.pts.index(first.pts))  # what comes before the first keyframe never decodes
        else:
            index = self._counted()
        self._index = index
        self._position = {pts: i for i, pts in enumerate(index.pts)}
        self.keyframes = index.keyframes
        self.interlaced = bool(first.interlaced_frame)
        self.rotation = first.rotation % 360
        self.bits = max(component.bits for component in first.format.components)
        self.white = white_level(self.bits, bit_depth)
        self.height, self.width = self._pixels(first).shape[:2]
        times = self._times(stamps, time_base)
        self.timed = self._index.by_time
        self.times = np.array(times + [np.nan] * self.missing)

    def __len__(self) -> int:
        return len(self.times)

    def read(self, index: int) -> np.ndarray:
        """Picture (H, W, 3) RGB, uint8, or uint16 where the file has more than 8 bits."""
        with self._lock, reading(self.path, "a video that can be read"):
            return self._read(range(len(self))[index])

    def _read(self, index: int) -> np.ndarray:
        count = len(self._index.pts)
        if index >= count:
            raise InputError(
                self.path,
                f"frame {index} is not there: the header announces {len(self)} frames and {count} are in the file, "
                "which was cut off",
                "copy it again, or use the frames before",
            )
        if self._last is None or self._last[0] != index:
            self._last = (index, self._pixels(self._decoded_at(index)))
        return self._last[1]

    def _decoded_at(self, index: int) -> Any:
        decoder = self._decoder_before(index)
        while True:
            at, frame = self._upcoming(decoder)
            if frame is None or at > index:
                raise InputError(
                    self.path,
                    f"frame {index} of {len(self)} does not decode: the file is damaged there",
                    "leave this one out; the others can be read",
                )
            decoder.pending, decoder.at = None, at + 1
            if at == index:
                return frame

    def _upcoming(self, decoder: _Decoder) -> tuple[int, Any]:
        """The next decoded picture and its index, without taking it; None at the end."""
        while decoder.pending is None:
            frame = next(decoder.frames, None)
            if frame is None:
                return len(self), None
            at = self._position.get(frame.pts) if self._index.by_time else decoder.at
            if at is not None and at >= decoder.at:
                decoder.pending = (at, frame)
        return decoder.pending

    def _decoder_before(self, index: int) -> _Decoder:
        """A decoder that comes to `index`: the one there is, where that is the shortest way, else one put on the
        keyframe before, or on an earlier one where the container's jump went too far."""
        decoder, keyframes = self._decoder, self._index.keyframes
        before = bisect_right(keyframes, index) - 1
        if decoder is not None and decoder.pid != os.getpid():
            decoder = None  # a forked process shares the place in the file with its parent
        if decoder is not None and keyframes[before] <= decoder.at <= index:
            return decoder
        for start in dict.fromkeys(keyframes[k] for k in (before, max(before - 1, 0), 0)):
            if start == 0 or decoder is None:
                if decoder is not None:
                    decoder.container.close()
                decoder = self._decoder = _Decoder(*self._opened(), os.getpid())
            if start > 0:
                decoder.container.seek(self._index.pts[start], stream=decoder.stream)
            decoder.restart()
            if start == 0 or self._upcoming(decoder)[0] <= index:
                break
        assert decoder is not None
        return decoder

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_lock": None, "_decoder": None, "_last": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def _opened(self) -> tuple[Any, Any]:
        whole = str(self.path) if self._content is None else self._content()
        try:
            options = {"format_whitelist": _FORMATS, "protocol_whitelist": "file"}
            container = av.open(whole, options=options, metadata_errors="replace")  # which need not be UTF-8
        except (av.error.FFmpegError, OSError) as error:
            raise InputError(
                self.path,
                f"not a video that can be read ({error.strerror or error})",
                "copy it again, or convert it to .mp4",
            ) from error
        if not container.streams.video:
            container.close()
            raise InputError(self.path, "no pictures in it", "expected a video")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            container.close()
            raise InputError(
                self.path, "a video in a codec that FFmpeg does not know, or damaged", "convert it to .mp4, with H.264"
            )
        # A process that is forked while a decoder has threads, as a DataLoader's workers are, hangs when it frees it.
        if stream.width and stream.height:
            try:
                check_pixels(stream.width, stream.height, self.path)
            except InputError:
                container.close()
                raise
        stream.thread_type, stream.codec_context.thread_count = "NONE", 1
        return container, stream

    def _first_decoded(self) -> Any:
        container, stream = self._opened()
        with container:
            frame = next(_decoded(container, stream), None)
        if frame is None:
            raise InputError(self.path, "none of its pictures decodes: it is damaged, or not a video", "copy it again")
        return frame

    def _counted(self) -> _Index:
        """By decoding all of it: for the few files whose packets do not tell."""
        container, stream = self._opened()
        with container:
            found = [(frame.pts, frame.key_frame) for frame in _decoded(container, stream)]
        times = [pts for pts, _ in found]
        if None not in times and all(a < b for a, b in pairwise(times)):
            return _Index(times, sorted({0, *(i for i, (_, key) in enumerate(found) if key)}), True)
        return _Index(list(range(len(found))), [0], False)

    def _times(self, stamps: list[int | None], time_base: Fraction) -> list[float]:
        """Times [s] of the pictures: their own; else those of the packets in order, one each; else by the rate."""
        if self._index.by_time:
            return [float(pts * time_base) for pts in self._index.pts]
        known = sorted({stamp for stamp in stamps if stamp is not None})
        if len(known) == len(self._index.pts):
            return [float(stamp * time_base) for stamp in known]
        return [i / self.rate if self.rate else float("nan") for i in range(len(self._index.pts))]

    def _pixels(self, frame: Any) -> np.ndarray:
        try:
            pixels = frame.to_ndarray(format="rgb48le" if self.bits > 8 else "rgb24", threads=1)
        except (av.error.FFmpegError, ValueError, MemoryError) as error:
            raise InputError(
                self.path,
                f"{frame.format.name} pictures that become no RGB ({error})",
                "convert it to .mp4, with H.264",
            ) from error
        return brightened(pixels, self.white, str(self.path))


def _index_of(container: Any, stream: Any) -> tuple[_Index | None, list[int | None]]:
    """Times and keyframes from the packets, None where they do not tell; and when each packet is decoded."""
    shown, stamps, known = [], [], True
    try:
        for packet in container.demux(stream):
            if packet.size == 0:  # the end, or a frame that AVI repeats
                continue
            stamps.append(packet.dts)
            if packet.pts is None:
                known = False
            elif not packet.is_discard:
                shown.append((packet.pts, packet.is_keyframe))
    except av.error.FFmpegError:
        pass  # cut off in the middle of a packet: what came before counts
    shown.sort()
    pts = [p for p, _ in shown]
    if not known or not pts or any(a == b for a, b in pairwise(pts)):
        return None, stamps
    return _Index(pts, sorted({0, *(i for i, (_, key) in enumerate(shown) if key)}), True), stamps


def _from(index: _Index, first: int) -> _Index:
    keyframes = sorted({0, *(k - first for k in index.keyframes if k >= first)})
    return _Index(index.pts[first:], keyframes, True)


def _decoded(container: Any, stream: Any) -> Iterator[Any]:
    """Pictures in the order they are shown; what is damaged is left out."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            packet = None
        if packet is None:
            break
        try:
            frames = packet.decode()
        except av.error.FFmpegError:
            continue
        yield from (frame for frame in frames if not frame.is_corrupt)
