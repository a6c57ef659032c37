"""A camera, a light and small data to train on."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scenes import cylinder

from lightdepth.calibration import write_camera, write_light
from lightdepth.camera import Pinhole
from lightdepth.datasets import write_c3vd
from lightdepth.datasets.c3vd import C3VD
from lightdepth.frame import Frame, to_batch
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


def write_c3vd_frames(folder: Path, count: int) -> Path:
    """Noisy textured frames in C3VD's octagon, about as large on disk as its own (1.9 MB), with depth and poses."""
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.uniform(0.2, 0.7, (40, 50, 3)), (1350, 1080), interpolation=cv2.INTER_CUBIC)
    rows, columns = np.mgrid[:1080, :1350]
    inside = np.minimum(columns, 1349 - columns) + np.minimum(rows, 1079 - rows) > 270
    distance = np.broadcast_to(np.linspace(5, 60, 1080, dtype=np.float32)[:, None], (1080, 1350))
    frame = Frame("0000_color", np.zeros((1080, 1350, 3), np.float32), C3VD, true_world_from_cam=np.eye(4))
    images = (np.clip(np.roll(smooth, 9 * i, 1) + 0.004 * rng.normal(size=smooth.shape), 0, 1) for i in range(count))
    write_c3vd(
        [
            replace(
                frame,
                name=f"{i:04d}_color",
                image=(image * inside[..., None]).astype(np.float32),
                true_distance=distance * inside,
            )
            for i, image in enumerate(images)
        ],
        folder,
    )
    return folder
