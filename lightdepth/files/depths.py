"""Which value is white in pictures of more than 8 bits, decided once for a sequence.

Cameras of 10 or 12 bits often store their samples as they are in files of 16, of which they then fill a 64th: as dark
as a covered lens. Told apart, in this order, by: what the user says; what the file says (sBIT, a precision, packed
bits); a top value of 2^k - 1 that several pixels reach, as highlights do; any pixel too bright for 12 bits. Where none
of these is there, the files are refused, as a guess would make surfaces of noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.headers import Header, header_of
from lightdepth.files.images import own_white, read_pixels
from lightdepth.option_names import option

_LOOKED_AT = 8, 64
"""How many pictures are read: the first number, and more of them as long as all are dark."""
_BRIGHT = 4095
"""A value above it is taken for one of 16 bits."""
_PLATEAU = 4
"""Pixels at the top value from which it is where the sensor clips."""


def white_of(images: Sequence[Path], bit_depth: int | None = None) -> float | None:
    """The value of white in the pictures of a sequence that hold more than 8 bits: 2^bits - 1 of whole numbers, 1 of
    floats; None where all are of 8 bits. `bit_depth` is what the user says. Raises InputError where it cannot be told.
    """
    if bit_depth is not None and not 1 <= bit_depth <= 32:
        raise InputError(option("bit-depth"), f"{bit_depth}", "expected the bits of a sample, from 8 to 32")
    deep: dict[Path, Header] = {}
    for image in _spread(images, 256):
        with suppress(InputError, OSError):  # refused by name when it is read
            head = header_of(image)
            if head is not None and head.deep:
                deep[image] = head
    if not deep:
        return None
    if bit_depth is not None:
        return 2.0**bit_depth - 1
    stated = {head.stated for head in deep.values()}
    return _by_pixels(list(deep), stated.pop() if len(stated) == 1 else None)


def _by_pixels(images: Sequence[Path], stated: int | None) -> float | None:
    top, at_top, whole, dtype, looked = 0.0, 0, True, np.dtype(np.uint16), 0
    seen: set[Path] = set()
    for count in _LOOKED_AT:
        for image in sorted(set(_spread(images, count)) - seen):
            seen.add(image)
            try:
                pixels = read_pixels(image)
            except InputError:
                continue  # refused by name when it is asked for
            looked, dtype = looked + 1, pixels.dtype
            highest = float(pixels.max())
            whole &= bool(np.issubdtype(dtype, np.integer)) or bool((pixels == np.rint(pixels)).all())
            same = int((pixels == highest).sum())
            at_top = same if highest > top else at_top + same * (highest == top)
            top = max(top, highest)
        if top > _BRIGHT or len(images) <= count:
            break
    own = own_white(dtype)
    floats = not np.issubdtype(dtype, np.integer)
    where = f"{images[0]} and {looked - 1} more" if looked > 1 else str(images[0])
    if not looked or (top <= 1 and (floats or top == 0)):
        return own
    if stated is not None and top <= 2**stated - 1:
        return 2.0**stated - 1
    if top == own and not floats:
        return own
    bits = int(top).bit_length() if whole else 0
    if bits >= 7 and top == 2**bits - 1 and at_top >= _PLATEAU:
        warnings.warn(
            f"{where}: {dtype} pictures are read as {bits} bits: none of their values is above {top:.0f}, and "
            f"{at_top} are there; give {option('bit-depth')} if they have others",
            stacklevel=2,
        )
        return top
    if dtype == np.uint16 and top > _BRIGHT:
        if top < 2**14:
            warnings.warn(
                f"{where}: the highest value is {top:.0f} of 65535: if these are samples of 14 bits, give "
                f"{option('bit-depth')} 14",
                stacklevel=2,
            )
        return own
    least = max(8, bits)
    if whole:
        raise InputError(
            where,
            f"{dtype} pictures whose highest value is {top:.0f}: samples of {least} bits stored as they are, or "
            "pictures that are nearly black",
            f"give {option('bit-depth')} {least}, or {option('bit-depth')} {15 if own == 32767 else 16} if they are "
            "dark",
        )
    raise InputError(
        where,
        f"{dtype} pictures with values up to {top:g}",
        f"expected 0 to 1; give {option('bit-depth')} 8 if white is 255, 16 if it is 65535",
    )


def _spread(images: Sequence[Path], count: int) -> Sequence[Path]:
    rows = np.unique(np.linspace(0, len(images) - 1, min(count, len(images))).round().astype(int))
    return [images[i] for i in rows]
