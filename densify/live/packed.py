"""A keyframe's depth and image in a tenth of their memory, for surfaces that may have to be made again.

Distance is kept in 65534 steps of its logarithm between the least and the greatest valid value, to some 3e-5 where it
spans a factor of a hundred; uncertainty in 254, to 1 %; both deflated. The image is kept as JPEG. A 320x256 keyframe
takes some 120 kB instead of 1.6 MB, points included. What is fused is what is kept, rounding included: so it can be
taken out exactly.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import cv2
import numpy as np

from densify.fusion.second_core import later
from lightdepth.camera import CameraModel
from lightdepth.files.images import decode, unit_range
from lightdepth.prediction import DepthPrediction

_JPEG_QUALITY = 95
_STEPS, _FEW_STEPS = 65534, 254  # code 0 is invalid
_ZERO = np.uint16(128)  # stands for a residual of 0, so that a small one of either sign has the same high byte


@dataclass(frozen=True)
class PackedField:
    """Positive values (H, W) with their validity, as compressed codes."""

    shape: tuple[int, int]
    low: float
    high: float
    steps: int
    data: bytes

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Values float32, 1 where invalid, and validity, both (H, W)."""
        return _Codes(_read(self.data, self.shape), self.low, self.high, self.steps).values()


@dataclass(frozen=True)
class PackedView:
    """A prediction, without albedo and normals, and the image (H, W, 3) that it was made from."""

    name: str
    camera: CameraModel
    source: str
    unit: str
    distance: PackedField
    uncertainty: PackedField | None
    jpeg: bytes

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        fields = [self.distance, self.uncertainty]
        return len(self.jpeg) + sum(len(f.data) for f in fields if f is not None)

    def prediction(self) -> DepthPrediction:
        distance, valid = self.distance.values()
        sigma = None if self.uncertainty is None else self.uncertainty.values()[0]
        return DepthPrediction(self.name, distance, valid, self.camera, self.source, self.unit, uncertainty=sigma)

    def image(self) -> np.ndarray:
        """(H, W, 3) float32 in [0, 1]."""
        pixels = decode(self.jpeg, cv2.IMREAD_COLOR, self.name)
        return unit_range(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))


class Packing:
    """A keyframe being packed: what can wait is done on a second core, where there is one, while others go on.

    The image (H, W, 3), float32 in [0, 1], begins at once, then comes `round`, then `done`.
    """

    def __init__(self, image: np.ndarray):
        self._jpeg = later(_jpeg, image)

    def round(self, prediction: DepthPrediction) -> DepthPrediction:
        """The prediction as it will come back."""
        valid = prediction.valid & (prediction.distance > 0) & np.isfinite(prediction.distance)
        distance = _Codes.of(prediction.distance, valid, _STEPS)
        self._prediction, self._distance, self._uncertainty = prediction, later(distance.packed), None
        sigma = prediction.uncertainty
        if sigma is not None:
            uncertainty = _Codes.of(sigma, valid & (sigma > 0), _FEW_STEPS)
            self._uncertainty, sigma = later(uncertainty.packed), uncertainty.values()[0]
        rounded = distance.values()[0]
        return replace(prediction, distance=rounded, valid=valid, uncertainty=sigma, albedo=None, normals=None)

    def done(self) -> PackedView:
        """What is kept of the keyframe."""
        p = self._prediction
        uncertainty = None if self._uncertainty is None else self._uncertainty.result()
        return PackedView(p.name, p.camera, p.source, p.unit, self._distance.result(), uncertainty, self._jpeg.result())


def _jpeg(image: np.ndarray) -> bytes:
    pixels = cv2.cvtColor(cv2.convertScaleAbs(np.maximum(image, 0), alpha=255), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


@dataclass(frozen=True)
class _Codes:
    """A field in steps of its logarithm, codes (h, w) uint16 from 1 up; 0 is invalid."""

    codes: np.ndarray
    low: float
    high: float
    steps: int

    @classmethod
    def of(cls, values: np.ndarray, valid: np.ndarray, steps: int) -> _Codes:
        known = values[valid].astype(np.float32)
        low, high = (float(np.log(known.min())), float(np.log(known.max()))) if len(known) else (0.0, 0.0)
        log = np.log(np.where(valid, values, np.float32(np.exp(low)))).clip(low, high)
        codes = np.rint((log - low) * (steps / max(high - low, 1e-9))).astype(np.uint16) + np.uint16(1)
        codes[~valid] = 0
        return cls(codes, low, high, steps)

    def packed(self) -> PackedField:
        return PackedField(self.codes.shape, self.low, self.high, self.steps, _written(self.codes))

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Values float32, 1 where invalid, and validity, both (h, w)."""
        valid = self.codes > 0
        step = (self.high - self.low) / self.steps
        log = np.float32(self.low) + np.float32(step) * (self.codes - np.float32(1))
        return np.where(valid, np.exp(log), 1), valid


def _written(codes: np.ndarray) -> bytes:
    """Codes (h, w) uint16 as bytes: the residual of each to the plane through its left, upper and upper-left
    neighbours, deflated. The high bytes stand apart from the low ones: of a smooth field they are all alike."""
    down = np.diff(codes, axis=0, prepend=np.uint16(0))
    residual = np.diff(down, axis=1, prepend=np.uint16(0)) + _ZERO
    return zlib.compress(np.stack([residual >> 8, residual & 255]).astype(np.uint8).tobytes(), level=1)


def _read(data: bytes, shape: tuple[int, int]) -> np.ndarray:
    """The codes (h, w) that were `_written`."""
    high, low = np.frombuffer(zlib.decompress(data), np.uint8).reshape(2, *shape).astype(np.uint16)
    return ((high << 8 | low) - _ZERO).cumsum(1, dtype=np.uint16).cumsum(0, dtype=np.uint16)
