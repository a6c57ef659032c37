"""Small videos made on the spot: tissue that moves behind an endoscope's octagon, written by PyAV."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np

from lightdepth.camera import Pinhole
from lightdepth.tube import octagon

CAMERA = Pinhole(256, 208, 150.0, 150.0, 128.0, 104.0)
OCTAGON = octagon(CAMERA)
TIME_BASE = Fraction(1, 1000)


@cache
def _tissue(width: int, height: int) -> np.ndarray:
    """A wall of reddish texture, larger than an image, (height, width, 3) uint8."""
    rng = np.random.default_rng(3)
    wall = np.zeros((height, width), np.float32)
    for cells, strength in ((12, 45), (40, 30), (110, 22)):
        coarse = rng.normal(size=(cells * height // width + 2, cells)).astype(np.float32)
        wall += strength * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(wall[..., None] * (1.0, 0.8, 0.7) + (150, 95, 80), 20, 245).astype(np.uint8)


def picture(i: float, mask: np.ndarray | None = OCTAGON, size: tuple[int, int] = (256, 208)) -> np.ndarray:
    """Frame i (H, W, 3) uint8 RGB of a camera that moves 3 to 4 pixels a frame; black outside the mask."""
    width, height = size
    x, y = 250 + 240 * np.sin(i * 0.0137), 150 + 140 * np.sin(i * 0.021)
    shift = np.array([[1, 0, -x], [0, 1, -y]])
    image = cv2.warpAffine(_tissue(800, 600), shift, (width, height), borderMode=cv2.BORDER_WRAP)
    return image if mask is None else image * mask[..., None].astype(np.uint8)


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    times: Sequence[float],
    codec: str = "libx264",
    pixels: str = "yuv420p",
    tags: dict[str, str] | None = None,
    **options: str,
) -> Path:
    """RGB images (H, W, 3) uint8, or grey (H, W) uint16, at times [s] as a video; its type follows from the suffix."""
    muxing = {"movflags": "faststart"} if path.suffix in (".mp4", ".mov") else {}
    with av.open(str(path), "w", options=muxing) as container:
        container.metadata.update(tags or {})
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.options = pixels, {"g": "12", **options}
        stream.codec_context.time_base = stream.time_base = TIME_BASE
        for image, time in zip(images, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24" if image.ndim == 3 else "gray16le")
            frame.pts, frame.time_base = round(time / TIME_BASE), TIME_BASE
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def uneven_times(count: int, rate: float = 25.0, seed: int = 0) -> np.ndarray:
    """Times [s], whole milliseconds, of a variable frame rate; the first is 0."""
    steps = np.random.default_rng(seed).uniform(0.5, 1.7, count - 1) / rate
    return np.round(np.concatenate([[0], np.cumsum(steps)]), 3)
