"""What a keyframe folder of SCARED is kept in: numbered members of an archive or of a folder, and the stereo video.

Archives are read where they are, a member at a time and by its name alone; going back in one starts from its beginning.
"""

from __future__ import annotations

import os
import re
import tarfile
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.datasets.sequence import numbered_files
from lightdepth.errors import InputError

VIDEO = Path("data") / "rgb.mp4"
IMAGES = {"left": "Left_Image.png", "right": "Right_Image.png"}
_LARGEST = 256 << 20  # bytes of one member of an archive: a scene's points are 31 MB


class Folder:
    """Numbered files of a folder."""

    cheap = True

    def __init__(self, folder: Path, pattern: str):
        self._files = numbered_files(folder, pattern)

    def get(self, number: int) -> tuple[str, bytes] | None:
        file = self._files.get(number)
        return None if file is None else (str(file), file.read_bytes())

    def all(self) -> list[tuple[int, str, bytes]]:
        return [(n, str(file), file.read_bytes()) for n, file in self._files.items()]


class Archive:
    """Numbered members of a .tar.gz. Nothing is unpacked to the disk; only the last part of a member's name counts."""

    cheap = False

    def __init__(self, path: Path, pattern: str):
        self._path, self._pattern = path, pattern
        self._found: dict[int, tarfile.TarInfo] = {}
        self._tar: tarfile.TarFile | None = None
        self._complete = False
        self._process = 0

    def get(self, number: int) -> tuple[str, bytes] | None:
        try:
            self._open()
            while number not in self._found and not self._complete:
                self._next()
            return self._read(number) if number in self._found else None
        except (OSError, EOFError, tarfile.TarError) as error:
            raise self._broken(error) from error

    def all(self) -> list[tuple[int, str, bytes]]:
        """Every member in the archive's own order, which costs one pass."""
        members = []
        try:
            self._open()
            while not self._complete:
                number = self._next()
                if number is not None:
                    members.append((number, *self._read(number)))
        except (OSError, EOFError, tarfile.TarError) as error:
            raise self._broken(error) from error
        return members

    def _open(self) -> None:
        if self._process != os.getpid():  # a data loader's worker must not share the place in the file
            self._tar = tarfile.open(self._path, "r:*")  # noqa: SIM115 - the next frame goes on from here
            self._found, self._complete, self._process = {}, False, os.getpid()

    def _next(self) -> int | None:
        """Steps to the next member; its number, if it is one of ours."""
        assert self._tar is not None
        member = self._tar.next()
        if member is None:
            self._complete = True
            return None
        match = re.fullmatch(self._pattern, member.name.replace("\\", "/").rsplit("/", 1)[-1])
        if match is None or not member.isfile():
            return None
        if int(match[1]) in self._found:
            raise InputError(f"{self._path}: two members have the number {int(match[1])}")
        if member.size > _LARGEST:
            raise InputError(f"{self._path}: {member.name} has {member.size} bytes; expected at most {_LARGEST}")
        self._found[int(match[1])] = member
        return int(match[1])

    def _read(self, number: int) -> tuple[str, bytes]:
        assert self._tar is not None
        member = self._found[number]
        stream = self._tar.extractfile(member)
        assert stream is not None
        return f"{self._path}: {member.name}", stream.read()

    def _broken(self, error: Exception) -> InputError:
        return InputError(f"{self._path}: cannot be read ({error}); copied incompletely, or not a .tar.gz?")


def numbered_members(folder: Path, name: str, pattern: str) -> Folder | Archive | None:
    """The extracted folder where there is one, else the archive."""
    if numbered_files(folder / name, pattern):
        return Folder(folder / name, pattern)
    archive = folder / f"{name}.tar.gz"
    return Archive(archive, pattern) if archive.is_file() else None


class StereoVideo:
    """Frames of rgb.mp4 by number; in order they cost one decoding each."""

    def __init__(self, path: Path):
        self._path = path
        self._container: Any = None
        self._frames: Any = None
        self._next = 0
        self._last: tuple[int, np.ndarray] | None = None
        self._process = 0
        with self._opened() as container:
            stream = container.streams.video[0]
            self.width, rows = stream.codec_context.width, stream.codec_context.height
            self.fps = float(stream.average_rate or 25)
            self.count = stream.frames or sum(1 for _ in container.demux(stream)) - 1  # demuxing ends with an empty one
        if rows % 2:
            raise InputError(f"{path}: {self.width}x{rows}; expected the left view above the right, of one height")
        self.height = rows // 2

    def _opened(self) -> Any:
        import av

        try:
            return av.open(str(self._path))
        except (OSError, av.error.FFmpegError) as error:
            raise InputError(f"{self._path}: not a readable video ({error})") from error

    def frame(self, number: int) -> np.ndarray:
        """(2 H, W, 3) float32 RGB in [0, 1], both views."""
        import av

        if self._last is not None and self._last[0] == number:
            return self._last[1]
        try:
            if self._process != os.getpid() or not self._next <= number <= self._next + 60:
                self._seek(number)
            while True:
                frame = next(self._frames)
                found = self._index(frame)
                self._next = found + 1
                if found >= number:
                    break
        except (StopIteration, av.error.FFmpegError) as error:
            raise InputError(f"{self._path}: frame {number} cannot be decoded; is the video complete?") from error
        if found != number:
            raise InputError(f"{self._path}: there is no frame {number}; the next is {found}")
        self._last = (number, frame.to_ndarray(format="rgb24").astype(np.float32) / np.float32(255))
        return self._last[1]

    def _seek(self, number: int) -> None:
        """To the last frame before `number` that is coded by itself."""
        if self._process != os.getpid():  # a data loader's worker must not share the place in the file
            self._container, self._process = self._opened(), os.getpid()
        stream = self._container.streams.video[0]
        time = int(number / (self.fps * stream.time_base)) + (stream.start_time or 0)
        self._container.seek(time, stream=stream)
        self._frames = self._container.decode(stream)

    def _index(self, frame: Any) -> int:
        stream = self._container.streams.video[0]
        return round(float((frame.pts - (stream.start_time or 0)) * stream.time_base) * self.fps)
