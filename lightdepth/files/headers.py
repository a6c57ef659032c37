"""What a picture's file says of itself before its pixels are decoded: size, bits, pages, orientation.

Orientation (EXIF, TIFF tag 274) is read in order to be left aside: cameras and masks are for the stored pixels, as
COLMAP and SLAMs take them. TIFF is parsed here, because cv2 turns its pixels whatever it is asked (OpenCV 5.0).
"""

from __future__ import annotations

import io
import struct
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image

from lightdepth.errors import InputError
from lightdepth.files.reading import MOST_PIXELS
from lightdepth.regular import irregular

_ORIENTATION, _WIDTH, _HEIGHT, _BITS, _SUBFILE, _SAMPLE_FORMAT = 274, 256, 257, 258, 254, 339
_EXTRA_SAMPLES = 338
_SIGNED, _FLOAT = 2, 3
_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MOST_PAGES = 1000
_NPY = b"\x93NUMPY"


@dataclass(frozen=True)
class Header:
    """What is known of a picture without its pixels."""

    kind: str
    """What the file is by its first bytes: PNG, JPEG, TIFF, NPY, and so on."""
    width: int
    """Columns, as they are stored."""
    height: int
    """Rows, as they are stored."""
    deep: bool = False
    """Whether its numbers are other than unsigned 8 bits."""
    stated: int | None = None
    """Bits of a sample that the file names beside those that it is stored in: a PNG's sBIT, a JPEG 2000's precision."""
    pages: int = 1
    """How many pictures of full size it holds."""
    orientation: int = 1
    """EXIF orientation; 1 is as stored."""


def header_of(path: Path) -> Header | None:
    """The header of a file that is there; None where it is of no kind that is known, or broken."""
    if not path.is_file():  # a named pipe would wait for ever
        raise InputError(path, what_is_there(path), "expected an image file")
    with path.open("rb") as stream:
        return _read(stream, str(path))


def header_in(data: bytes, where: str = "a picture") -> Header | None:
    """The header in a file's bytes; `where` names them in errors."""
    return _read(io.BytesIO(data), where)


def what_is_there(path: Path) -> str:
    """What stands at a path that is no file, for messages."""
    return f"{irregular(path)}, not a file" if path.exists() else "no such image"


def as_stored(data: bytes) -> bytes:
    """A TIFF's bytes without what makes cv2 change its pixels: an orientation, and an alpha to multiply colours by."""
    if data[:2] not in (b"II", b"MM"):
        return data
    places = [place for found, _ in _pages(io.BytesIO(data)) for place in found]
    changed = bytearray(data)
    order = "<" if data[:2] == b"II" else ">"
    for place in places:
        changed[place : place + 2] = struct.pack(order + "H", 1)  # as stored, and already multiplied
    return bytes(changed) if places else data


def _read(stream: BinaryIO, where: str) -> Header | None:
    start = stream.read(8)
    stream.seek(0)
    try:
        if start[:6] == _NPY:
            return _npy(stream)
        if start[:2] in (b"II", b"MM") and start[2:4] in (b"*\0", b"\0*", b"+\0", b"\0+"):
            return _tiff(stream)
        return _png(stream) if start == b"\x89PNG\r\n\x1a\n" else _others(stream)
    except Image.DecompressionBombError as error:
        raise InputError(where, "more than 178 million pixels", f"expected up to {MOST_PIXELS}") from error
    except Exception:  # whatever a broken header makes a parser stumble over: there is no legible one
        return None


def _others(stream: BinaryIO) -> Header:
    with warnings.catch_warnings(), Image.open(stream) as image:
        warnings.simplefilter("ignore")  # a picture of more than 90 million pixels is none of an endoscope's
        kind = image.format or ""
        many = kind in ("GIF", "WEBP", "AVIF") and getattr(image, "is_animated", False)
        pages = getattr(image, "n_frames", 1) if many else 1
        turned = 1
        with suppress(Exception):  # EXIF of any make, broken ones among them
            turned = int(image.getexif().get(_ORIENTATION, 1))
        stated = _precision(stream) if kind == "JPEG2000" else _of_maximum(stream) if kind == "PPM" else None
        deep = (stated or 8) > 8 or image.mode.startswith(("I", "F"))
        return Header(kind, *image.size, deep, stated if stated and 8 <= stated < 16 else None, pages, turned)


def _npy(stream: BinaryIO) -> Header:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    picture = len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3, 4))
    height, width = shape[:2] if picture else (0, 0)  # which is refused when it is read
    return Header("NPY", int(width), int(height), dtype not in (np.uint8, np.bool_))


