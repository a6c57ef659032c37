"""Pictures on disk: the one door through which every verb reads them, and the one that writes them.

Pixels are the stored ones: orientation tags are left aside, alpha is dropped, a file of several pictures is refused.
Which value is white follows from the numbers' type where that is 8 bits; what is deeper is decided for a whole sequence
by `files.depths.white_of`, and handed to `read_image`.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lightdepth.counting import with_article
from lightdepth.errors import InputError
from lightdepth.files.arrays import array_in
from lightdepth.files.headers import Header, as_stored, header_in, header_of, what_is_there
from lightdepth.files.machine import FAILS
from lightdepth.files.reading import check_bytes, check_pixels, reading
from lightdepth.option_names import option

PICTURE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".bmp", ".dib", ".tif", ".tiff", ".webp", ".jp2", ".j2k"),
    *(".gif", ".avif", ".ppm", ".pgm", ".pnm"),
)
ARRAY_SUFFIXES = (".npy",)
"""Arrays serve as pictures where there are no others: beside pictures they are predictions or truth."""
_MOST_BYTES = 1 << 30
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # of a torn file our own sentence is enough
_DECODE = cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR


def to_bgr8(image: np.ndarray) -> np.ndarray:
    """RGB float in [0, 1] -> BGR uint8 for cv2."""
    result: np.ndarray = cv2.cvtColor(np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2BGR)
    return result


def read_image(path: Path, white: float | None = None) -> np.ndarray:
    """(H, W, 3) float32 RGB in [0, 1]. `white` is the value that 1 stands for where the file holds more than 8 bits;
    left out, the largest that its numbers can be (1 of floats). Raises InputError where a pixel is beyond it."""
    pixels = read_pixels(path)
    if pixels.dtype == np.uint8:
        return unit_range(pixels)
    level = white or own_white(pixels.dtype)
    low, high = float(pixels.min()), float(pixels.max())
    if not (low >= 0 and high <= level * 1.001):  # NaN fails too
        raise InputError(
            path,
            f"{pixels.dtype} pixels from {low:g} to {high:g}, where black is 0 and white {level:g}",
            f"store the pictures in one way, or give {option('bit-depth')}",
        )
    result: np.ndarray = np.minimum(np.divide(pixels, level, dtype=np.float32), np.float32(1))
    return result


def read_pixels(path: Path) -> np.ndarray:
    """(H, W, 3) RGB in the file's own numbers; grey pictures have three equal channels."""
    data = read_bytes(path, "image")
    head = _single(data, str(path))
    if head is not None and head.kind == "NPY":
        return _colours(_array(data, str(path)), str(path))
    pixels = decode(data, _DECODE, str(path), head)
    if pixels.dtype in (np.uint8, np.uint16, np.float32):
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB, dst=pixels)
    return np.ascontiguousarray(pixels[..., ::-1])  # of which cvtColor knows nothing


def unit_range(pixels: np.ndarray) -> np.ndarray:
    """uint8 or uint16 as float32 in [0, 1]."""
    result: np.ndarray = np.divide(pixels, np.float32(own_white(pixels.dtype)), dtype=np.float32)
    return result


def own_white(dtype: np.dtype[Any]) -> float:
    """The largest value of whole numbers of a type; 1 of floats."""
    return float(np.iinfo(dtype).max) if np.issubdtype(dtype, np.integer) else 1.0


def read_bytes(path: Path, what: str = "file") -> bytes:
    """The file's bytes, or InputError where it is not there or cannot be read."""
    if not path.is_file():
        if path.exists():
            raise InputError(path, what_is_there(path), f"expected the {what} itself")
        raise InputError(path, f"no such {what}", "correct its name, or put it there")
    with reading(path, with_article(what)):
        check_bytes(path.stat().st_size, _MOST_BYTES, path, what)
        return path.read_bytes()


