"""NumPy's .npy and .npz: what an array's header declares is checked before a byte of it is read.

A .npz is a zip. Encrypted members, methods other than NumPy's own two, and members that would unpack to more than a
frame's numbers are refused by the zip's directory.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.reading import reading
from lightdepth.regular import regular

MOST_BYTES = 1 << 29
"""Bytes of one array, and of all of a file together: a picture of 8K has 265 MB as float64."""
_MOST_MEMBERS = 1000
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_MAGIC = b"\x93NUMPY"
_MOST_RATIO = 1100
"""Bytes that one byte of a deflated member unpacks to at the most, by the method itself (1032)."""


def array_in(
    data: bytes,
    where: str | Path,
    what: str = "an array",
    cure: str = "expected numbers as numpy.save writes them",
) -> np.ndarray:
    """The array in the bytes of a .npy. Raises InputError where it is none, or declares more than it holds."""
    with reading(where, what, cure):
        return _array(io.BytesIO(data), len(data), where)


def read_arrays(
    path: Path, what: str = "arrays", cure: str = "expected an .npz as numpy.savez writes it"
) -> dict[str, np.ndarray]:
    """The arrays of a .npz by name. Raises InputError before anything is unpacked where that would be too much."""
    regular(path)
    with reading(path, what, cure), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > _MOST_MEMBERS:
            raise InputError(path, f"{len(members)} arrays", f"expected {_MOST_MEMBERS} at most")
        total = 0
        for member in members:
            total += member.file_size
            where = f"{path}: {member.filename[:80]!r}"
            if member.flag_bits & 0x1:
                raise InputError(where, "encrypted", cure)
            if member.compress_type not in _METHODS:
                raise InputError(where, f"compressed by the method {member.compress_type}", cure)
            if total > MOST_BYTES or member.file_size > _MOST_RATIO * member.compress_size + 1000:
                raise InputError(where, f"{member.file_size} bytes once unpacked", f"expected {MOST_BYTES} at most")
        found = {}
        for member in members:
            with archive.open(member) as stream:
                inside: Any = stream
                name = member.filename.removesuffix(".npy")
                found[name] = _array(inside, member.file_size, f"{path}: {name}")
        return found


def _array(stream: BinaryIO, size: int, where: str | Path) -> np.ndarray:
    """One array; `size` bytes are there at the most."""
    start = stream.read(len(_MAGIC) + 2)
    if start[: len(_MAGIC)] != _MAGIC:
        raise ValueError("NumPy's mark is missing")
    version = (start[-2], start[-1])
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"version {version[0]}.{version[1]} of the format")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, by_columns, dtype = read(stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not loaded")
    count = 1
    for side in shape:
        if side < 0:
            raise ValueError(f"a side of {side}")
        count *= side
    if count * dtype.itemsize > MOST_BYTES:
        sides = "x".join(str(side)[:20] for side in shape)
        raise InputError(where, f"an array of {sides} {dtype}", f"expected one of at most {MOST_BYTES} bytes")
    if count * dtype.itemsize > size:
        raise ValueError(f"cut off: {count * dtype.itemsize} bytes declared, {size} there")
    data = stream.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise ValueError("cut off")
    if not dtype.itemsize:
        return np.zeros(shape, dtype)
    array = np.frombuffer(bytearray(data), dtype, count)
    return array.reshape(shape[::-1]).transpose() if by_columns else array.reshape(shape)
