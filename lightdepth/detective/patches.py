"""Patches of images around keypoints, and how alike they are.

Notation: `pixels` (n, 2) in the image's own pixels, first centre at (0.5, 0.5); `shapes` (n, 2, 2) take the patch's
grid to the image's pixels, so that a patch of a turned or nearer view shows the same wall. Two patches are compared by
their zero-mean normalised cross-correlation (NCC), 1 for the same pattern and 0 for none in common.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from lightdepth.datasets.sequence import FrameSequence
from lightdepth.errors import InputError

LONGER_SIDE = 640
"""Images are looked at no larger than so many pixels: more costs time and finds no more."""
HALF = 5
"""A patch has 2 HALF + 1 pixels a side: smaller ones are noise, larger ones hide a slip of a frame."""
_AROUND, _FLAT = 21, 1e-7  # pixels around a corner, and the response of a flat wall
_CONTRAST = 2.0  # a patch counts where it varies by so many times what noise does


@dataclass(frozen=True)
class Picture:
    """A grey image (H, W) float32, NaN where no tissue shows, the deviation of its noise, and its colours (H, W, 3)
    uint8; None where they were not asked for."""

    grey: np.ndarray
    noise: float
    colors: np.ndarray | None = None

    def color_at(self, pixels: np.ndarray) -> np.ndarray:
        """Colours (n, 3) in [0, 1] at pixels (n, 2); NaN outside, and where no tissue shows."""
        assert self.colors is not None
        places = pixels[:, None] - 0.5
        u, v = np.where(np.isfinite(places), places, -1e4).clip(-1e4, 1e5).astype(np.float32).transpose(2, 0, 1)
        seen = cv2.remap(self.colors, np.ascontiguousarray(u), np.ascontiguousarray(v), cv2.INTER_LINEAR)
        result: np.ndarray = np.where(np.isfinite(_at(self.grey, places)), seen[:, 0] / 255, np.nan)
        return result

    @cached_property
    def corners(self) -> np.ndarray:
        """(H, W): how much more of a corner each pixel is than the pixels around it, as a logarithm."""
        shown = np.where(np.isfinite(self.grey), self.grey, 0).astype(np.float32)
        response = cv2.cornerMinEigenVal(cv2.GaussianBlur(shown, (0, 0), 0.7), 3, ksize=3)
        around = cv2.blur(response, (_AROUND, _AROUND))
        sharper = np.log((response + _FLAT) / (around + _FLAT))
        return np.where(np.isfinite(self.grey), cv2.GaussianBlur(sharper, (0, 0), 1), np.nan).astype(np.float32)


@dataclass(frozen=True)
class Pictures:
    """Frames by number as small grey images, each read once; with their colours, where these are `colored`."""

    frames: FrameSequence
    colored: bool = False
    _kept: dict[int, Picture | None] = field(default_factory=dict)

    def of(self, number: int) -> Picture | None:
        """The picture, or None where there is no such frame or it cannot be read."""
        if number not in self._kept:
            self._kept[number] = self._read(number)
        return self._kept[number]

    def _read(self, number: int) -> Picture | None:
        try:
            frame = self.frames.by_number(number)
        except InputError:
            return None  # an unreadable image is reported where every frame is needed
        if frame is None:
            return None
        grey = cv2.cvtColor(np.ascontiguousarray(frame.image, np.float32), cv2.COLOR_RGB2GRAY)
        image = frame.image
        mask = np.ones_like(grey) if frame.mask is None else frame.mask.astype(np.float32)
        smaller = LONGER_SIDE / max(grey.shape)
        if smaller < 1:
            size = round(smaller * grey.shape[1]), round(smaller * grey.shape[0])
            grey, mask = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (grey, mask))
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if self.colored else image
        shown = (mask > 0.999) & np.isfinite(grey)
        colors = np.rint(255 * np.nan_to_num(image)).clip(0, 255).astype(np.uint8) if self.colored else None
        return Picture(np.where(shown, grey, np.nan).astype(np.float32), _noise(grey, shown), colors)


def _noise(grey: np.ndarray, shown: np.ndarray) -> float:
    """Deviation of the noise, from what is left when planes are taken out of 3x3 pixels (Immerkaer 1996); fine texture
    counts as noise, and a rounding to 8 bits is the least. The middle of the image stands for all."""
    height, width = grey.shape
    middle = slice(height // 4, height - height // 4), slice(width // 4, width - width // 4)
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    left = np.abs(cv2.filter2D(np.where(shown, grey, 0)[middle], -1, kernel))[shown[middle]][::5]
    return max(float(np.median(left)) / 0.6745 / 6 if len(left) else 0.0, 0.3 / 255)


def patches(picture: Picture, pixels: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """(n, (2 HALF + 1)²), NaN where a patch leaves what shows, or has no contrast above the noise."""
    steps = np.arange(-HALF, HALF + 1.0)
    grid = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    places = pixels[:, None] + grid @ shapes.transpose(0, 2, 1) - 0.5
    found = _at(picture.grey, places)
    flat = ~(found.std(1) > _CONTRAST * picture.noise)
    found[flat] = np.nan
    return found


def cornerness(picture: Picture, pixels: np.ndarray) -> np.ndarray:
    """`Picture.corners` (n,) at pixels (n, 2); NaN outside."""
    return _at(picture.corners, pixels[:, None] - 0.5)[:, 0]


def _at(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(n, k) float64: the image between its pixels, the first at (0, 0); NaN outside."""
    places = np.where(np.isfinite(places), places, -1e4).clip(-1e4, 1e5).astype(np.float32)
    u, v = np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
    outside = float("nan")
    seen = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
    return np.asarray(seen, np.float64)


def likeness(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """NCC (n,) of patches (n, k); NaN where either is."""
    one, other = (p - p.mean(1, keepdims=True) for p in (one, other))
    result: np.ndarray = (one * other).sum(1) / np.sqrt((one**2).sum(1) * (other**2).sum(1))
    return result
