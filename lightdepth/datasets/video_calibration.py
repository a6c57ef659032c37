"""The calibration that lies beside a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.calibration import read_camera, read_light
from lightdepth.camera import CameraModel
from lightdepth.datasets import endomapper
from lightdepth.datasets.sequence import read_mask
from lightdepth.photometry import PhotometricCalibration


@dataclass(frozen=True)
class VideoCalibration:
    """What is known of a video's endoscope; None where nothing was found."""

    camera: CameraModel | None = None
    light: PhotometricCalibration | None = None
    mask: np.ndarray | None = None


def found_calibration(path: Path, width: int, height: int) -> VideoCalibration:
    """camera.json, light.json and mask.png beside a video of this size, else EndoMapper's calibration.

    Raises InputError where EndoMapper's tree says that the endoscope has none.
    """
    folder = path.parent
    camera = light = None
    if (folder / "camera.json").is_file():
        camera = read_camera(folder / "camera.json")
    elif (file := endomapper.calibration_file(folder, endomapper.GEOMETRY)) is not None:
        camera = endomapper.at_size(read_camera(file), width, height, path.name)
    if (folder / "light.json").is_file():
        light = read_light(folder / "light.json")
    elif (file := endomapper.calibration_file(folder, endomapper.PHOTOMETRY)) is not None:
        light = read_light(file)
    mask = read_mask(folder / "mask.png") if (folder / "mask.png").is_file() else None
    return VideoCalibration(camera, light, mask)
