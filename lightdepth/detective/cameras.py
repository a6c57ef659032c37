"""Whether the frames' own camera is the one that the map was made with.

A map carries its camera, and a folder of frames may carry another one. Images cannot tell the two apart: they are
looked up where the map's keypoints are, which know no camera. So the points are asked where each puts them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightdepth.camera import CameraModel, Pinhole
from lightdepth.camera.model import FocalCamera
from lightdepth.sparse_map import Submap

_LEAST_PX = 2.0  # what a camera that was refined on the same frames may differ by
_OF_DIAGONAL = 0.005  # of the image: about what 2 % of the focal length make at a typical place in it


@dataclass(frozen=True)
class OtherCamera:
    """A camera beside the one that a submap was made with."""

    pixels: float
    """median distance at the map's observed points, in pixels of the frames, between where the two cameras put them;
    infinite where the other does not see most of them"""
    limit: float
    """up to which they count as the same"""
    given: bool
    """whether the user gave it in place of the map's; else it lies beside the frames, and the map's is used"""

    @property
    def differs(self) -> bool:
        """Whether they put the points elsewhere."""
        return self.pixels > self.limit


def other_camera(submap: Submap, other: CameraModel | None, given: bool) -> OtherCamera | None:
    """The camera of the frames beside the submap's; None where there is none, or the submap has no observations.

    A map of undistorted keypoints has the pinhole of a lens, which is the same camera: the lens without distortion.
    """
    if other is None:
        return None
    size = other.width, other.height
    apart, plain = [], []
    for keyframe in submap.keyframes:
        points = keyframe.in_camera(submap.observed_points(keyframe)[1])
        own = keyframe.camera.resized(*size)
        apart.append(_apart(own, other, points))
        if isinstance(own, Pinhole) and isinstance(other, FocalCamera):
            plain.append(_apart(own, Pinhole(*size, other.fx, other.fy, other.cx, other.cy), points))
    together = np.concatenate([np.zeros(0), *apart])
    if not len(together):
        return None
    pixels = float(np.median(together))
    if plain and not given:
        pixels = min(pixels, float(np.median(np.concatenate(plain))))
    return OtherCamera(pixels, max(_LEAST_PX, _OF_DIAGONAL * float(np.hypot(*size))), given)


def _apart(own: CameraModel, other: CameraModel, points: np.ndarray) -> np.ndarray:
    """Distance in pixels between where two cameras put points (n, 3), of those that the first sees; infinite where the
    second does not."""
    mine, seen = own.project(points)
    theirs, valid = other.project(points)
    apart: np.ndarray = np.where(valid, np.linalg.norm(theirs - mine, axis=1), np.inf)[seen]
    return apart
