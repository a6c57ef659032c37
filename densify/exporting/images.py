"""The pictures that go with an exported map: as they are, or as a pinhole camera would have taken them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from lightdepth.camera import CameraModel, Pinhole
from lightdepth.camera_conversion import convert_camera
from lightdepth.files import images


def known_camera(camera: CameraModel, names: tuple[str, ...], instead: str) -> tuple[CameraModel, str]:
    """The camera itself where a program knows its model, else the nearest one of `instead`, and what to say of it.
    Raises InputError where that is too far off."""
    if camera.name in names:
        return camera, ""
    found = convert_camera(camera, instead).close_enough(f"{camera.name} camera")
    said = (
        f"{instead} in place of {camera.name}: off by {found.median_px:.2g} px (median), {found.max_px:.2g} px "
        f"(largest), over {found.seen_share:.1%} of the field"
    )
    return found.camera, said


def known_cameras(
    cameras: Iterable[CameraModel], names: tuple[str, ...], instead: str
) -> tuple[dict[CameraModel, CameraModel], list[str]]:
    """`known_camera` of each camera, by the camera itself, and what to say of them, each thing once."""
    found = {camera: known_camera(camera, names, instead) for camera in dict.fromkeys(cameras)}
    return {camera: known for camera, (known, _) in found.items()}, [*dict.fromkeys(w for _, w in found.values() if w)]


def pinhole_of(camera: CameraModel) -> Pinhole:
    """A pinhole camera of the same size and focal length; a pinhole's own."""
    if isinstance(camera, Pinhole):
        return camera
    f = camera.focal_length
    return Pinhole(camera.width, camera.height, f, f, camera.width / 2, camera.height / 2)


def seen_by(image: np.ndarray, camera: CameraModel, other: CameraModel) -> np.ndarray:
    """(H, W, 3) of `camera` as `other` would have taken it from the same place; black outside the first one's field."""
    if camera == other:
        return image
    rays, valid = other.rays()
    pixels, seen = camera.project(rays)
    at = (pixels - 0.5).astype(np.float32)
    moved = cv2.remap(image.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    return np.where((valid & seen)[..., None], moved, 0)


def write_image(path: Path, image: np.ndarray) -> None:
    """(H, W, 3) RGB in [0, 1] as an 8-bit PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    images.write_image(path, images.to_bgr8(image))
