"""Picture files of every make: one scene's 8-bit pixels, written in a format, a depth and with a tag."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageCms

ORIENTATIONS = {"orientation 3": 3, "orientation 6": 6, "orientation 8": 8}
_TIFF_KINDS = {"B": (1, 1), "H": (3, 2), "I": (4, 4)}


def exif(orientation: int) -> Image.Exif:
    tags = Image.Exif()
    tags[274] = orientation
    return tags


def png(pixels: np.ndarray, chunks: dict[bytes, bytes] | None = None) -> bytes:
    """A PNG of RGB or RGBA in 8 or 16 bits, with chunks after its first."""
    reverse = [2, 1, 0, 3][: pixels.shape[2]]
    data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., reverse]))[1].tobytes()
    made = b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in (chunks or {}).items()
    )
    return data[:33] + made + data[33:]


def tiff(pages: list[np.ndarray], orientation: int = 1, big: bool = False) -> bytes:
    """An uncompressed TIFF of RGB(A) pages in any type of number, written by hand: libraries turn what they write."""
    order = ">" if big else "<"
    out = bytearray((b"MM" if big else b"II") + struct.pack(order + "HI", 42, 0))
    link = 4
    for page in pages:
        height, width, channels = page.shape
        raw = page.astype(page.dtype.newbyteorder(order)).tobytes()
        at = len(out)
        out += raw + b"\0" * (len(raw) % 2)
        form = {"u": 1, "i": 2, "f": 3}[page.dtype.kind]
        bits_at = len(out)
        out += struct.pack(f"{order}{channels}H", *[page.dtype.itemsize * 8] * channels)
        form_at = len(out)
        out += struct.pack(f"{order}{channels}H", *[form] * channels)
        tags = [
            (256, "I", 1, width),
            (257, "I", 1, height),
            (258, "H", channels, bits_at),
            (259, "H", 1, 1),
            (262, "H", 1, 2),
            (273, "I", 1, at),
            (274, "H", 1, orientation),
            (277, "H", 1, channels),
            (278, "I", 1, height),
            (279, "I", 1, len(raw)),
            *([(338, "H", 1, 2)] if channels == 4 else []),
            (339, "H", channels, form_at),
        ]
        out[link : link + 4] = struct.pack(order + "I", len(out))
        out += struct.pack(order + "H", len(tags))
        for tag, kind, count, value in tags:
            code, size = _TIFF_KINDS[kind]
            inline = struct.pack(order + kind, value).ljust(4, b"\0") if count * size <= 4 else None
            out += struct.pack(order + "HHI", tag, code, count) + (inline or struct.pack(order + "I", value))
        link = len(out)
        out += struct.pack(order + "I", 0)
    return bytes(out)


def npy(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, pixels)
    return stream.getvalue()


def pillow(pixels: np.ndarray, kind: str, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, kind, **options)
    return stream.getvalue()


def ppm(pixels: np.ndarray, top: int) -> bytes:
    height, width = pixels.shape[:2]
    return f"P6\n{width} {height}\n{top}\n".encode() + pixels.astype(">u2" if top > 255 else np.uint8).tobytes()


# ---- depths: what the file's numbers are for 8-bit pixels; whether levels are lost or moved by it


def as_bits(bits: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda p: np.rint(p / 255.0 * (2**bits - 1)).astype(np.uint16)


DEPTHS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "8": lambda p: p,
    "8 in uint16": lambda p: p.astype(np.uint16),
    "10 in uint16": as_bits(10),
    "10 in uint16, dark": lambda p: np.minimum(as_bits(10)(p), 1000),
    "12 in uint16": as_bits(12),
    "14 in uint16": as_bits(14),
    "16": lambda p: p.astype(np.uint16) * 257,
    "8 in int16": lambda p: p.astype(np.int16),
    "10 in int16": lambda p: as_bits(10)(p).astype(np.int16),
    "12 in int32": lambda p: as_bits(12)(p).astype(np.int32),
    "float32": lambda p: p.astype(np.float32) / np.float32(255),
    "float64": lambda p: p / 255.0,
    "float32 to 255": lambda p: p.astype(np.float32),
    "float32 to 300": lambda p: p.astype(np.float32) * (300 / 255),
}
REDUCED = ("10", "12", "14")
REFUSED = {"10 in uint16, dark": "--bit-depth 10", "float32 to 300": "expected 0 to 1"}
UNSIGNED = ("8 in uint16", "10 in uint16", "10 in uint16, dark", "12 in uint16", "14 in uint16", "16")
OTHERS = ("8 in int16", "10 in int16", "12 in int32", "float32", "float64", "float32 to 255", "float32 to 300")

# ---- formats: endings, depths and tags that each can have

FORMATS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    ".png": (("8", *UNSIGNED), (*ORIENTATIONS, "alpha", "gamma", "ICC", "significant bits", "pages")),
    ".tif": (("8", *UNSIGNED, *OTHERS), (*ORIENTATIONS, "big-endian", "alpha", "pages")),
    ".npy": (("8", *UNSIGNED, *OTHERS), ("alpha",)),
    ".jp2": (("8", "16", "10 in uint16", "12 in uint16"), ()),
    ".webp": (("8",), (*ORIENTATIONS, "alpha", "ICC", "pages")),
    ".jpg": (("8",), (*ORIENTATIONS, "ICC")),
    ".bmp": (("8",), ()),
    ".gif": (("8",), ("pages",)),
    ".ppm": (("8", "16", "10 in uint16"), ()),
}
EVERYWHERE = ("none", "resource forks", "capitals")
LOSSLESS = [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000]
LOSSY = (".jpg", ".gif")


@dataclass(frozen=True)
class Combination:
    """A format, a depth and a tag."""

    ending: str
    depth: str
    tag: str

    @property
    def reduced(self) -> bool:
        return self.depth.startswith(REDUCED)

    @property
    def refused(self) -> str:
        """What the refusal says; nothing where the pictures are read."""
        if self.tag == "pages":
            return "2 pictures in one"
        if self.tag == "significant bits":
            return ""  # says what the values leave open
        return REFUSED.get(self.depth, "")

    def write(self, path: Path, pixels: np.ndarray) -> None:
        """The file with the format's ending at `path` (which has none)."""
        ending = self.ending.upper() if self.tag == "capitals" else self.ending
        path.with_suffix(ending).write_bytes(self.encoded(pixels))
        if self.tag == "resource forks":
            path.with_name(f"._{path.name}{ending}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")

    def encoded(self, pixels: np.ndarray) -> bytes:
        deep = DEPTHS[self.depth](pixels)
        if self.tag == "alpha":
            most = np.iinfo(deep.dtype).max if deep.dtype.kind in "ui" else 1
            deep = np.dstack([deep, np.full(deep.shape[:2], most // 2 or 1, deep.dtype)])
        turned = ORIENTATIONS.get(self.tag, 1)
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes() if self.tag == "ICC" else None
        if self.ending == ".png":
            if self.tag == "pages":
                return pillow(pixels, "PNG", save_all=True, append_images=[Image.fromarray(255 - pixels)])
            chunks = {
                "gamma": {b"gAMA": struct.pack(">I", 100000)},
                "ICC": {b"iCCP": b"sRGB\0\0" + zlib.compress(profile or b"")},
                "significant bits": {b"sBIT": bytes([_bits(self.depth)] * 3)},
            }.get(self.tag, {b"eXIf": exif(turned).tobytes().removeprefix(b"Exif\0\0")} if turned > 1 else {})
            return png(deep, chunks)
        if self.ending == ".tif":
            pages = [deep, deep] if self.tag == "pages" else [deep]
            return tiff(pages, turned, self.tag == "big-endian")
        if self.ending == ".npy":
            return npy(deep)
        if self.ending == ".jp2":
            if self.depth == "8":
                return pillow(pixels, "JPEG2000", irreversible=False)
            return cv2.imencode(".jp2", np.ascontiguousarray(deep[..., ::-1]), LOSSLESS)[1].tobytes()
        if self.ending == ".ppm":
            return ppm(deep, {"8": 255, "16": 65535}.get(self.depth, 1023))
        if self.ending == ".bmp":
            return pillow(pixels, "BMP")
        more = {"save_all": True, "append_images": [Image.fromarray(255 - pixels)]} if self.tag == "pages" else {}
        if turned > 1:
            more["exif"] = exif(turned)
        if profile:
            more["icc_profile"] = profile
        if self.ending == ".webp":
            return pillow(deep, "WEBP", lossless=True, exact=True, **more)
        return pillow(pixels, {".jpg": "JPEG", ".gif": "GIF"}[self.ending], **more)

    def plain(self, pixels: np.ndarray) -> np.ndarray:
        """The 8-bit pixels that the file shows: those given, but for formats that lose some."""
        if self.ending not in LOSSY:
            return pixels
        untagged = Combination(self.ending, "8", "none").encoded(pixels)
        return cv2.imdecode(np.frombuffer(untagged, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def _bits(depth: str) -> int:
    return int(depth.split()[0])


def all_combinations() -> list[Combination]:
    return [
        Combination(ending, depth, tag)
        for ending, (depths, tags) in FORMATS.items()
        for depth in depths
        for tag in (*EVERYWHERE, *tags)
        if not (tag == "pages" and depth != "8")
        if not (tag == "significant bits" and depth in ("8", "16", "10 in uint16, dark"))
    ]
