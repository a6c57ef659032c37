"""OpenEXR with scan lines, which OpenCV's wheels do not read: what depth is kept in.

Layout (OpenEXR file layout, version 2): attributes by name, the offset of each block of lines, then the blocks, each
with its first line and its length. A block's lines hold one channel after the other, in the order of their names. With
ZIP the bytes of a block are split into those at even and at odd places, and each is the difference to the one before.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.headers import what_is_there
from lightdepth.files.reading import MOST_PIXELS, check_bytes, reading

_MOST_BYTES, _MOST_CHANNELS = 1 << 30, 64
_MAGIC = struct.pack("<i", 20000630)
_LINES = {0: 1, 2: 1, 3: 16}  # in a block, by compression: none, ZIPS, ZIP
_COMPRESSIONS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
_TYPES = (np.dtype("<u4"), np.dtype("<f2"), np.dtype("<f4"))
_OTHER_LAYOUTS = 0x200 | 0x800 | 0x1000  # tiles, deep data, several parts
_CURE = "store it as scan lines with ZIP or no compression, or as .npy"


def write_exr(path: Path, values: np.ndarray, channel: str = "Z") -> None:
    """(H, W) as one float32 channel, without compression."""
    height, width = values.shape
    lines = np.ascontiguousarray(values, "<f4")

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    float32, sampling = 2, (1, 1)
    channels = channel.encode() + b"\0" + struct.pack("<iB3x2i", float32, 0, *sampling) + b"\0"
    header = _MAGIC + struct.pack("<i", 2)
    header += attribute("channels", "chlist", channels)
    header += attribute("compression", "compression", b"\0")
    header += attribute("dataWindow", "box2i", window) + attribute("displayWindow", "box2i", window)
    header += attribute("lineOrder", "lineOrder", b"\0")
    header += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    size = 8 + 4 * width
    first = len(header) + 8 * height
    offsets = struct.pack(f"<{height}Q", *(first + size * row for row in range(height)))
    body = b"".join(struct.pack("<2i", row, 4 * width) + lines[row].tobytes() for row in range(height))
    path.write_bytes(header + offsets + body)


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """The channels (H, W) by name. Raises InputError for what is none, is broken, or is stored in another way."""
    if not path.is_file():  # a named pipe would wait for ever
        raise InputError(path, what_is_there(path), "expected an EXR file")
    with reading(path, "an EXR file"):
        check_bytes(path.stat().st_size, _MOST_BYTES, path)
        data = path.read_bytes()
    if data[:4] != _MAGIC:
        raise InputError(path, "not an EXR file", "copy it again, or leave it out")
    try:
        head = _header(data, path)
        return _channels(data, head)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(path, f"a broken EXR file ({error})", "copy it again, or leave it out") from error
    except Exception as error:  # whatever its offsets and lengths lead to
        raise InputError(path, "a broken EXR file (cut off, or changed)", "copy it again, or leave it out") from error


@dataclass(frozen=True)
class _Head:
    """What the attributes say, and where the offsets of the blocks begin."""

    names: tuple[tuple[str, np.dtype], ...]
    width: int
    height: int
    top: int
    compression: int
    end: int


def _header(data: bytes, path: Path) -> _Head:
    (version,) = struct.unpack_from("<i", data, 4)
    if version & _OTHER_LAYOUTS:
        raise InputError(path, "an EXR file of tiles, deep data or several parts", _CURE)
    found, place = {}, 8
    while data[place]:
        name, place = _word(data, place)
        _, place = _word(data, place)
        (size,) = struct.unpack_from("<I", data, place)  # one below zero would lead back, without end
        found[name] = data[place + 4 : place + 4 + size]
        place += 4 + size
    compression = found["compression"][0]
    if compression not in _LINES:
        kind = _COMPRESSIONS[compression] if compression < len(_COMPRESSIONS) else compression
        raise InputError(path, f"an EXR file with {kind} compression", _CURE)
    left, top, right, bottom = struct.unpack("<4i", found["dataWindow"])
    names, at, listed = [], 0, found["channels"]
    while listed[at]:
        name, at = _word(listed, at)
        kind, _, across, down = struct.unpack_from("<iB3x2i", listed, at)
        if (across, down) != (1, 1):
            raise InputError(path, f"an EXR file whose channel {name} has fewer pixels than the image", _CURE)
        if not 0 <= kind < len(_TYPES):
            raise ValueError(f"numbers of the unknown type {kind}")
        names.append((name, _TYPES[kind]))
        at += 16
    width, height = right - left + 1, bottom - top + 1
    if not 0 < len(names) <= _MOST_CHANNELS or not (0 < width < 2**16 and 0 < height < 2**16):
        raise ValueError(f"{len(names)} channels of {width}x{height}")
    if width * height * len(names) > 4 * MOST_PIXELS:
        raise InputError(path, f"{len(names)} channels of {width}x{height}", f"expected up to {MOST_PIXELS} pixels")
    return _Head(tuple(names), width, height, top, compression, place + 1)


def _channels(data: bytes, head: _Head) -> dict[str, np.ndarray]:
    found = {name: np.zeros((head.height, head.width), kind) for name, kind in head.names}
    bytes_a_line = head.width * sum(kind.itemsize for _, kind in head.names)
    lines = _LINES[head.compression]
    for offset in struct.unpack_from(f"<{-(-head.height // lines)}Q", data, head.end):
        line, size = struct.unpack_from("<2i", data, offset)
        first = line - head.top
        count = min(lines, head.height - first)
        block = data[offset + 8 : offset + 8 + size]
        if head.compression and size < bytes_a_line * count:  # what does not shrink is stored as it is
            block = _unzipped(block, bytes_a_line * count)
        if first < 0 or len(block) != bytes_a_line * count:
            raise ValueError("cut off")
        place = 0
        for row in range(first, first + count):
            for name, kind in head.names:
                found[name][row] = np.frombuffer(block, kind, head.width, place)
                place += head.width * kind.itemsize
    return found


def _unzipped(block: bytes, size: int) -> bytes:
    decoder = zlib.decompressobj()
    steps = np.frombuffer(decoder.decompress(block, size), np.uint8).astype(np.int64)
    steps[1:] -= 128
    halves = np.cumsum(steps).astype(np.uint8)
    whole = np.empty_like(halves)
    whole[0::2], whole[1::2] = halves[: (len(halves) + 1) // 2], halves[(len(halves) + 1) // 2 :]
    return whole.tobytes()


def _word(data: bytes, place: int) -> tuple[str, int]:
    end = data.index(b"\0", place)
    return data[place:end].decode(), end + 1
