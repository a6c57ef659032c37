"""What a map's own keypoints say of its reading: they know nothing of the images, and so judge apart from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.maps.checks import MAX_MEDIAN_PX, reprojection
from lightdepth.sparse_map import Keyframe, Submap

_HALF = 0.5
_BETTER = 0.93  # of the residual, below which half a pixel is told from none (as lightdepth.maps.checks has it)
_FAR = 4.0  # times the map's residual, beyond which a keyframe stands apart


@dataclass(frozen=True)
class Geometry:
    """Residuals of a submap's observations, medians in pixels of the map's cameras."""

    residual: float
    """under the map's own cameras"""
    half_a_pixel: float
    """the least with half a pixel on the keypoints or off them"""
    given: float | None
    """under the camera that the user gave in place of the map's; None where there is none"""
    apart: tuple[str, ...]
    """the keyframes whose own residual is far above that of all"""

    @property
    def tells_half_a_pixel(self) -> bool:
        """Whether half a pixel makes so much of a difference that it would be seen."""
        return not _BETTER < self.half_a_pixel / max(self.residual, 1e-9) < 1 / _BETTER

    def record(self) -> dict[str, object]:
        """As run.json holds it."""
        return {
            "residual_px": self.residual,
            "half_a_pixel_px": self.half_a_pixel,
            "given_camera_px": self.given,
            "keyframes_apart": list(self.apart),
        }


def geometry_of(submap: Submap, given: CameraModel | None = None) -> Geometry | None:
    """None where the map has no keypoints of its own, or none in view."""
    if submap.weak_visibility:
        return None
    residual = reprojection(submap)[0]
    if not np.isfinite(residual):
        return None
    moved = (_changed(submap, pixels=by) for by in (_HALF, -_HALF))
    half = min(reprojection(other)[0] for other in moved)
    of_given = None if given is None else reprojection(_changed(submap, camera=given))[0]
    return Geometry(residual, half, of_given, _apart(submap, residual))


def _changed(submap: Submap, pixels: float = 0.0, camera: CameraModel | None = None) -> Submap:
    def changed(keyframe: Keyframe) -> Keyframe:
        own = keyframe.camera
        other = own if camera is None else camera.resized(own.width, own.height)
        return replace(keyframe, pixels=keyframe.pixels + pixels, camera=other)

    return replace(submap, keyframes=tuple(map(changed, submap.keyframes)))


def _apart(submap: Submap, residual: float) -> tuple[str, ...]:
    apart = []
    for keyframe in submap.keyframes:
        _, points, pixels = submap.observed_points(keyframe)
        projected, valid = keyframe.camera.project(keyframe.in_camera(points))
        if valid.any():
            own = float(np.median(np.linalg.norm(projected - pixels, axis=1)[valid]))
            if own > max(MAX_MEDIAN_PX, _FAR * residual):
                apart.append(keyframe.name)
    return tuple(apart)
