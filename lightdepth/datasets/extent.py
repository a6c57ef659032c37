"""How much there is of a sequence, told in milliseconds: its frames, their size, and digits that know it again."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from lightdepth.datasets.reading import frames_at, is_sequence, size_of_frames
from lightdepth.datasets.video_sequence import open_clip, video_at
from lightdepth.errors import InputError
from lightdepth.files.below import files_below, is_result
from lightdepth.files.replacing import hidden

_DEEP = 3
"""Folders within which sequences are looked for."""
_READ = 1 << 20
"""Bytes that are read of a file, at its beginning and at its end."""


@dataclass(frozen=True)
class Extent:
    """Of a sequence."""

    frames: int
    width: int
    height: int
    digits: str
    """64 digits of names, sizes and some contents: another sequence has others, wherever it lies"""

    @property
    def pixels(self) -> int:
        """Of all frames together."""
        return self.frames * self.width * self.height


def extent_of(path: Path, format: str | None = None) -> Extent:
    """What is at a path. Raises InputError where it is no sequence.

    The digits are of the names of all frames, and of the contents of the first, the middle and the last one: to read
    all of thousands of sequences would take hours.
    """
    video = video_at(path) if format in (None, "video") and path.exists() else None
    if video is not None:
        clip = open_clip(video)
        return Extent(len(clip), clip.width, clip.height, digits_of(video))
    width, height = size_of_frames(path, format)
    files = frames_at(path, format)
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.name}\0".encode("utf-8", "surrogateescape"))
    for file in dict.fromkeys(files[i] for i in (0, len(files) // 2, -1) if files):
        digest.update(digits_of(file).encode())
    return Extent(len(files), width, height, digest.hexdigest())


def digits_of(path: Path) -> str:
    """64 digits of a file's size, beginning and end; of a folder, of the names of its files and the digits of each."""
    digest = hashlib.sha256()
    if path.is_dir():
        for file in files_below(path):
            digest.update(f"{file.relative_to(path)}\0{digits_of(file)}".encode("utf-8", "surrogateescape"))
    else:
        size = path.stat().st_size
        digest.update(f"{size}\0".encode())
        with path.open("rb") as stream:
            digest.update(stream.read(_READ))
            if size > _READ:
                stream.seek(max(_READ, size - _READ))
                digest.update(stream.read(_READ))
    return digest.hexdigest()


def sequences_below(root: Path, without: Path) -> list[Path]:
    """The sequences in a folder of sequences, in order: folders of frames, folders with one video, and videos, no more
    than three folders down. Results of runs are passed over, and so are `without`, where results are to come to, and
    links to a folder that they are in."""
    return list(_sequences(root, os.path.realpath(without), _DEEP))


def _sequences(folder: Path, without: str, deep: int) -> Iterator[Path]:
    here = Path(os.path.realpath(folder))
    for path in sorted(folder.iterdir()):
        real = os.path.realpath(path)  # which, unlike resolve, takes links in a circle as they are
        if path.name.startswith(".") or hidden(path) or real == without or here.is_relative_to(real):
            continue
        if path.is_file():
            if video_at(path) is not None:
                yield path
        elif path.is_dir() and not is_result(path):
            if is_sequence(path) or _holds_one_video(path):
                yield path
            elif deep > 1:
                yield from _sequences(path, without, deep - 1)


def _holds_one_video(path: Path) -> bool:
    try:
        return video_at(path) is not None
    except InputError:  # several, each of which is one
        return False
