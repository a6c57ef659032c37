"""Models that turn a frame into a DepthPrediction, all behind the same two things: `model.name` and `model(frame)`.

A model works at its own image size (a network at the rows it was trained on) and gives the prediction at the frame's:
log distance is interpolated, so that halfway between t and 4t lies 2t.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightdepth.camera import CameraModel
from lightdepth.decline import BLUR, V_FLOOR, log_closed_form
from lightdepth.frame import Frame, FrameBatch, brightest, to_batch
from lightdepth.geometry import normals_from_distance
from lightdepth.network import DepthNetwork
from lightdepth.photometry import brightness, decode, hue_saturation_albedo
from lightdepth.prediction import DepthPrediction


class DepthModel(Protocol):
    """What every model is: a name for provenance, and a call."""

    @property
    def name(self) -> str: ...

    def __call__(self, frame: Frame) -> DepthPrediction: ...


def working_size(camera: CameraModel, rows: int) -> tuple[int, int]:
    """(width, height) of an image with so many rows and the camera's aspect."""
    return max(1, round(camera.width * rows / camera.height)), rows


class DeclineModel:
    """The closed form of lightdepth.decline, computed at no more than `rows` rows.

    With `details` it also gives the albedo of value 1 that the colours say, and the normals of the distance.
    """

    name = "decline"

    def __init__(self, rows: int = 256, blur: float = BLUR, details: bool = True) -> None:
        self.rows, self.blur, self.details = rows, blur, details

    @torch.inference_mode()
    def __call__(self, frame: Frame) -> DepthPrediction:
        batch = to_batch(frame, working_size(frame.camera, min(self.rows, frame.camera.height)))
        log_distance = log_closed_form(batch.image, batch.mask, batch.rays, batch.light, self.blur)
        albedo = None
        if self.details:
            colour = batch.image / brightness(batch.image).clamp(min=V_FLOOR)
            albedo = decode(colour.clamp(max=1), batch.light.gamma)
        return prediction_of(frame, batch, log_distance, albedo, self.name, self.details)


class ConstantModel:
    """Distance 1 everywhere: what a model that knows nothing says. The baseline of every evaluation."""

    name = "constant"

    def __call__(self, frame: Frame) -> DepthPrediction:
        ones = np.ones((frame.camera.height, frame.camera.width), np.float32)
        return DepthPrediction(frame.name, ones, _valid(frame), frame.camera, self.name)


class NetworkModel:
    """A trained network, run at images of `rows` rows. `card` says what it was trained on."""

    def __init__(
        self, network: DepthNetwork, rows: int, name: str, card: dict[str, Any] | None = None, details: bool = True
    ) -> None:
        self.network = network.eval()
        self.rows, self.name, self.card, self.details = rows, name, card or {}, details

    @property
    def device(self) -> torch.device:
        return next(self.network.parameters()).device

    def to(self, device: torch.device | str) -> NetworkModel:
        """The same model, its weights moved to a device."""
        self.network.to(device)
        return self

    @torch.inference_mode()
    def __call__(self, frame: Frame) -> DepthPrediction:
        batch = to_batch(frame, working_size(frame.camera, self.rows)).to(self.device)
        distance, albedo_hs, log_sigma = self.network.estimate(batch.image, batch.mask, batch.rays, batch.light)
        albedo = hue_saturation_albedo(albedo_hs) if self.details else None
        return prediction_of(frame, batch, distance.log(), albedo, self.name, self.details, log_sigma)


def predict(
    model: DepthModel, frames: Iterable[Frame], progress: Callable[[int], None] | None = None
) -> Iterator[DepthPrediction]:
    """Predictions of frames, one by one; `progress` is told how many are done."""
    for count, frame in enumerate(frames, 1):
        yield model(frame)
        if progress is not None:
            progress(count)


def prediction_of(
    frame: Frame,
    batch: FrameBatch,
    log_distance: Tensor,
    albedo: Tensor | None,
    source: str,
    details: bool,
    log_sigma: Tensor | None = None,
) -> DepthPrediction:
    """Brings what was computed on a batch of one at the working size to the frame's."""
    size = (frame.camera.width, frame.camera.height)
    log_distance = extended(log_distance.float(), batch.mask)
    normals = upsampled(normals_from_distance(log_distance.exp(), batch.rays), size) if details else None
    if normals is not None:
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return DepthPrediction(
        name=frame.name,
        distance=np.exp(upsampled(log_distance, size)),
        valid=_valid(frame),
        camera=frame.camera,
        source=source,
        albedo=None if albedo is None else upsampled(extended(albedo, batch.mask), size),
        normals=normals,
        uncertainty=None if log_sigma is None else np.exp(upsampled(extended(log_sigma, batch.mask), size)),
    )


def _valid(frame: Frame) -> np.ndarray:
    """(H, W) bool: inside mask and lens, and not black."""
    result: np.ndarray = frame.valid & (brightest(frame.image) > V_FLOOR)
    return result


def extended(values: Tensor, mask: Tensor, steps: int = 2) -> Tensor:
    """Values (1, C, H, W) continued outside the mask from their neighbours inside, a pixel a step.

    A coarse pixel that merges masked ones is invalid as a whole; the rim of the full-size mask interpolates into it.
    """
    for _ in range(steps):
        weight = F.avg_pool2d(mask.float(), 3, 1, 1)
        around = F.avg_pool2d(torch.where(mask, values, 0), 3, 1, 1) / weight.clamp(min=1e-6)
        reached = weight > 1e-6
        values = torch.where(mask, values, torch.where(reached, around, values))
        mask = mask | reached
    return values


def upsampled(values: Tensor, size: tuple[int, int]) -> np.ndarray:
    """(1, C, h, w) -> (H, W, C), or (H, W) of one channel, bilinear; size is (width, height)."""
    array = np.ascontiguousarray(values[0].float().cpu().numpy().transpose(1, 2, 0))
    return cv2.resize(array, size, interpolation=cv2.INTER_LINEAR) if array.shape[1::-1] != size else array.squeeze()
