"""The readings that are tried besides the one at hand: what users and programs mix up in practice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lightdepth.camera import Brown, CameraModel, KannalaBrandt, Pinhole
from lightdepth.counting import counted
from lightdepth.datasets.counting import BY_NUMBER, Counting
from lightdepth.detective.witnesses import PixelMap
from lightdepth.maps.checks import OTHER_READINGS
from lightdepth.maps.convention import SIDECAR, distorted
from lightdepth.sparse_map import Submap


@dataclass(frozen=True)
class Reading:
    """One way to bring a map and frames together."""

    name: str
    """what it is, to follow "if": `every keyframe is one frame later`"""
    cure: str
    """what the user does who finds that it is right"""
    counting: Counting = BY_NUMBER
    """which frame a keyframe is"""
    moved: PixelMap | None = None
    """where the image shows what the map's camera saw; None where it did"""
    other_map: Callable[[Submap], Submap] | None = None
    """what becomes of the map; None where nothing does"""


AS_GIVEN = Reading("all is as given", "")

_RATES = (
    *((30, 25), (25, 30), (60, 30), (30, 60), (50, 25), (25, 50), (60, 25), (25, 60), (50, 30), (30, 50), (60, 50)),
    *((50, 60), (30, 29.97), (29.97, 30), (25, 24), (24, 25), (30, 24), (24, 30), (30, 29), (29, 30)),
    *((31, 30), (30, 31)),
)
"""Frames a second that videos have, and those that they were taken to have."""


def shifted(offset: int) -> Reading:
    """Every keyframe is the frame `offset` later."""
    many = f"{counted(abs(offset), 'frame')} {'later' if offset > 0 else 'earlier'}"
    cure = f'add {offset} to --frame-offset, or to "frame_offset" in {SIDECAR} beside the map (0 where there is none)'
    return Reading(f"every keyframe is {many}", cure, Counting(offset=offset))


def elsewhere(numbers: Sequence[int]) -> list[Reading]:
    """Frames so far away that they show other wall, as like each other as those of the map's `numbers` are: where they
    fit as well, the frames at hand are not the map's."""
    away = max(8, (max(numbers) - min(numbers)) // 4)
    return [shifted(away), shifted(-away)]


def other_rates(last: int) -> list[Reading]:
    """The frames were counted at another rate. Of rates by which the `last` keyframe is the same frame, the first
    stands for all, and those are left out by which it stays where it is."""
    found: dict[int, Reading] = {}
    for true, assumed in _RATES:
        rate = true / assumed
        if round(rate * last) != last:
            name = f"the video has {rate:.4g} times as many frames a second as the map's times were counted with"
            cure = (
                f'multiply --map-fps, or "fps" in {SIDECAR} beside the map, by {rate:.4g} ({true:g} for {assumed:g}, '
                "say), or give the frames that the map was made from"
            )
            found.setdefault(round(rate * last), Reading(name, cure, Counting(rate)))
    return list(found.values())


def other_images(camera: CameraModel, of_frames: CameraModel | None) -> list[Reading]:
    """The images are not those that the map's camera took, but the same changed. `of_frames` is the frames' own
    camera, where they have one."""
    width, height = float(camera.width), float(camera.height)
    unlike = "give the images that the map was made from, or a map made from these"

    def mirrored(x: bool, y: bool) -> PixelMap:
        return lambda pixels: np.where([x, y], (width, height) - pixels, pixels)

    found = [
        Reading("the images are mirrored left for right", unlike, moved=mirrored(True, False)),
        Reading("the images are mirrored top for bottom", unlike, moved=mirrored(False, True)),
        Reading("the images are turned upside down", unlike, moved=mirrored(True, True)),
        _of_other_size("half", 0.5),
        _of_other_size("twice", 2.0),
    ]
    if isinstance(camera, Brown | KannalaBrandt):
        found.append(
            Reading(
                "the images are undistorted and the map's keypoints are not",
                "give the images as the camera took them, or a map made from the undistorted ones",
                moved=lambda pixels: _undistorted(camera, pixels),
            )
        )
    if isinstance(camera, Pinhole) and of_frames is not None and not isinstance(of_frames, Pinhole):
        lens = of_frames.resized(camera.width, camera.height)
        found.append(
            Reading(
                "the images are as the lens made them and the map's keypoints are undistorted",
                f'put {{"keypoints": "undistorted"}} into {SIDECAR} and the lens into the map\'s camera, or give the '
                "undistorted images",
                moved=lambda pixels: lens.project(camera.unproject(pixels)[0])[0],
            )
        )
        found.append(
            Reading(
                "the images are as the lens made them and the map's keypoints are those of a pinhole of its K",
                f'put {{"keypoints": "undistorted"}} into {SIDECAR} and the lens into the map\'s camera, or give the '
                "undistorted images",
                moved=lambda pixels: distorted(lens, pixels),
            )
        )
    return found


def _of_other_size(much: str, scale: float) -> Reading:
    return Reading(
        f"the map's keypoints are those of images {much} as large as its camera says",
        "correct width and height of the map's camera, with its focal length and principal point, or give the frames "
        "that the map was made from",
        moved=lambda pixels: pixels / scale,
    )


def other_poses() -> list[Reading]:
    """Poses or cameras read as something else, for maps without keypoints that would tell."""
    return [
        Reading(f"the map is read {what.split('. ', 1)[0]}", what.split(". ", 1)[-1], other_map=change)
        for what, change in OTHER_READINGS.items()
    ]


def _undistorted(camera: Brown | KannalaBrandt, pixels: np.ndarray) -> np.ndarray:
    pinhole = Pinhole(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return pinhole.project(camera.unproject(pixels)[0])[0]
