"""What a keyframe folder of SCARED is kept in: numbered members of an archive or of a folder, beside the stereo video.

Archives are read where they are, a member at a time and by its name alone; going back in one starts from its beginning.
"""

from __future__ import annotations

import os
import re
import tarfile
from pathlib import Path

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
            raise InputError(self._path, f"two members have the number {int(match[1])}", "expected one for each frame")
        if member.size > _LARGEST:
            raise InputError(self._path, f"{member.name} has {member.size} bytes", f"expected at most {_LARGEST}")
        self._found[int(match[1])] = member
        return int(match[1])

    def _read(self, number: int) -> tuple[str, bytes]:
        assert self._tar is not None
        member = self._found[number]
        stream = self._tar.extractfile(member)
        assert stream is not None
        return f"{self._path}: {member.name}", stream.read()

    def _broken(self, error: Exception) -> InputError:
        return InputError(self._path, f"cannot be read ({error})", "copied incompletely, or not a .tar.gz?")


def numbered_members(folder: Path, name: str, pattern: str) -> Folder | Archive | None:
    """The extracted folder where there is one, else the archive."""
    if numbered_files(folder / name, pattern):
        return Folder(folder / name, pattern)
    archive = folder / f"{name}.tar.gz"
    return Archive(archive, pattern) if archive.is_file() else None
