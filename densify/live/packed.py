"""A keyframe's depth and image in a tenth of their memory, for surfaces that may have to be made again.

Distance is kept in 65534 steps of its logarithm between the least and the greatest valid value, to some 3e-5 where it
spans a factor of a hundred; uncertainty in 254, to 1 %; both in a Golomb code. The image is kept as JPEG. A 320x256
keyframe takes some 140 kB instead of 1.6 MB, points included. What is fused is what is kept, rounding included: so it
can be taken out exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from densify.fusion.compiled import compiled
from densify.fusion.second_core import later
from lightdepth.camera import CameraModel
from lightdepth.files.images import decode, unit_range
from lightdepth.prediction import DepthPrediction

_JPEG_QUALITY = 95
_STEPS, _FEW_STEPS = 65534, 254  # code 0 is invalid
_ONES = 24  # at most, before a number is written in full


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
        codes = _read(np.frombuffer(self.data, np.uint8), *self.shape)
        return _Codes(codes, self.low, self.high, self.steps).values()


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
        return PackedField(self.codes.shape, self.low, self.high, self.steps, _written(self.codes).tobytes())

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Values float32, 1 where invalid, and validity, both (h, w)."""
        valid = self.codes > 0
        step = (self.high - self.low) / self.steps
        log = np.float32(self.low) + np.float32(step) * (self.codes - np.float32(1))
        return np.where(valid, np.exp(log), 1), valid


@compiled
def _written(codes):
    """Codes (h, w) uint16 as bytes: how far each is from where its three neighbours before it would have it, in the
    Golomb code that suits the last of them (Rice; adapted as in JPEG-LS), or in full where that is longer."""
    out = np.empty(5 * codes.size + 8, np.uint8)
    buffer, bits, at = np.uint64(0), 0, 0
    total, count = 64, 4
    for row in range(codes.shape[0]):
        for column in range(codes.shape[1]):
            off = np.int64(np.int16(np.int64(codes[row, column]) - _guess(codes, row, column)))
            number = off << 1 ^ off >> 63
            k = _parameter(total, count)
            ones = number >> k
            if ones < _ONES:
                length, word = ones + 1 + k, ((1 << ones) - 1) << k + 1 | number & (1 << k) - 1
            else:
                length, word = _ONES + 16, ((1 << _ONES) - 1) << 16 | number
            buffer, bits = buffer << np.uint64(length) | np.uint64(word), bits + length
            while bits >= 8:
                bits -= 8
                out[at] = buffer >> np.uint64(bits) & np.uint64(255)
                at += 1
            total, count = _adapted(total, count, number)
    out[at] = buffer << np.uint64(8 - bits) & np.uint64(255)
    return out[: at + 1].copy()


@compiled
def _read(data, height, width):
    """The codes (height, width) that were `_written`."""
    codes = np.empty((height, width), np.uint16)
    at = 0  # bit
    total, count = 64, 4
    for row in range(height):
        for column in range(width):
            k = _parameter(total, count)
            ones = 0
            while ones < _ONES and data[at >> 3] >> (7 - (at & 7)) & 1:
                ones += 1
                at += 1
            if ones < _ONES:
                at += 1
                number, length = ones, k
            else:
                number, length = 0, 16
            for _ in range(length):
                number = number << 1 | data[at >> 3] >> (7 - (at & 7)) & 1
                at += 1
            total, count = _adapted(total, count, number)
            off = number >> 1 ^ -(number & 1)
            codes[row, column] = np.uint16(_guess(codes, row, column) + off & 65535)
    return codes


@compiled
def _guess(codes, row, column):
    """A plane through the three neighbours before a code; 0 beyond the image."""
    left = np.int64(codes[row, column - 1]) if column > 0 else 0
    up = np.int64(codes[row - 1, column]) if row > 0 else 0
    return left + up - np.int64(codes[row - 1, column - 1]) if row > 0 and column > 0 else left + up


@compiled
def _parameter(total, count):
    """Low bits to write as they are, for numbers whose mean is total / count."""
    k = 0
    while count << k < total:
        k += 1
    return k


@compiled
def _adapted(total, count, number):
    """The sum and number of what was written, the older the less."""
    total, count = total + number, count + 1
    return (total >> 1, count >> 1) if count == 32 else (total, count)
