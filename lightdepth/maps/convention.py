"""What the numbers of a map mean, and how they become ours.

Ours: the first pixel's centre is at (0.5, 0.5), poses are camera-from-map, keypoints are where the lens put them. A
file named `densify_map.json` beside a map declares what differs from the format's habit. What it says is taken at its
word: half a pixel hardly shows in the reprojection error, so it has to be declared and cannot be guessed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.frame import frame_number
from lightdepth.sparse_map import Keyframe

SIDECAR = "densify_map.json"


@dataclass(frozen=True)
class MapConvention:
    """How to read one map's files."""

    pixel_center: float = 0.5
    """Coordinate of the first pixel's centre, of keypoints and principal point alike, pixels: 0.0 or 0.5."""
    pose_convention: Literal["w2c", "c2w"] = "w2c"
    """Direction of the poses in images.txt: "w2c" is camera-from-map, "c2w" map-from-camera."""
    keypoints: Literal["distorted", "undistorted"] = "distorted"
    """Where keypoints are: "distorted", where the lens put them, or "undistorted", as a pinhole camera of the same K
    would see them."""
    frame_offset: int = 0
    """Number added to that in a keyframe's name, where names do not count as the frames do."""
    fps: float | None = None
    """Frames per second, where a keyframe has a time and no number."""

    def from_ours(self, camera: CameraModel) -> CameraModel:
        """A camera in our pixels, brought to the map's: the inverse of what `keyframe` does to it."""
        return camera.with_pixel_center(1.0 - self.pixel_center)

    def keyframe(
        self, name: str, camera: CameraModel, pose: np.ndarray, pixels: np.ndarray, ids: np.ndarray
    ) -> Keyframe:
        """A keyframe in our conventions from a file's camera, pose (4, 4), keypoints (n, 2) and point ids (n,)."""
        if self.keypoints == "undistorted":
            pixels = distorted(camera, pixels)
        if self.pose_convention == "c2w":
            pose = np.linalg.inv(pose)
        if self.frame_offset:
            name = f"{frame_number(name) + self.frame_offset:06d}{Path(name).suffix}"
        shift = 0.5 - self.pixel_center
        return Keyframe(name, camera.with_pixel_center(self.pixel_center), pose, pixels + shift, ids)


COLMAP = MapConvention()
EXPORTER = MapConvention(pixel_center=0.0)  # ORB-SLAM3 and its descendants keep OpenCV's pixel coordinates


_MAX_FRAME = 10**8  # a month of video; a time of day in seconds or nanoseconds lies above


def _zero_or_half(value: float) -> float:
    if value not in (0.0, 0.5):
        raise ValueError("expected 0.0 (OpenCV) or 0.5 (COLMAP)")
    return value


class _Sidecar(BaseModel):
    model_config = ConfigDict(extra="forbid")
    map_id: int | None = None
    pose_convention: Literal["w2c", "c2w"] | None = None
    pixel_center: Annotated[float, AfterValidator(_zero_or_half)] | None = None
    keypoints: Literal["distorted", "undistorted"] | None = None
    frame_offset: int | None = None
    fps: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    # For whoever writes or views a map; reading one does not need them.
    image_root: str | None = None
    image_pattern: str | None = None
    unit: Literal["arbitrary", "mm"] | None = None


def declared_convention(folder: Path, map_id: int, habit: MapConvention, roots: tuple[Path, ...] = ()) -> MapConvention:
    """The habit of the format, overridden by the `densify_map.json` in the map's folder or else in one of the roots."""
    path = next((p / SIDECAR for p in (folder, *roots) if (p / SIDECAR).is_file()), None)
    if path is None:
        return habit
    found = checked_fields(_Sidecar, read_json(path), str(path))
    if found.map_id is not None and path.parent == folder and found.map_id != map_id:
        raise InputError(path, f"map_id {found.map_id} in the folder of map {map_id}", "correct one of the two")
    names = ("pixel_center", "pose_convention", "keypoints", "frame_offset", "fps")
    return replace(habit, **{n: getattr(found, n) for n in names if getattr(found, n) is not None})


def frame_names(times: np.ndarray, fps: float | None, where: Path | str) -> list[str]:
    """Six-digit frame names of times (n,): round(t fps), or without fps the times themselves, which must be integers.

    Raises InputError when times are no frame numbers and nothing says how to count, and when two fall on one frame.
    """
    counted = np.asarray(times, np.float64) * (1.0 if fps is None else fps)
    numbers = np.rint(counted)
    if fps is None and (numbers != counted).any():
        raise InputError(
            where,
            f"the time {times[numbers != counted][0]:g} is not a frame number",
            f'put the video\'s {{"fps": ...}} into {SIDECAR} beside it to count frames by time, or write frame numbers '
            "as times",
        )
    if (numbers < 0).any() or (numbers > _MAX_FRAME).any():
        odd = times[(numbers < 0) | (numbers > _MAX_FRAME)][0]
        raise InputError(
            where,
            f"the time {odd:g} falls on no frame",
            f"expected seconds since the first frame of the video (with fps in {SIDECAR}) or frame numbers, not the "
            "time of day and not nanoseconds",
        )
    found, counts = np.unique(numbers, return_counts=True)
    if len(found) < len(numbers):
        raise InputError(
            where,
            f"{counts.max()} keyframes fall on frame {found[counts.argmax()]:.0f}",
            f"is fps in {SIDECAR} too low?",
        )
    return [f"{number:06.0f}.png" for number in numbers]


def distorted(camera: CameraModel, pixels: np.ndarray) -> np.ndarray:
    """Where the lens puts what a pinhole camera with the same K sees at pixels (n, 2)."""
    if not isinstance(camera, Brown | KannalaBrandt):
        return pixels
    pinhole = Pinhole(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return camera.project(pinhole.unproject(pixels)[0])[0]
