"""The predicted uncertainty beside the points of hidden blocks of wall, keyframe by keyframe, and its calibration.

Two factors: on the uncertainty of what the model predicts, one scale for each keyframe taken out, which is what the
uncertainty is meant for; and on that of the depth as it was delivered, bent to the map's points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from densify.agreement import MOST_AT_ONCE
from lightdepth.hidden_uncertainty import HiddenCalibration, HiddenErrors, calibrated
from lightdepth.prediction import DepthPrediction


@dataclass(frozen=True, eq=False)
class Doubts:
    """Hidden points with their predicted uncertainty, by keyframe."""

    predicted: tuple[HiddenErrors, ...]
    """errors at one scale for each keyframe"""
    delivered: tuple[HiddenErrors, ...]
    """errors as delivered, by bend (but for its finer grid) or scale"""
    against: str = ""
    """why the map is no judge of the uncertainty; empty where nothing speaks against it"""

    @cached_property
    def calibration(self) -> DoubtsCalibrated:
        """What they say of the uncertainty."""
        found = calibrated(self.predicted), calibrated(self.delivered)
        return DoubtsCalibrated(*(replace(c, reason=c.reason or self.against) for c in found))


@dataclass(frozen=True)
class DoubtsCalibrated:
    """The calibration of a predicted uncertainty on hidden blocks."""

    predicted: HiddenCalibration
    """of what the model predicts, up to one scale for each frame"""
    delivered: HiddenCalibration
    """of the depth as it was delivered"""

    def __str__(self) -> str:
        also = f"; of the depth as delivered, factor {self.delivered.factor:.2f}" if self.delivered.ok else ""
        return f"{self.predicted}{also if self.predicted.ok else ''}"

    def record(self) -> dict[str, object]:
        """For run.json."""
        return {"predicted": self.predicted.record(), "delivered": self.delivered.record()}


def calibrated_together(doubts: Sequence[Doubts | None]) -> DoubtsCalibrated | None:
    """Of several submaps together, where nothing speaks against them; None where none has a predicted uncertainty."""
    known = [d for d in doubts if d is not None]
    known = [d for d in known if not d.against] or known[:1]
    if len(known) < 2:
        return known[0].calibration if known else None
    predicted = tuple(k for d in known for k in d.predicted)
    return Doubts(predicted, tuple(k for d in known for k in d.delivered)).calibration


def sigma_at(prediction: DepthPrediction, pixels: np.ndarray) -> np.ndarray | None:
    """The predicted uncertainty (n,) at pixels (n, 2), bilinear; None where the model has none."""
    if prediction.uncertainty is None or not len(pixels):
        return None
    if len(pixels) > MOST_AT_ONCE:
        parts = [sigma_at(prediction, part) for part in (pixels[:MOST_AT_ONCE], pixels[MOST_AT_ONCE:])]
        return np.concatenate([part for part in parts if part is not None])
    place = (pixels - 0.5).astype(np.float32)
    sampled = cv2.remap(
        prediction.uncertainty.astype(np.float32, copy=False),
        place[None, :, 0],
        place[None, :, 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    result: np.ndarray = sampled[0].astype(np.float64)
    return result