def _tiff(stream: BinaryIO) -> Header:
    pages = [page for _, page in _pages(stream)]
    first = pages[0]
    full = [page for page in pages if not page.get(_SUBFILE, (0,))[0] & 1]  # bit 0: a reduced copy of another page
    bits, form = first.get(_BITS, (1,))[0], first.get(_SAMPLE_FORMAT, (1,))[0]
    return Header(
        "TIFF",
        first[_WIDTH][0],
        first[_HEIGHT][0],
        deep=bits > 8 or form in (_SIGNED, _FLOAT),
        stated=bits if 8 < bits < 16 else None,
        pages=max(1, len(full)),
        orientation=first.get(_ORIENTATION, (1,))[0],
    )


def _pages(stream: BinaryIO) -> list[tuple[list[int], dict[int, tuple[int, ...]]]]:
    """A TIFF's pages: where orientation and kind of alpha stand that are not 1, and its tags of whole numbers."""
    start = stream.read(16)
    order = "<" if start[:2] == b"II" else ">"
    big = struct.unpack(order + "H", start[2:4])[0] == 43
    count_code, entry_size, field = ("Q", 20, "Q") if big else ("H", 12, "I")
    at = struct.unpack(order + "Q", start[8:16])[0] if big else struct.unpack(order + "I", start[4:8])[0]
    found: list[tuple[list[int], dict[int, tuple[int, ...]]]] = []
    seen = set()
    while at and at not in seen and len(found) < _MOST_PAGES:
        seen.add(at)
        stream.seek(at)
        size = struct.calcsize(count_code)
        count = struct.unpack(order + count_code, stream.read(size))[0]
        entries = stream.read(count * entry_size)
        tags: dict[int, tuple[int, ...]] = {}
        places = []
        for i in range(count):
            entry = entries[i * entry_size : (i + 1) * entry_size]
            tag, kind = struct.unpack(order + "HH", entry[:4])
            number = struct.unpack(order + field, entry[4 : 4 + struct.calcsize(field)])[0]
            if kind not in _TYPES:
                continue
            held = entry[4 + struct.calcsize(field) :]
            width = struct.calcsize(_TYPES[kind])
            if number * width > len(held):
                if number > 64:  # strips and tiles, which are not asked for
                    continue
                stream.seek(struct.unpack(order + field, held)[0])
                held = stream.read(number * width)
            tags[tag] = struct.unpack(f"{order}{number}{_TYPES[kind]}", held[: number * width])
            if tag in (_ORIENTATION, _EXTRA_SAMPLES) and kind == 3 and tags[tag] != (1,) and number == 1:
                places.append(at + size + i * entry_size + 4 + struct.calcsize(field))
        found.append((places, tags))
        stream.seek(at + size + count * entry_size)
        at = struct.unpack(order + field, stream.read(struct.calcsize(field)))[0]
    return found


def _png(stream: BinaryIO) -> Header:
    """A PNG's chunks before its pixels: Pillow would decode these to find the orientation."""
    stream.seek(8)
    found: dict[bytes, bytes] = {}
    while len(head := stream.read(8)) == 8:
        length, name = struct.unpack(">I", head[:4])[0], head[4:]
        if name == b"IDAT":
            break
        if name in (b"IHDR", b"sBIT", b"acTL", b"eXIf"):
            found[name] = stream.read(length)
            stream.seek(4, io.SEEK_CUR)
        else:
            stream.seek(length + 4, io.SEEK_CUR)
    width, height, bits = struct.unpack(">IIB", found[b"IHDR"][:9])
    meant = max(found.get(b"sBIT", b"\0"))
    turned = 1
    if b"eXIf" in found:
        exif = Image.Exif()
        exif.load(found[b"eXIf"])
        turned = int(exif.get(_ORIENTATION, 1))
    return Header(
        "PNG",
        width,
        height,
        deep=bits > 8,
        stated=meant if 8 <= meant < bits else None,
        pages=struct.unpack(">I", found[b"acTL"][:4])[0] if b"acTL" in found else 1,
        orientation=turned,
    )


def _of_maximum(stream: BinaryIO) -> int:
    """Bits of the greatest value that a PGM or PPM names."""
    stream.seek(0)
    words = b" ".join(line.split(b"#")[0] for line in stream.read(1024).splitlines()).split()
    return int(words[3]).bit_length() if words[0] in (b"P2", b"P3", b"P5", b"P6") else 8


def _precision(stream: BinaryIO) -> int | None:
    """Bits of the first component of a JPEG 2000, from its SIZ marker."""
    stream.seek(0)
    data = stream.read(4096)
    at = data.find(b"\xff\x4f\xff\x51")
    return None if at < 0 else (data[at + 42] & 0x7F) + 1
