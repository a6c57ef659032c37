"""A calibrated image, and a batch of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from lightdepth.brief import Brief
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.photometry import LightTerms, PhotometricCalibration
from lightdepth.which_frame import frame_number as frame_number


@dataclass(frozen=True, repr=False)
class Frame(Brief):
    """One calibrated image and the truth about it, where there is any.

    image (H, W, 3) float32 RGB in [0, 1] as the camera encoded it; mask (H, W) bool, True where the image shows tissue;
    true_distance (H, W) float32 [mm] along the ray with 0 where unknown, or None;
    true_world_from_cam (4, 4) [mm], or None; time [s].
    """

    name: str
    image: np.ndarray
    camera: CameraModel
    light: PhotometricCalibration = field(default_factory=PhotometricCalibration)
    mask: np.ndarray | None = None
    time: float | None = None
    true_distance: np.ndarray | None = None
    true_world_from_cam: np.ndarray | None = None

    def __post_init__(self) -> None:
        height, width = self.image.shape[:2]
        if self.image.ndim != 3 or self.image.shape[2] != 3:
            raise InputError(self.name, f"image of shape {self.image.shape}", "expected (H, W, 3)")
        check_image_size(self.name, width, height, self.camera)
        for what, array in (("mask", self.mask), ("true distance", self.true_distance)):
            if array is not None and array.shape != (height, width):
                raise InputError(
                    self.name,
                    f"{what} is {array.shape[1]}x{array.shape[0]}, the image {width}x{height}",
                    "they must have the same size",
                )

    @property
    def number(self) -> int:
        return frame_number(self.name)

    @property
    def valid(self) -> np.ndarray:
        """(H, W) bool: inside the mask and inside the camera model's field."""
        rays_valid = self.camera.rays()[1]
        return rays_valid if self.mask is None else self.mask & rays_valid


def brightest(image: np.ndarray) -> np.ndarray:
    """The largest channel (H, W) of an image (H, W, 3)."""
    # A chain of comparisons is ten times as fast as the maximum over the last axis, and gives the same.
    result: np.ndarray = np.maximum(np.maximum(image[..., 0], image[..., 1]), image[..., 2])
    return result


def readable(frames: Sequence[Frame], rows: Iterable[int]) -> Iterator[Frame]:
    """The frames at these rows, but for those that cannot be read."""
    for i in rows:
        with suppress(InputError):
            yield frames[i]


def check_image_size(name: str, width: int, height: int, camera: CameraModel) -> None:
    """Raises InputError, with the ratio and the cure, when the camera was calibrated at another image size."""
    if (camera.width, camera.height) == (width, height):
        return
    sx, sy = width / camera.width, height / camera.height
    found = f"the image is {width}x{height}, the camera {camera.width}x{camera.height}"
    if (camera.width, camera.height) == (height, width) and width != height:
        raise InputError(name, f"{found}: width and height are swapped in the calibration", "swap them there")
    if abs(sx / sy - 1) < 0.01:
        raise InputError(
            name,
            f"{found}: ratio {sx:.4g}",
            f"if the image was only resized, rescale the camera: multiply fx, fy, cx, cy by {sx:.6g} and set width "
            f"{width}, height {height} (`lightdepth convert-camera FILE --size '[{width}, {height}]' -o NEW` does it)",
        )
    raise InputError(
        name,
        f"{found}: ratios {sx:.4g} in width and {sy:.4g} in height differ, so the image was cropped or padded",
        "give the calibration of this image format",
    )


class FrameBatch(NamedTuple):
    """What a DataLoader yields. Rays, not cameras: no loss ever asks which lens it is.

    image (B, 3, H, W) encoded RGB; mask (B, 1, H, W) bool; rays (B, 3, H, W) unit; light terms;
    true_distance (B, 1, H, W), zero where true_valid (B, 1, H, W) bool is False.
    """

    image: Tensor
    mask: Tensor
    rays: Tensor
    light: LightTerms
    true_distance: Tensor
    true_valid: Tensor

    def to(self, device: torch.device | str) -> FrameBatch:
        moved = {name: value.to(device) for name, value in self._asdict().items() if name != "light"}
        return FrameBatch(light=LightTerms(*(term.to(device) for term in self.light)), **moved)


