"""A keyframe's depth and image in a tenth of their memory, for surfaces that may have to be made again.

Distance is kept in 65534 steps of its logarithm between the least and the greatest valid value, to some 3e-5 where it
spans a factor of a hundred; uncertainty in 254, to 1 %. The image is kept as JPEG. A 320x256 keyframe takes some 140 kB
instead of 1.6 MB, points included. What is fused is what is kept, rounding included: so it can be taken out exactly.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import cv2
import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.datasets.sequence import decode, unit_range
from lightdepth.prediction import DepthPrediction

_JPEG_QUALITY = 95
_STEPS, _FEW_STEPS = 65534, 254  # code 0 is invalid


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
        change = np.frombuffer(zlib.decompress(self.data), np.uint16).reshape(self.shape)
        codes = np.cumsum(np.cumsum(change, axis=1, dtype=np.uint16), axis=0, dtype=np.uint16)
        return _decoded(codes, self.low, self.high, self.steps)


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


def packed_view(prediction: DepthPrediction, image: np.ndarray) -> tuple[PackedView, DepthPrediction]:
    """What is kept of a keyframe, and its prediction as it will come back. image (H, W, 3) float32 in [0, 1]."""
    valid = prediction.valid & (prediction.distance > 0) & np.isfinite(prediction.distance)
    distance, (rounded, valid) = _packed(prediction.distance, valid, _STEPS)
    sigma = uncertainty = None
    if prediction.uncertainty is not None:
        uncertainty, (sigma, _) = _packed(prediction.uncertainty, valid & (prediction.uncertainty > 0), _FEW_STEPS)
    pixels = np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[
        1
    ].tobytes()
    p = prediction
    view = PackedView(p.name, p.camera, p.source, p.unit, distance, uncertainty, jpeg)
    back = replace(p, distance=rounded, valid=valid, uncertainty=sigma, albedo=None, normals=None)
    return view, back


def _packed(values: np.ndarray, valid: np.ndarray, steps: int) -> tuple[PackedField, tuple[np.ndarray, np.ndarray]]:
    """The values as they are kept, and as they come back."""
    known = values[valid].astype(np.float32)
    low, high = (float(np.log(known.min())), float(np.log(known.max()))) if len(known) else (0.0, 0.0)
    log = np.log(np.where(valid, values, np.float32(np.exp(low)))).clip(low, high)
    codes = np.rint((log - low) * (steps / max(high - low, 1e-9))).astype(np.uint16) + np.uint16(1)
    codes[~valid] = 0
    # Second differences of smooth codes are small, and compress to a third.
    change = np.diff(np.diff(codes, axis=0, prepend=np.uint16(0)), axis=1, prepend=np.uint16(0))
    field = PackedField(codes.shape, low, high, steps, zlib.compress(np.ascontiguousarray(change).tobytes(), 1))
    return field, _decoded(codes, low, high, steps)


def _decoded(codes: np.ndarray, low: float, high: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    valid = codes > 0
    step = (high - low) / steps
    return np.where(valid, np.exp(np.float32(low) + np.float32(step) * (codes - np.float32(1))), 1), valid
