"""A camera, a light and small data to train on."""

from pathlib import Path

import cv2
import numpy as np
from scenes import cylinder

from lightdepth.calibration import write_camera, write_light
from lightdepth.camera import Pinhole
from lightdepth.frame import to_batch
from lightdepth.photometry import PhotometricCalibration
from train.loader import collate

LIGHT = PhotometricCalibration(gain=100.0, position_mm=(1.0, 2.0, 0.5), direction=(0.1, -0.05, 1.0))
CAMERA = Pinhole(40, 32, 22.0, 22.0, 18.0, 17.0)
TINY_RUN = [
    *["--data.size", "[40, 32]", "--data.tube.scenes", "2", "--data.tube.val_scenes", "1", "--data.tube.frames", "4"],
    *["--model.network.width", "4", "--trainer.accelerator", "cpu", "--trainer.val_check_interval", "10"],
]


def batch_of(count: int = 2):
    return collate([to_batch(cylinder(CAMERA).frame(light=LIGHT)) for _ in range(count)])


def write_sequence(folder: Path, count: int = 12) -> Path:
    """Frames of a cylinder as a folder of images with camera and light beside them."""
    (folder / "frames").mkdir(parents=True)
    image = cylinder(CAMERA).frame(light=LIGHT).image
    for i in range(count):
        cv2.imwrite(str(folder / "frames" / f"{i:04d}.png"), np.round(image[..., ::-1] * 255).astype(np.uint8))
    write_camera(CAMERA, folder / "camera.json")
    write_light(LIGHT, folder / "light.json")
    return folder
