"""Frames spoilt in six ways at five severities, each by a seed: what networks and gates are tried on.

Blur, drops and compression work on codes; smoke, clipping and noise on linear light, by the frame's gamma. Lengths are
shares of the image's height. Outside the mask a frame stays as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, get_args

import cv2
import numpy as np

from lightdepth.files.images import decode, to_bgr8
from lightdepth.frame import Frame

Corruption = Literal["blur", "smoke", "water drops", "clipping", "noise", "compression"]
CORRUPTIONS: tuple[Corruption, ...] = get_args(Corruption)
SEVERITIES = (1, 2, 3, 4, 5)

_BLUR = (0.006, 0.012, 0.02, 0.032, 0.05)  # deviation; half of them smeared along a line as by motion
_SMOKE = (0.06, 0.14, 0.26, 0.42, 0.6)  # share of light that the smoke swallows, and gives back as its own
_DROPS = (0.03, 0.07, 0.13, 0.2, 0.3)  # share of the wall's image that lies under drops
_GAIN = (1.3, 1.7, 2.4, 3.6, 6.0)
_NOISE = (0.01, 0.022, 0.045, 0.08, 0.14)  # deviation of linear light at a quarter of white
_QUALITY = (60, 35, 20, 12, 6)


def corrupted(frame: Frame, corruption: Corruption, severity: int, rng: np.random.Generator) -> Frame:
    """The frame spoilt; its truth stays. Severity 1 to 5."""
    assert severity in SEVERITIES, severity
    spoilt = _WAYS[corruption](frame, severity - 1, rng)
    spoilt = np.clip(spoilt, 0, 1).astype(np.float32)
    if frame.mask is not None:
        spoilt = np.where(frame.mask[..., None], spoilt, frame.image)
    return replace(frame, image=spoilt)


def _blur(frame: Frame, level: int, rng: np.random.Generator) -> np.ndarray:
    size = _BLUR[level] * frame.camera.height
    if rng.random() < 0.5:
        return cv2.GaussianBlur(frame.image, (0, 0), size)
    reach, angle = max(2, round(3.5 * size)), rng.uniform(0, np.pi)  # a line has the deviation of its length / sqrt(12)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    end = 0.5 * 3.46 * size * np.array([np.cos(angle), np.sin(angle)])
    start, stop = (tuple(map(int, np.round(16 * (reach + s * end)))) for s in (-1, 1))
    cv2.line(kernel, start, stop, 1.0, 1, cv2.LINE_AA, 4)
    kernel[reach, reach] = max(float(kernel[reach, reach]), 0.5)
    return cv2.filter2D(frame.image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _smoke(frame: Frame, level: int, rng: np.random.Generator) -> np.ndarray:
    """Wafts of a grey that is as bright as the frame's bright parts."""
    height, width = frame.image.shape[:2]
    wafts = sum(
        (_cloud(rng, height, width, cells) / weight for cells, weight in ((2, 1.0), (4, 2.0), (8, 4.0))),
        np.zeros((height, width)),
    )
    share = np.clip(_SMOKE[level] * (1 + 0.6 * wafts), 0, 0.95)[..., None]
    linear = frame.image**frame.light.gamma
    grey = 0.8 * np.quantile(linear[frame.valid].max(-1), 0.8)
    return np.asarray(((1 - share) * linear + share * grey) ** (1 / frame.light.gamma))


def _drops(frame: Frame, level: int, rng: np.random.Generator) -> np.ndarray:
    """Drops on the lens: each shows what is beside it, smaller and blurred, with a dark rim and a glint."""
    height, width = frame.image.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)
    blurred = cv2.GaussianBlur(frame.image, (0, 0), 0.02 * height)
    spoilt, covered = frame.image.copy(), np.zeros((height, width), bool)
    while covered[frame.valid].mean() < _DROPS[level]:
        x, y, size = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.04, 0.2) * height
        stretch = rng.uniform(0.8, 1.25)
        off = np.hypot((u - x) * stretch, (v - y) / stretch) / size
        inside = off < 1
        bend = (1 + 0.9 * np.clip(off, 0, 1) ** 2).astype(np.float32)
        seen = cv2.remap(
            blurred, x + (u - x) * bend, y + (v - y) * bend, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        shade = 1 - 0.35 * np.clip((off - 0.75) / 0.25, 0, 1) + 0.5 * np.exp(-(((off - 0.45) / 0.12) ** 2)) * (u < x)
        edge = np.clip((1 - off) / 0.15, 0, 1)[..., None]
        spoilt = np.where(inside[..., None], edge * seen * shade[..., None] + (1 - edge) * spoilt, spoilt)
        covered |= inside
    return spoilt


def _clipping(frame: Frame, level: int, rng: np.random.Generator) -> np.ndarray:
    gain = _GAIN[level] * rng.uniform(0.9, 1.1)
    return np.asarray(frame.image * gain ** (1 / frame.light.gamma))


def _noise(frame: Frame, level: int, rng: np.random.Generator) -> np.ndarray:
    linear = frame.image**frame.light.gamma
    deviation = _NOISE[level] * np.sqrt(linear / 0.25 + 0.05)
    noisy = np.clip(linear + deviation * rng.normal(size=linear.shape), 0, 1)
    return np.asarray(noisy ** (1 / frame.light.gamma))


def _compression(frame: Frame, level: int, rng: np.random.Generator) -> np.ndarray:
    done, data = cv2.imencode(".jpg", to_bgr8(frame.image), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY[level]])
    assert done
    return np.asarray(decode(data.tobytes(), cv2.IMREAD_COLOR, frame.name)[..., ::-1] / 255)


def _cloud(rng: np.random.Generator, height: int, width: int, cells: int) -> np.ndarray:
    noise = rng.uniform(-1, 1, (cells + 2, round(cells * width / height) + 2))
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


_WAYS: dict[Corruption, Callable[[Frame, int, np.random.Generator], np.ndarray]] = {
    "blur": _blur,
    "smoke": _smoke,
    "water drops": _drops,
    "clipping": _clipping,
    "noise": _noise,
    "compression": _compression,
}
