"""Pictures on disk: bytes to pixels, pixels to floats, and the size of a picture without its pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from lightdepth.errors import InputError


def to_bgr8(image: np.ndarray) -> np.ndarray:
    """RGB float in [0, 1] -> BGR uint8 for cv2."""
    result: np.ndarray = cv2.cvtColor(np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2BGR)
    return result


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) float32 RGB in [0, 1]. 8- and 16-bit files alike."""
    data = decode(read_bytes(path, "image"), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR, str(path))
    return unit_range(cv2.cvtColor(data, cv2.COLOR_BGR2RGB, dst=data))


def unit_range(pixels: np.ndarray) -> np.ndarray:
    """uint8 or uint16 as float32 in [0, 1]."""
    result: np.ndarray = np.divide(pixels, np.float32(np.iinfo(pixels.dtype).max), dtype=np.float32)
    return result


def read_bytes(path: Path, what: str = "file") -> bytes:
    """The file's bytes, or InputError where it is not there or cannot be read."""
    if not path.is_file():
        raise InputError(path, f"no such {what}", "correct its name, or put it there")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            path, f"cannot be read ({error.strerror or error})", "expected a file that is there and may be read"
        ) from error


def decode(data: bytes, flags: int, where: str) -> np.ndarray:
    """cv2's image in a file's bytes. imdecode refuses a truncated JPEG, whose rest imread would paint grey."""
    if not data:
        raise InputError(where, "not a readable image (the file is empty, 0 bytes)", "copy it again, or leave it out")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise InputError(
            where, "not a readable image (truncated, or not an image at all)", "copy it again, or leave it out"
        )
    return image


def read_raw(path: Path) -> np.ndarray:
    """The file's own numbers, channels in the file's order (cv2's reversal undone)."""
    return decode_raw(read_bytes(path), str(path))


def decode_raw(data: bytes, where: str) -> np.ndarray:
    """`read_raw` of a file's bytes; `where` names them in errors."""
    image = decode(data, cv2.IMREAD_UNCHANGED, where)
    return image if image.ndim == 2 else image[..., ::-1]


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, from the file's header alone where it has a legible one."""
    try:
        with Image.open(path) as image:
            return image.size
    except OSError:
        height, width = read_image(path).shape[:2]
        return width, height
