"""Whether a map's numbers agree with each other.

The reprojection error of the map's own observations tells a wrong reading from a right one: read as they should be,
real maps have about a pixel; read with the poses inverted, a hundred. When a map does not fit, the other readings that
occur in practice are tried and the one that fits is named. None is ever taken silently: what fits may still be a
coincidence, and the user has to know what her files say.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.maps.convention import SIDECAR, distorted
from lightdepth.sparse_map import Keyframe, Submap

MAX_MEDIAN_PX = 5.0
_MIN_SHARE_IN_VIEW = 0.5
_CELLS = 32  # of the z-buffer along the longer side of the image
_HIDDEN = 1.5
_HALF_A_PIXEL = 0.93  # real keypoints half a pixel off: 1.19 px for 1.36, and 1.16 for 1.33


def reprojection(submap: Submap) -> tuple[float, float]:
    """Median reprojection error [px] of the observations whose point is in view, and the share of those that are."""
    errors = submap.reprojection_errors()
    observations = sum(len(submap.observed_points(k)[0]) for k in submap.keyframes)
    return (float(np.median(errors)) if len(errors) else np.inf), len(errors) / max(observations, 1)


def checked(submap: Submap, where: Path) -> Submap:
    """The submap, if its observations agree with its poses, points and cameras.

    Raises InputError when they do not but would under another reading, which is named; warns when none is found.
    A submap without any observation gets them by projection, with a warning and `weak_visibility` set.
    """
    if not any(len(submap.observed_points(k)[0]) for k in submap.keyframes):
        submap = seen_by_projection(submap)
        warnings.warn(
            f"{where}: no keyframe says which points it observed; taken to be every point in its view, hidden ones "
            "included. Alignment will be weaker: export the keypoints with their point ids if you can",
            stacklevel=2,
        )
        return submap
    median, share = reprojection(submap)
    if median <= MAX_MEDIAN_PX and share >= _MIN_SHARE_IN_VIEW:
        _whisper_half_a_pixel(submap, where, median)
        return submap
    found = f"median reprojection error {median:.1f} px, {share:.0%} of the observations in view"
    if not share:
        found = "none of the keyframes has a point that it observed in its view"
    fits = {what: reprojection(other(submap)) for what, other in OTHER_READINGS.items()}
    fits = {what: fit for what, fit in fits.items() if fit[0] < MAX_MEDIAN_PX and fit[1] >= _MIN_SHARE_IN_VIEW}
    if fits:
        best = min(fits, key=lambda what: fits[what][0])
        raise InputError(where, found, f"it would be {fits[best][0]:.2f} px {best}")
    warnings.warn(
        f"{where}: {found}; expected about 1 px, at most {MAX_MEDIAN_PX:g}. Inverse poses, OpenGL's axes, half and "
        "double camera size, quaternion order, other units, mirrored and undistorted keypoints do not explain it: "
        "check that cameras, images and points3D belong together",
        stacklevel=2,
    )
    return submap


def guessed(submap: Submap, where: Path) -> Submap:
    """The submap with every point that no nearer one hides counted as observed, and a warning."""
    try:
        submap = seen_by_projection(submap, hide=True)
    except InputError as error:
        raise error.within(where) from error
    warnings.warn(
        f"{where}: a trajectory and a point cloud do not say which keyframe observed which point; taken to be every "
        "point in its view that no nearer one hides. Alignment will be weaker: export the keypoints with their point "
        "ids (COLMAP text) if you can",
        stacklevel=2,
    )
    return submap


def _whisper_half_a_pixel(submap: Submap, where: Path, median: float) -> None:
    """Warns when the keypoints fit clearly better half a pixel away, towards the other convention."""
    for shift in (0.5, -0.5):
        moved = reprojection(_each(lambda k, by=shift: replace(k, pixels=k.pixels + by))(submap))[0]  # type: ignore[misc]  # bound in the loop
        if moved < _HALF_A_PIXEL * median:
            warnings.warn(
                f"{where}: median reprojection error {median:.2f} px, but {moved:.2f} px with {shift:+g} px on the "
                "keypoints: do keypoints and principal point count pixels alike? The first pixel's centre must be at "
                f'(0, 0) or at (0.5, 0.5) for both; which, "pixel_center" in {SIDECAR} says',
                stacklevel=3,
            )


def seen_by_projection(submap: Submap, hide: bool = False) -> Submap:
    """The submap with every point in a keyframe's view counted as observed at its projection.

    Hidden or not, unless `hide`: then without those far behind the nearest one of their part of the image.
    """
    keyframes = []
    for keyframe in submap.keyframes:
        points = keyframe.in_camera(submap.points)
        pixels, valid = keyframe.camera.project(points)
        if hide:
            valid = _unhidden(pixels, np.linalg.norm(points, axis=1), valid, keyframe.camera)
        keyframes.append(replace(keyframe, pixels=pixels[valid], point_ids=submap.point_ids[valid]))
    if not any(len(k.point_ids) for k in keyframes):
        raise InputError(
            f"map {submap.id}",
            "no keyframe observed a point, and none has a point in its view",
            f'are the poses those of the format, or of "pose_convention" in {SIDECAR}, and do points and poses belong '
            "to the same map?",
        )
    return replace(submap, keyframes=tuple(keyframes), weak_visibility=True)


def _unhidden(pixels: np.ndarray, distance: np.ndarray, valid: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Which valid points (n,) are no farther than `_HIDDEN` times the nearest in their cell of a coarse z-buffer.

    Coarse, because a sparse map has about one point a cell; lenient, because a wall seen at a grazing angle has many
    distances in one.
    """
    side = max(camera.width, camera.height) / _CELLS
    column, row = (np.where(valid[:, None], pixels, 0) // side).astype(int).T
    cell = row * (_CELLS + 1) + column
    nearest = np.full((_CELLS + 1) ** 2, np.inf)
    np.minimum.at(nearest, cell[valid], distance[valid])
    result: np.ndarray = valid & (distance <= _HIDDEN * nearest[cell])
    return result


def _each(change: Callable[[Keyframe], Keyframe]) -> Callable[[Submap], Submap]:
    return lambda submap: replace(submap, keyframes=tuple(change(k) for k in submap.keyframes))


def _inverse(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, cam_from_map=np.linalg.inv(keyframe.cam_from_map))


def _scalar_last(keyframe: Keyframe) -> Keyframe:
    """The pose, had its quaternion been written x y z w and read w x y z: first the numbers read, then their order."""
    x, y, z, w = Rotation.from_matrix(keyframe.cam_from_map[:3, :3]).as_quat(scalar_first=True)
    pose = keyframe.cam_from_map.copy()
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    return replace(keyframe, cam_from_map=pose)


def _size(scale: float) -> Callable[[Keyframe], Keyframe]:
    def change(keyframe: Keyframe) -> Keyframe:
        camera: CameraModel = keyframe.camera
        return replace(keyframe, camera=camera.resized(round(camera.width * scale), round(camera.height * scale)))

    return change


def _undistorted(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, pixels=distorted(keyframe.camera, keyframe.pixels))


def _turned_over(keyframe: Keyframe) -> Keyframe:
    """The pose, had the camera's y been up and its z out of the scene."""
    return replace(keyframe, cam_from_map=np.diag([1.0, -1, -1, 1]) @ keyframe.cam_from_map)


def _mirrored(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, pixels=np.abs((keyframe.camera.width, 0) - keyframe.pixels))


def _longer(scale: float) -> Callable[[Keyframe], Keyframe]:
    def change(keyframe: Keyframe) -> Keyframe:
        pose = keyframe.cam_from_map.copy()
        pose[:3, 3] *= scale
        return replace(keyframe, cam_from_map=pose)

    return change


OTHER_READINGS: dict[str, Callable[[Submap], Submap]] = {
    "with the inverse poses. Poses are taken as camera-from-map (w2c) unless declared otherwise: invert them, or set "
    f'"pose_convention" to "w2c" or "c2w", whichever it is, in {SIDECAR} beside the files': _each(_inverse),
    "with the quaternions read as x y z w. Write them as w x y z": _each(_scalar_last),
    "with the inverse poses and the quaternions read as x y z w, as TUM has them. "
    "Write camera-from-map (w2c) poses as w x y z": _each(lambda k: _inverse(_scalar_last(k))),
    "with the camera at half its size: the keypoints are those of images half as large. "
    "Correct the size and intrinsics in the cameras file": _each(_size(0.5)),
    "with the camera at double its size: the keypoints are those of images twice as large. "
    "Correct the size and intrinsics in the cameras file": _each(_size(2.0)),
    "with the camera's y and z axes turned over, as OpenGL has them. Write poses of a camera whose y points down and "
    "whose z points into the scene": _each(_turned_over),
    "with the inverse poses and the camera's y and z axes turned over, as OpenGL and NeRF have them. Write "
    "camera-from-map (w2c) poses of a camera whose y points down and z into the scene": _each(
        lambda k: _turned_over(_inverse(k))
    ),
    **{
        f"with the places of its keyframes {scale:g} times as far apart: poses and points are in different units. "
        "Write both in one": _each(_longer(scale))
        for scale in (0.001, 0.1, 10.0, 1000.0)
    },
    "with the keypoints mirrored left for right. Give those of the images as they are": _each(_mirrored),
    "with undistorted keypoints. Export the distorted ones, or put "
    f'{{"keypoints": "undistorted"}} into {SIDECAR} beside the files': _each(_undistorted),
}