def read_raw(path: Path) -> np.ndarray:
    """The file's own numbers, channels in the file's order (cv2's reversal undone)."""
    return decode_raw(read_bytes(path), str(path))


def decode_raw(data: bytes, where: str) -> np.ndarray:
    """`read_raw` of a file's bytes; `where` names them in errors."""
    head = _single(data, where)
    if head is not None and head.kind == "NPY":
        return _array(data, where)
    image = decode(data, cv2.IMREAD_UNCHANGED, where, head)
    if image.ndim == 2:
        return image
    return image[..., [2, 1, 0, 3]] if image.shape[2] == 4 else image[..., ::-1]


def image_size(path: Path) -> tuple[int, int]:
    """Width and height as stored, from the file's header alone where it has a legible one."""
    head = header_of(path)
    if head is not None and head.width:
        check_pixels(head.width, head.height, path)
        return head.width, head.height
    height, width = read_pixels(path).shape[:2]
    return width, height


def write_image(path: Path, pixels: np.ndarray, quality: int | None = None) -> None:
    """A picture, (H, W) grey or (H, W, 3) BGR as cv2 has it, in the format of its ending; `quality` is a JPEG's, in
    percent. cv2.imwrite says nothing where the disk is full, and dies of names that are not UTF-8."""
    done, data = cv2.imencode(path.suffix, pixels, [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done, path
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        if error.errno in FAILS:
            error.filename = str(path)  # writing alone names none
            raise
        raise InputError(path, f"cannot be written ({error.strerror or error})", "choose another place") from error


def _single(data: bytes, where: str) -> Header | None:
    """The header of what is one picture."""
    if not data:
        raise InputError(where, "not a readable image (the file is empty, 0 bytes)", "copy it again, or leave it out")
    head = header_in(data, where)
    if head is not None and head.kind != "NPY":
        check_pixels(head.width, head.height, where)
    if head is not None and head.pages > 1:
        raise InputError(
            where,
            f"{head.pages} pictures in one {head.kind} file",
            "expected one: write each to a file of its own, or make a video of them",
        )
    return head


def decode(data: bytes, flags: int, where: str, head: Header | None = None) -> np.ndarray:
    """cv2's image in a file's bytes. imdecode refuses a truncated JPEG, whose rest imread would paint grey."""
    head = head or header_in(data, where)
    buffer, image = np.frombuffer(as_stored(data) if head is not None and head.kind == "TIFF" else data, np.uint8), None
    if head is None:  # its size is not known before it is decoded
        raise InputError(where, "not a readable image (no header that is known)", "copy it again, or leave it out")
    with suppress(cv2.error):  # of sizes and channels that it does not know
        image = cv2.imdecode(buffer, flags)
    if image is None and flags == _DECODE and head is not None and head.deep:
        with suppress(cv2.error):  # of floats with alpha it makes no three channels
            image = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
        image = np.ascontiguousarray(image[..., :3]) if image is not None and image.ndim == 3 else None
    if image is None:
        raise InputError(
            where, "not a readable image (truncated, or not an image at all)", "copy it again, or leave it out"
        )
    return image


def _array(data: bytes, where: str) -> np.ndarray:
    array = array_in(data, where, "a readable array", "expected one of numbers, (H, W, 3)")
    if array.ndim > 1:
        check_pixels(array.shape[1], array.shape[0], where)
    return array


def _colours(array: np.ndarray, where: str) -> np.ndarray:
    """(H, W, 3) of an array of grey or RGB, with or without alpha."""
    known = np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if not known or 0 in array.shape or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (3, 4))):
        raise InputError(
            where,
            f"{array.dtype} of shape {'x'.join(map(str, array.shape)) or '()'}",
            "expected a picture: numbers of height x width x 3 (RGB), or height x width",
        )
    colours = np.repeat(array[..., None], 3, 2) if array.ndim == 2 else array[..., :3]
    return np.ascontiguousarray(colours, colours.dtype.newbyteorder("="))
