"""Where a DICOM file keeps its pictures: one after the other, or in items, of which one or more make a frame.

Pixel data in items (PS3.5, annex A.4): an item with a table of offsets, which may be empty, then the pictures' bytes.
Only positions are read here. What the file announces and does not hold is told by the count.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from lightdepth.errors import InputError

Part = tuple[int, int]
"""Position in the file and length, bytes."""
_ITEM, _END = 0xE000FFFE, 0xE0DDFFFE  # (FFFE,E000) and (FFFE,E0DD), as they read in little-endian
_UNDEFINED = 0xFFFFFFFF
_MOST_ITEMS = 10**7
_STARTS = (b"\xff\xd8", b"\xff\x4f\xff\x51")  # of a JPEG and of a JPEG 2000 picture
_IN_BOXES = b"\0\0\0\x0cjP  "  # how a JPEG 2000 file begins, which some programs put where its codestream belongs


@dataclass(frozen=True)
class Window:
    """Parts of a file, as a stream: opened by calling it, in any process. Nothing is copied to another place."""

    path: Path
    parts: tuple[Part, ...]

    def __call__(self) -> BinaryIO:
        return io.BufferedReader(_Stream(self.path, self.parts), 1 << 16)

    def read(self) -> bytes:
        """All of it."""
        with self() as stream:
            return stream.read()


class _Stream(io.RawIOBase):
    def __init__(self, path: Path, parts: tuple[Part, ...]):
        self._file, self._parts, self._at = path.open("rb"), parts, 0
        self._size = sum(length for _, length in parts)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = max(0, offset + (0, self._at, self._size)[whence])
        return self._at

    def readinto(self, buffer: Any) -> int:
        before = 0
        for position, length in self._parts:
            if self._at < before + length:
                skipped = self._at - before
                self._file.seek(position + skipped)
                data = self._file.read(min(len(buffer), length - skipped))
                buffer[: len(data)] = data
                self._at += len(data)
                return len(data)
            before += length
        return 0

    def close(self) -> None:
        self._file.close()
        super().close()


def pixel_element(stream: BinaryIO, implicit: bool, path: Path) -> tuple[int, int | None]:
    """Position and length (None: in items) of the pixel data whose element begins where the stream is."""
    head = stream.read(8)
    if len(head) < 8 or struct.unpack("<HH", head[:4]) != (0x7FE0, 0x0010):
        raise InputError(path, "a DICOM file without pictures", "expected one with pixel data")
    length = struct.unpack("<I", head[4:] if implicit else stream.read(4).ljust(4, b"\0"))[0]
    return stream.tell(), None if length == _UNDEFINED else length


def native_frames(start: int, length: int, size: int, frame_bytes: int, announced: int) -> list[tuple[Part, ...]]:
    """The frames that lie one after the other in a file of `size` bytes, as far as they are there."""
    there = min(length, size - start) // frame_bytes
    return [((start + i * frame_bytes, frame_bytes),) for i in range(min(there, announced))]


def items_of(stream: BinaryIO, start: int, size: int, path: Path) -> tuple[list[int], list[Part]]:
    """The table of offsets, counted from the first item after it, and the items that are whole."""
    stream.seek(start)
    offsets: list[int] | None = None
    items: list[Part] = []
    while True:
        head = stream.read(8)
        if len(head) < 8:
            break  # cut off
        tag, length = struct.unpack("<II", head)
        at = stream.tell()
        if tag != _ITEM or length > size - at:
            if tag not in (_ITEM, _END):
                raise InputError(path, "pixel data whose items are broken", "copy it again, or export it anew")
            break
        if offsets is None:
            offsets = list(struct.unpack(f"<{length // 4}I", stream.read(length // 4 * 4)))
        else:
            items.append((at, length))
        stream.seek(at + length)
        if len(items) > _MOST_ITEMS:
            raise InputError(path, f"pixel data in more than {_MOST_ITEMS} items", "expected one for a frame")
    return offsets or [], items


def frames_in_items(stream: BinaryIO, offsets: list[int], items: list[Part], announced: int) -> list[tuple[Part, ...]]:
    """Which items make which frame: one each where their numbers agree; else by the table, else by what they begin
    with."""
    if announced == 1:
        return [tuple(items)] if items else []
    if len(items) <= announced or not items:
        return [(item,) for item in items]
    first = items[0][0] - 8
    if len(offsets) == announced and offsets[0] == 0 and sorted(set(offsets)) == offsets:
        starts = {first + offset for offset in offsets}
        begins = [at - 8 in starts for at, _ in items]
    else:
        begins = [_begins(stream, item) for item in items]
    frames: list[list[Part]] = []
    for item, new in zip(items, begins, strict=True):
        if new or not frames:
            frames.append([])
        frames[-1].append(item)
    return [tuple(parts) for parts in frames[:announced]]


def out_of_boxes(picture: bytes, where: str) -> bytes:
    """A frame's bytes, without the boxes of a JPEG 2000 file around its codestream (ISO 15444-1, annex I)."""
    at = 0 if picture.startswith(_IN_BOXES) else len(picture)
    while at + 16 <= len(picture):
        length, kind = struct.unpack(">I4s", picture[at : at + 8])
        head = 8
        if length == 1:
            head, length = 16, struct.unpack(">Q", picture[at + 8 : at + 16])[0]
        if kind == b"jp2c":
            return picture[at + head :]
        if length < head:  # 0 is a last box, to the end
            break
        at += length
    if picture.startswith(_IN_BOXES):
        raise InputError(where, "a JPEG 2000 picture whose boxes are broken", "copy it again, or export it anew")
    return picture


def _begins(stream: BinaryIO, item: Part) -> bool:
    stream.seek(item[0])
    return stream.read(4).startswith(_STARTS)
