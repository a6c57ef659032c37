"""What a keyframe folder of SCARED is kept in: numbered members of an archive or of a folder, beside the stereo video.

Archives are read where they are, a member at a time and by its name alone; going back in one starts from its beginning.
"""

from __future__ import annotations

import os
import re
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, Self

from lightdepth.datasets.sequence import numbered_files
from lightdepth.errors import InputError
from lightdepth.files.reading import check_bytes, reading

VIDEO = Path("data") / "rgb.mp4"
IMAGES = {"left": "Left_Image.png", "right": "Right_Image.png"}
_LARGEST = 128 << 20
"""Bytes of one member of an archive: a scene's points are 31 MB."""
_RECORD = 1 << 20
"""Bytes of one member that is read with all others: a frame's data are 2 KB."""
_ALL = 256 << 20
"""Bytes of an archive that is read whole, once unpacked: the frame data of an hour are as many."""
_MOST_MEMBERS = 200_000
_LONGEST_NAME = 1 << 16
"""Bytes of what a member's name and its other words are kept in: they are unpacked before the member is seen."""
_HEADER = "a member's header"
_NOT_NAMES = (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.DIRTYPE, tarfile.CONTTYPE, tarfile.SYMTYPE, tarfile.LNKTYPE)


class _Member(tarfile.TarInfo):
    """A member whose header is checked as soon as it is read."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        member = super().frombuf(buf, encoding, errors)
        if member.type not in (*_NOT_NAMES, tarfile.GNUTYPE_SPARSE) and member.size > _LONGEST_NAME:
            raise InputError(_HEADER, f"{member.size} bytes", f"expected at most {_LONGEST_NAME}")
        if member.size < 0:
            raise InputError(_HEADER, f"{member.size} bytes", "expected a size")
        return member


class Folder:
    """Numbered files of a folder."""

    cheap = True

    def __init__(self, folder: Path, pattern: str):
        self._files = numbered_files(folder, pattern)

    def get(self, number: int) -> tuple[str, bytes] | None:
        file = self._files.get(number)
        if file is None:
            return None
        check_bytes(file.stat().st_size, _LARGEST, file)
        return str(file), file.read_bytes()

    def all(self) -> list[tuple[int, str, bytes]]:
        for file in self._files.values():
            check_bytes(file.stat().st_size, _RECORD, file)
        return [(n, str(file), file.read_bytes()) for n, file in self._files.items()]


class Archive:
    """Numbered members of a .tar.gz. Nothing is unpacked to the disk; only the last part of a member's name counts."""

    cheap = False

    def __init__(self, path: Path, pattern: str):
        self._path, self._pattern = path, pattern
        self._found: dict[int, tarfile.TarInfo] = {}
        self._tar: tarfile.TarFile | None = None
        self._complete = False
        self._members = self._process = 0

    def get(self, number: int) -> tuple[str, bytes] | None:
        with self._guarded():
            self._open()
            while number not in self._found and not self._complete:
                self._next()
            return self._read(number) if number in self._found else None

    def all(self) -> list[tuple[int, str, bytes]]:
        """Every member in the archive's own order, which costs one pass."""
        members = []
        with self._guarded():
            self._open()
            while not self._complete:
                number = self._next()
                if self._tar is not None and self._tar.offset > _ALL:
                    raise InputError(self._path, f"more than {_ALL} bytes once unpacked", f"expected at most {_ALL}")
                if number is not None:
                    check_bytes(self._found[number].size, _RECORD, self._path, "member")
                    members.append((number, *self._read(number)))
        return members

    def _open(self) -> None:
        if self._process != os.getpid():  # a data loader's worker must not share the place in the file
            # Gzip or nothing: what unpacks LZMA takes as much memory as a file's first bytes ask for.
            with self._path.open("rb") as file:
                mode: Literal["r:gz", "r:"] = "r:gz" if file.read(2) == b"\x1f\x8b" else "r:"
            self._tar = tarfile.open(self._path, mode, tarinfo=_Member)  # noqa: SIM115 - the next frame goes on from here
            self._found, self._complete, self._members, self._process = {}, False, 0, os.getpid()

    def _next(self) -> int | None:
        """Steps to the next member; its number, if it is one of ours."""
        assert self._tar is not None
        member, self._members = self._tar.next(), self._members + 1
        if self._members > _MOST_MEMBERS:
            raise InputError(self._path, f"more than {_MOST_MEMBERS} members", "expected one for each frame")
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

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        with reading(self._path, "a readable archive", "copied incompletely, or not a .tar.gz?"):
            try:
                yield
            except InputError as error:
                if error.where != _HEADER:
                    raise
                raise error.within(self._path) from error


def numbered_members(folder: Path, name: str, pattern: str) -> Folder | Archive | None:
    """The extracted folder where there is one, else the archive."""
    if numbered_files(folder / name, pattern):
        return Folder(folder / name, pattern)
    archive = folder / f"{name}.tar.gz"
    return Archive(archive, pattern) if archive.is_file() else None
