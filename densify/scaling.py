"""The millimetres of dense maps, from the light: what keyframes see of the surfaces, and how that is told.

Shading is compared at images of some 160 pixels across, as lightdepth.light.millimetres was tuned at; distances are
those of the fused surface along the pixels' rays. Of a map's keyframes some twelve are taken, from the middle of its
path, each a little apart from the one before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from densify.dense_map import DenseMap, Surface
from densify.scale_file import MapScale, Scales
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame, brightest
from lightdepth.light.known_length import KnownLength, weighed
from lightdepth.light.looks import Look
from lightdepth.light.millimetres import together
from lightdepth.photometry import PhotometricCalibration
from lightdepth.sparse_map import Keyframe

_ACROSS = 160  # pixels of the longer side of the images in which shading is compared
_LOOKS = 12
_APART = 0.05  # least way from one of them to the next, as a share of the distance to the wall
_WHITE = 0.98  # V of a pixel that the sensor may have clipped
_SURFACE = 0.1
"""Deviation of the logarithm of a scale by what is wrong with a fused surface and a map's poses: with it errors on five
tuning colons are as large as stated (docs/millimetres.md)."""
_OFF = 0.25
"""How far from a map's surface a place on it may be said to be, as a share of the surface's diagonal: a tool before the
wall may be, places of another map or in another unit are not."""
WALL_MM = 30.0
"""Where the wall usually is: from .4 to 2.5 times as far a scale is looked for."""


@dataclass(frozen=True, eq=False)
class SeenMap:
    """A dense map's surface and the keyframes that it was made from, in the same unit."""

    id: int
    surface: Surface
    keyframes: tuple[Keyframe, ...]

    @classmethod
    def of(cls, dense: DenseMap) -> SeenMap:
        return cls(dense.submap.id, dense.surface, tuple(dense.aligned_keyframes))

    def check_near(self, places: np.ndarray) -> None:
        """Raises InputError where one of places (n, 3) is nowhere near the surface."""
        found = self.surface.closest(places)[0]
        off, across = np.linalg.norm(found - places, axis=1), self.surface.diagonal
        if (off > _OFF * across).any():
            worst = int(off.argmax())
            raise InputError(
                f"--length.ends {np.round(places[worst], 4).tolist()}",
                f"it is {off[worst]:.3g} from the surface of map {self.id}, whose diagonal is {across:.3g}",
                f"the nearest place on it is {np.round(found[worst], 4).tolist()}",
            )

    def distance(self, keyframe: Keyframe, camera: CameraModel) -> np.ndarray:
        """Distance (H, W) to the surface along the pixels' rays, 0 where none is met."""
        rays, inside = camera.rays()
        turn, shift = keyframe.cam_from_map[:3, :3], keyframe.center
        found = np.zeros(inside.shape)
        met = self.surface.cast(shift, rays[inside] @ turn)
        found[inside] = np.where(np.isfinite(met), met, 0)
        return found

    def looks(self, frames: FrameSequence, gamma: float) -> list[Look]:
        """What chosen keyframes see; those whose image cannot be read are left out. Raises InputError where none can
        be read."""
        seen, read, unread = [], 0, None
        for keyframe in self._chosen():
            try:
                frame = frames.of_keyframe(keyframe)
            except InputError as error:
                unread = error
                continue
            read += 1
            camera, image, valid = reduced(frame, gamma)
            look = Look(camera, keyframe.cam_from_map, image, valid, self.distance(keyframe, camera))
            if (look.valid & (look.distance > 0)).any():
                seen.append(look)
        if unread is not None and not read:
            raise unread
        return seen

    def _chosen(self) -> list[Keyframe]:
        """Keyframes around the middle of the path, some way apart."""
        if not self.keyframes:
            return []
        middle = self.keyframes[len(self.keyframes) // 2]
        met = self.distance(middle, _small(middle.camera))
        typical = float(np.median(met[met > 0])) if (met > 0).any() else 0.0
        rows, last = [], np.full(3, np.inf)
        for row, keyframe in enumerate(self.keyframes):
            if np.linalg.norm(keyframe.center - last) >= _APART * typical:
                rows.append(row)
                last = keyframe.center
        nearest = int(np.abs(np.array(rows) - len(self.keyframes) // 2).argmin())
        first = max(0, min(nearest - _LOOKS // 2, len(rows) - _LOOKS))
        return [self.keyframes[row] for row in rows[first : first + _LOOKS]]


def _small(camera: CameraModel) -> CameraModel:
    share = min(1.0, _ACROSS / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * share)), max(1, round(camera.height * share)))


def reduced(frame: Frame, gamma: float) -> tuple[CameraModel, np.ndarray, np.ndarray]:
    """Camera, image and valid pixels of a frame at the size at which shading is compared: means of linear light, white
    where any pixel was clipped, valid where all were."""
    camera = _small(frame.camera)
    size = (camera.width, camera.height)
    if size == (frame.camera.width, frame.camera.height):
        return camera, frame.image, frame.valid

    def mean(values: np.ndarray) -> np.ndarray:
        result: np.ndarray = cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return result

    image = mean(np.maximum(frame.image, 0) ** gamma) ** (1 / gamma)
    image[mean(brightest(frame.image) >= _WHITE) > 0] = 1
    return camera, image, mean(frame.valid) > 1 - 1e-6


def scales_of(
    maps: Sequence[SeenMap],
    frames: FrameSequence,
    light: PhotometricCalibration,
    wall_mm: float = WALL_MM,
    length: KnownLength | None = None,
) -> Scales:
    """What light and a known length (its map is a place among `maps`) tell of the maps' units, together."""
    looks = [one.looks(frames, light.gamma) for one in maps]
    near = [wall_mm / _typical(one) for one in looks]
    found = together(looks, light, near, surface=_SURFACE)
    if length is not None:
        found = weighed(found, length)
    return Scales(tuple(MapScale.of(one.id, told) for one, told in zip(maps, found.maps, strict=True)))


def _typical(looks: Sequence[Look]) -> float:
    seen = [look.distance[look.distance > 0] for look in looks]
    return float(np.median(np.concatenate(seen))) if seen else 1.0
