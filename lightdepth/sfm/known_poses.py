"""Known poses, judged by the matches of the frames: which reading of them lets matched features meet in space?

Two rays of one feature should meet in front of both cameras. Under a wrong reading of the poses (inverted, other axes)
they do not, whatever the scene: so the share of the matches that do is nearly all or next to nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.pose_readings import POSE_READINGS

Matches = Sequence[tuple[str, str, np.ndarray, np.ndarray]]
"""Pairs of frames by name, with the pixels (n, 2) of their matched features in the one and the other."""

_REACH_PX = 4.0  # COLMAP's own bound on the reprojection error of a point
_FITS = 0.7  # a reading fits: at least this share of the matches meet (measured: .99 under the right one),
_BETTER = 1.5  # and so many times the share that does as given (measured: .02 to .37 under a wrong one)
_POOR = 0.4  # below this share, poses that no other reading mends are doubted


@dataclass(frozen=True)
class PosesFit:
    """How well one reading of the poses lets the matched features meet."""

    reading: str
    """which reading, in the words of a message"""
    share: float
    """share of the matches whose rays meet in front of both cameras, within 4 px"""
    px: float
    """median distance of a match from the ray of its partner's point, pixels"""
    matches: int
    """how many matches were looked at"""

    def __str__(self) -> str:
        return f"{self.share:.0%} of {self.matches} matches meet in front of both cameras (median {self.px:.2g} px)"

    @property
    def poor(self) -> bool:
        """Whether the poses are doubtful: matches were looked at, and most do not meet."""
        return self.matches > 0 and self.share < _POOR


def fitting_poses(matches: Matches, poses: Mapping[str, np.ndarray], camera: CameraModel, turn: np.ndarray) -> PosesFit:
    """How well the poses fit as they were given; NaN pixels where no pair of matched frames has poses.

    `poses` are world_from_cam (4, 4) by name, `turn` (4, 4) goes from its axes to the camera's. Raises InputError where
    another reading of the poses fits and theirs does not, with the figures of both.
    """
    known = [m for m in matches if m[0] in poses and m[1] in poses]
    given, *others = [_fit(name, known, poses, camera, turn) for name in POSE_READINGS]
    best = max(others, key=lambda fit: fit.share)
    if best.share >= max(_FITS, _BETTER * given.share):
        raise InputError(
            "known poses",
            f"as given, {given}",
            f"give them as expected: {best.share:.0%} meet ({best.px:.2g} px) {best.reading}",
        )
    return given


def _fit(
    reading: str, matches: Matches, poses: Mapping[str, np.ndarray], camera: CameraModel, turn: np.ndarray
) -> PosesFit:
    meant = POSE_READINGS[reading]
    off, front = [np.zeros(0)], [np.zeros(0, bool)]
    for one, other, a, b in matches:
        first, second = (meant(poses[name]) @ np.linalg.inv(turn) for name in (one, other))
        (rays_a, seen_a), (rays_b, seen_b) = camera.unproject(a), camera.unproject(b)
        use = seen_a & seen_b
        angle, ahead = _meeting(rays_a[use], rays_b[use], np.linalg.inv(second) @ first)
        off.append(angle * camera.focal_length)
        front.append(ahead)
    px, ahead = np.concatenate(off), np.concatenate(front)
    share = float((ahead & (px <= _REACH_PX)).mean()) if len(px) else 0.0
    return PosesFit(reading, share, float(np.median(px)) if len(px) else float("nan"), len(px))


def _meeting(a: np.ndarray, b: np.ndarray, b_from_a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of unit rays (n, 3) in two cameras: the angle (n,) [rad] between each ray and the point midway between the two,
    the larger one, and whether that point lies in front of both cameras (n,)."""
    a, center = a @ b_from_a[:3, :3].T, b_from_a[:3, 3]
    cosine = (a * b).sum(1)
    sine = np.maximum(1 - cosine**2, 1e-12)
    along_a = (cosine * (b @ center) - a @ center) / sine
    along_b = (b @ center - cosine * (a @ center)) / sine
    middle = 0.5 * (center + along_a[:, None] * a + along_b[:, None] * b)
    angles = [_angle(a, middle - center), _angle(b, middle)]
    return np.maximum(*angles), (along_a > 0) & (along_b > 0)


def _angle(rays: np.ndarray, towards: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.arctan2(np.linalg.norm(np.cross(rays, towards), axis=1), (rays * towards).sum(1))
    return result
