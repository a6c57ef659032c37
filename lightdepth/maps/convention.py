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
from lightdepth.ranges import ANY, Range, above, at_least, checked
from lightdepth.sparse_map import Keyframe
from lightdepth.which_frame import Clock, Stamps, frame_number

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
    time_offset: float | None = None
    """What the map's clock shows at the time 0 of the frames, seconds; None where it has to be found."""
    time_tolerance: float | None = None
    """How far a keyframe's time may be from its frame's, seconds; None is half a frame."""
    folder: str | None = None
    """The folder of images whose keyframes are wanted, of a map that has several."""
    sensor: int | None = None
    """The camera whose keyframes are wanted, of a map that has several."""
    frames: Stamps | None = None
    """The frames that the map will meet, where they are known."""

    @property
    def clock(self) -> Clock:
        """How the times of keyframes become frame numbers."""
        return Clock(self.fps, self.time_offset, self.time_tolerance, self.frames)

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
    time_offset: Annotated[float, Field(allow_inf_nan=False)] | None = None
    time_tolerance: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    # For whoever writes or views a map; reading one does not need them.
    image_root: str | None = None
    image_pattern: str | None = None
    unit: Literal["arbitrary", "mm"] | None = None


@dataclass(frozen=True, kw_only=True)
@checked
class MapReading:
    """How a map's keyframes are told apart and meet their frames, where its files leave it open."""

    map_folder: str | None = None
    """Folder of images in the map whose keyframes are taken, where it holds several (left, right; two clips)."""
    map_sensor: Annotated[int | None, at_least(0, up_to=2**32)] = None
    """Id of the camera, as in a COLMAP map's own files, whose keyframes are taken where it holds several, such as a
    stereo rig's left one; other maps have none. Another one takes another camera's keyframes; left out, all are taken,
    or an error lists the ids where two share frame numbers."""
    frame_offset: Annotated[int, ANY] = 0
    """Number of frames added to a keyframe's number, where the map counts from elsewhere: -1 where it counts from 1 and
    the frames from 0. A larger one matches each keyframe with a later frame."""
    map_fps: Annotated[float | None, above(0)] = None
    """Frames per second by which a map's times, in seconds, become frame numbers; it wins over the map's own rate and
    the frames' stamps, unless both are on one clock such as Unix time. A higher one gives each time a later frame; maps
    that name frames by number do not need it."""
    time_offset: Annotated[float | None, Range(-1e12, 1e12)] = None
    """What the map's clock shows at the time 0 of the frames, seconds; left out, it is found, and reported, where the
    map has another clock, such as Unix time. A larger one matches each keyframe with an earlier frame."""
    time_tolerance: Annotated[float | None, above(0)] = None
    """How far a keyframe's time may be from the stamp of its frame, seconds; left out, half a frame. A larger one
    accepts poorer stamps."""

    def over(self, convention: MapConvention) -> MapConvention:
        """The convention, with what was said here."""
        convention = replace(convention, frame_offset=convention.frame_offset + self.frame_offset)
        said = {
            "folder": self.map_folder,
            "sensor": self.map_sensor,
            "fps": self.map_fps,
            "time_offset": self.time_offset,
            "time_tolerance": self.time_tolerance,
        }
        return replace(convention, **{name: value for name, value in said.items() if value is not None})  # type: ignore[arg-type]  # each has its field's type


@dataclass(frozen=True)
class Reader:
    """What is known besides a map's own files: what was said of it, the frames that it will meet, and their camera."""

    reading: MapReading = MapReading()
    frames: Stamps | None = None
    camera: CameraModel | None = None

    def convention(
        self, folder: Path, map_id: int, habit: MapConvention, roots: tuple[Path, ...] = ()
    ) -> MapConvention:
        """The habit of the format, what is declared, then what was said."""
        declared = declared_convention(folder, map_id, habit, roots)
        return self.reading.over(replace(declared, frames=self.frames))


class CameraMissing(InputError):
    """A map has no camera of its own: that of the frames may be given in its place."""


def declared_convention(folder: Path, map_id: int, habit: MapConvention, roots: tuple[Path, ...] = ()) -> MapConvention:
    """The habit of the format, overridden by the `densify_map.json` in the map's folder or else in one of the roots."""
    path = next((p / SIDECAR for p in (folder, *roots) if (p / SIDECAR).is_file()), None)
    if path is None:
        return habit
    found = checked_fields(_Sidecar, read_json(path), str(path))
    if found.map_id is not None and path.parent == folder and found.map_id != map_id:
        raise InputError(path, f"map_id {found.map_id} in the folder of map {map_id}", "correct one of the two")
    names = ("pixel_center", "pose_convention", "keypoints", "frame_offset", "fps", "time_offset", "time_tolerance")
    return replace(habit, **{n: getattr(found, n) for n in names if getattr(found, n) is not None})


def distorted(camera: CameraModel, pixels: np.ndarray) -> np.ndarray:
    """Where the lens puts what a pinhole camera with the same K sees at pixels (n, 2)."""
    if not isinstance(camera, Brown | KannalaBrandt):
        return pixels
    pinhole = Pinhole(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return camera.project(pinhole.unproject(pixels)[0])[0]
