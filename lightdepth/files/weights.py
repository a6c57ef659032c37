"""Files of weights, read without executing anything and without making more of them than they hold.

A pickle may say that a tensor of one number has a thousand million elements (strides of 0), an archive that its few
bytes are many (compression), a header that it is a gigabyte long: each is refused before memory is given to it.
"""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lightdepth.errors import InputError

MAX_HEADER = 10_000_000
"""Bytes of the JSON that a safetensors file begins with; the largest that are known have a tenth of it."""
_MAX_OBJECTS = 1_000_000
_ARCHIVE = b"PK\3\4"


def read_pickled(path: Path, expected: str) -> Any:
    """What `torch.save` wrote: tensors and plain values. Raises InputError for anything else, `expected` its cure."""
    check_archive(path, expected)
    try:
        with _Bounded(path) as file:
            found = torch.load(file, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # a damaged or hostile pickle can raise anything; it is never executed
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(path, f"damaged, or holds more than weights and plain values ({first})", expected) from error
    allowed = 2 * path.stat().st_size  # tensors may share what is stored, as weights that are tied do
    for tensor in _tensors(found, path, expected):
        plain = tensor.layout == torch.strided and tensor.device.type == "cpu" and not tensor.is_quantized
        if not plain or tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise InputError(path, f"a tensor {tuple(tensor.shape)} of which it holds a part only", expected)
        allowed -= tensor.numel() * tensor.element_size()
        if allowed < 0:
            raise InputError(path, "tensors that are larger than the file", expected)
    return found


class _Bounded(io.BufferedReader):
    """A file of which no more is asked for than it has left: memory is given to what is asked for, and a pickle from
    before 2020 may ask for a name of a gigabyte."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.stat(path).st_size

    def read(self, size: int | None = -1) -> bytes:
        """At most `size` bytes, all that are left where it is negative."""
        if size is None or size < io.DEFAULT_BUFFER_SIZE:
            return super().read(size)
        return super().read(min(size, max(0, self._size - self.tell())))


def check_archive(path: Path, expected: str) -> None:
    """Raises InputError where the parts of torch's archive would be larger than the file: it stores them as they are.
    Files of before 2020 are no archives, and pass."""
    try:
        with path.open("rb") as file:
            begins_as_one = file.read(len(_ARCHIVE)) == _ARCHIVE
        if not begins_as_one and not zipfile.is_zipfile(path):
            return
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        raise InputError(path, f"damaged ({error})", expected) from error
    packed = any(part.compress_type != zipfile.ZIP_STORED for part in parts)
    if packed or sum(part.file_size for part in parts) > path.stat().st_size:
        raise InputError(path, "an archive that says it is larger unpacked than it is", expected)


def check_header(path: Path, expected: str) -> None:
    """Raises InputError where a safetensors file says that its header is longer than any is."""
    with path.open("rb") as file:
        start = file.read(8)
    length = struct.unpack("<Q", start)[0] if len(start) == 8 else 0
    if length > MAX_HEADER:
        raise InputError(path, f"damaged or not a safetensors file (a header of {length} bytes)", expected)


def _tensors(found: Any, path: Path, expected: str) -> Iterator[Tensor]:
    """All tensors, however deep; each container once, as a pickle may hold one in many places."""
    left, seen = [found], set[int]()
    while left:
        value = left.pop()
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, dict | list | tuple | set) and id(value) not in seen:
            seen.add(id(value))
            left += value.values() if isinstance(value, dict) else value
            if len(left) + len(seen) > _MAX_OBJECTS:
                raise InputError(path, f"more than {_MAX_OBJECTS} values", expected)
