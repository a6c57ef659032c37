"""MATLAB's .mat files of version 5 to 7: arrays of numbers, and structures of them, by name.

Read here, because SciPy's reader crashes on a spoilt file and makes room for whatever a file declares. Nothing is made
larger than the bytes that are there. Layout: "MAT-File Format", MathWorks, chapter 1: a header of 128 bytes, then
elements of a type, a length and data, which may be packed by zlib; a matrix has flags, dimensions, a name and its data.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.errors import InputError

_HEADER = 128
_MOST_UNPACKED = 64 << 20
_DEEPEST = 8
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CELL, _STRUCT, _NUMBERS = 1, 2, range(6, 16)
_OBJECTS = (3, 16, 17)
OBJECT = "a MATLAB object"
"""Stands for what MATLAB alone can read."""


def mat_variables(path: Path) -> dict[str, Any]:
    """Variables by name: numbers as arrays, a structure as a dict, an object as `OBJECT`, anything else as None.

    Raises whatever a broken file leads to; InputError for a version that is not read.
    """
    data = path.read_bytes()
    if len(data) < _HEADER or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("the header of MATLAB's version 5 is missing")
    order = "<" if data[126:128] == b"IM" else ">"
    (version,) = struct.unpack(order + "H", data[124:126])
    if version == 0x0200:
        raise NotImplementedError("version 7.3")
    found = {}
    for kind, content in _elements(data[_HEADER:], order):
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            unpacked = unpacker.decompress(content, _MOST_UNPACKED)
            if unpacker.unconsumed_tail:
                raise InputError(path, f"more than {_MOST_UNPACKED} bytes once unpacked", "save the camera alone")
            kind, content = next(_elements(unpacked, order))
        if kind == _MATRIX:
            name, value = _matrix(content, order, 0)
            found[name] = value
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Types and contents, one after the other."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "2I", data, at)
        if kind >> 16:  # a short one has its length and its data in the eight bytes
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
            if size > 4:
                raise ValueError(f"a short element of {size} bytes")
            at += 8
        else:
            start = at + 8
            at = start + size + (0 if kind == _COMPRESSED else -size % 8)
        if start + size > len(data):
            raise ValueError("cut off")
        yield kind, data[start : start + size]


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    if not data:
        return "", np.zeros(0)
    if depth > _DEEPEST:
        raise ValueError("structures in one another without end")
    parts = _elements(data, order)
    (flags,) = struct.unpack_from(order + "I", next(parts)[1])
    kind = flags & 0xFF
    if kind in _OBJECTS:
        return _text(next(parts)[1]), OBJECT
    shape = np.frombuffer(next(parts)[1], order + "i4").tolist()
    name = _text(next(parts)[1])
    if kind in _NUMBERS:
        stored, content = next(parts)
        values = np.frombuffer(content, order + _TYPES[stored])
        if len(values) != prod(shape) or min(shape, default=0) < 0:
            raise ValueError(f"{len(values)} numbers of {name[:40]!r}, {shape} declared")
        return name, values.astype(np.float64).reshape(shape, order="F")
    if kind == _STRUCT:
        (length,) = struct.unpack_from(order + "i", next(parts)[1])
        names = next(parts)[1]
        if length < 1 or len(names) % length:
            raise ValueError(f"names of {length} bytes in {len(names)}")
        fields = [_text(names[i : i + length]) for i in range(0, len(names), length)]
        values_of = [_matrix(content, order, depth + 1)[1] for _, content in parts]
        return name, dict(zip(fields, values_of, strict=False))  # the first of several structures
    if kind == _CELL:
        return name, [_matrix(content, order, depth + 1)[1] for _, content in parts]
    return name, None


def _text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("latin-1")
