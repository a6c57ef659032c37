"""DepthPrediction: what a model says about one frame, and its file."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lightdepth.brief import Brief
from lightdepth.camera import CameraModel, camera_from_params
from lightdepth.files.arrays import read_arrays
from lightdepth.files.reading import reading


@dataclass(frozen=True, repr=False)
class DepthPrediction(Brief):
    """Distance along the ray at every pixel of a frame, up to one scale per frame.

    distance (H, W) float32 > 0 where valid (H, W) bool; albedo (H, W, 3) and normals (H, W, 3) float32 or None;
    uncertainty (H, W) float32, standard deviation of log distance, or None when the model does not estimate it.
    `unit` is "up to scale" or "mm"; `source` names model and checkpoint.
    """

    name: str
    distance: np.ndarray
    valid: np.ndarray
    camera: CameraModel
    source: str
    unit: str = "up to scale"
    albedo: np.ndarray | None = None
    normals: np.ndarray | None = None
    uncertainty: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        assert self.distance.shape == shape == self.valid.shape, (self.distance.shape, self.valid.shape, shape)
        assert self.valid.dtype == bool, self.valid.dtype

    def scaled(self, scale: float) -> DepthPrediction:
        """The prediction with its distance multiplied by `scale`."""
        return replace(self, distance=self.distance * np.float32(scale))

    def save(self, path: str | Path | BinaryIO) -> None:
        """One compressed .npz, with unit, camera and provenance in `meta`."""
        camera = {
            "model": self.camera.name,
            "width": self.camera.width,
            "height": self.camera.height,
            "params": self.camera.params,
            "pixel_center": 0.5,
        }
        meta = {"name": self.name, "unit": self.unit, "source": self.source, "camera": camera}
        arrays: dict[str, Any] = {"distance": self.distance.astype(np.float32), "valid": self.valid}
        for key in ("albedo", "normals", "uncertainty"):
            value = getattr(self, key)
            if value is not None:
                arrays[key] = value.astype(np.float16 if key != "uncertainty" else np.float32)
        np.savez_compressed(path, meta=np.array(json.dumps(meta)), **arrays)


def log_distance_at(prediction: DepthPrediction, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Log distance (h, w) float32 at a smaller size (width, height), each the mean of the pixels that it merges, and
    where all of these are known (h, w)."""
    import cv2  # not at the top: whoever only reads predictions has no use for it

    # A model may call a distance valid that has no logarithm; it would spoil its neighbours.
    known = prediction.valid & (prediction.distance > 0) & np.isfinite(prediction.distance)
    log = np.log(np.where(known, prediction.distance, 1)).astype(np.float32)
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    log = cv2.resize(log, size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
    return log, share > 0.99


def shrunk(prediction: DepthPrediction, camera: CameraModel) -> DepthPrediction:
    """The distance alone, under its camera at a smaller size."""
    log, known = log_distance_at(prediction, (camera.width, camera.height))
    return DepthPrediction(prediction.name, np.exp(log), known, camera, prediction.source, prediction.unit)


def read_prediction(path: str | Path) -> DepthPrediction:
    """A prediction from its .npz. Raises InputError when it is not one."""
    cure = "expected an .npz made by `lightdepth predict`"
    with reading(path, "a prediction", cure):
        arrays = read_arrays(Path(path), "a prediction", cure)
        meta = json.loads(str(arrays.pop("meta")))
        for key in arrays.keys() - {"valid"}:  # albedo and normals are stored in half precision
            arrays[key] = arrays[key].astype(np.float32)
        camera = meta["camera"]
        lens = camera_from_params(camera["model"], camera["width"], camera["height"], camera["params"], str(path))
        shape = (lens.height, lens.width)
        if arrays["distance"].shape != shape or arrays["valid"].shape != shape or arrays["valid"].dtype != bool:
            raise ValueError(f"arrays of other shapes than {lens.width}x{lens.height}")
        return DepthPrediction(meta["name"], camera=lens, source=meta["source"], unit=meta["unit"], **arrays)