def to_batch(frame: Frame, size: tuple[int, int] | None = None) -> FrameBatch:
    """A batch of one, resized to (width, height) where given.

    Images are averaged over the pixels they merge (area), truth is sampled (nearest), so that no distance is invented
    between a fold and what lies behind it. A pixel is valid when every pixel it merges is.
    """
    import cv2

    image, truth, camera = frame.image, frame.true_distance, frame.camera
    size = size or (camera.width, camera.height)
    rays, valid = _rays_at(camera, None if frame.mask is None else _Kept(frame.mask), size)
    if size != (camera.width, camera.height):
        image = _resized(image, size)
        truth = None if truth is None else cv2.resize(truth, size, interpolation=cv2.INTER_NEAREST_EXACT)
    if truth is None:
        truth = np.zeros(valid.shape, np.float32)
    true_valid = np.isfinite(truth) & (truth > 0) & valid
    finite = np.isfinite(image).all(-1)  # images in memory may hold anything
    if not finite.all():
        valid, true_valid, image = valid & finite, true_valid & finite, np.where(finite[..., None], image, 0)
    return FrameBatch(
        image=_tensor(image.astype(np.float32, copy=False)),
        mask=_tensor(valid),
        rays=_tensor(rays),  # outside the field too: a jump there would bend normals and areas inside
        light=frame.light.terms(),
        true_distance=_tensor(np.where(true_valid, truth, 0).astype(np.float32)),
        true_valid=_tensor(true_valid),
    )


def _tensor(array: np.ndarray) -> Tensor:
    """(H, W) or (H, W, C) -> (1, C, H, W), a copy."""
    array = array[..., None] if array.ndim == 2 else array
    return torch.from_numpy(array.transpose(2, 0, 1).copy())[None]


class _Kept:
    """Hashes a mask by identity. The cache entry keeps the mask alive, so its id cannot be reused."""

    def __init__(self, mask: np.ndarray) -> None:
        self.mask = mask

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Kept) and self.mask is other.mask

    def __hash__(self) -> int:
        return id(self.mask)


def _rays_at(camera: CameraModel, mask: _Kept | None, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (h, w, 3) float32 of the camera at (width, height), and which pixels are valid (h, w).

    Kept for masks that cannot change, as those of files: they are the same for all frames of a sequence.
    """
    if mask is None or not mask.mask.flags.writeable:
        return _kept_rays(camera, mask, size)
    return _kept_rays.__wrapped__(camera, mask, size)


@lru_cache(maxsize=16)
def _kept_rays(camera: CameraModel, mask: _Kept | None, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    valid = camera.rays()[1] if mask is None else mask.mask & camera.rays()[1]
    if size != (camera.width, camera.height):
        valid = _resized(valid.astype(np.float32), size) > 0.999
    rays, rays_valid = camera.resized(*size).rays()
    return rays.astype(np.float32), valid & rays_valid


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """float (H, W) or (H, W, C) at (width, height): the mean over the pixels that are merged, else interpolated."""
    import cv2

    height, width = image.shape[:2]
    if size[0] < width and size[1] < height:
        # What cv2.INTER_AREA gives, in a third of its time: rows first, all columns of a row at once.
        rows = _merging(height, size[1]) @ image.reshape(height, -1)
        image = rows.reshape(size[1], *image.shape[1:])
    smaller = size[0] < width or size[1] < height
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def resized_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask (H, W) bool at (width, height): of each new pixel, whether its centre lies in it. cv2.INTER_NEAREST takes
    the pixel's corner in place of its centre, and so shifts a mask by half a pixel."""
    import cv2

    result: np.ndarray = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0
    return result


@lru_cache(maxsize=16)
def _merging(many: int, few: int) -> csr_matrix:
    """(few, many): each row the mean over an equal share of [0, many], parts of pixels included."""
    edges = np.arange(few + 1) * (many / few)
    pixels = np.arange(many)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return csr_matrix(np.clip(overlap, 0, None).astype(np.float32) * np.float32(few / many))


def flipped(batch: FrameBatch, chosen: Tensor, axis: int) -> FrameBatch:
    """The chosen (B,) bool images in a mirror: axis 0 left for right, axis 1 top for bottom.

    Everything is mirrored, rays and light with the image, so that what is seen stays physically right.
    """
    which = chosen.reshape(-1, 1, 1, 1)
    sign = torch.ones(1, 3, 1, 1, device=batch.image.device)
    sign[:, axis] = -1
    sign = torch.where(which, sign, 1.0)

    def mirror(tensor: Tensor) -> Tensor:
        return torch.where(which, tensor.flip(-1 - axis), tensor)

    light = batch.light._replace(position=batch.light.position * sign, direction=batch.light.direction * sign)
    return FrameBatch(
        image=mirror(batch.image),
        mask=mirror(batch.mask),
        rays=mirror(batch.rays) * sign,
        light=light,
        true_distance=mirror(batch.true_distance),
        true_valid=mirror(batch.true_valid),
    )
