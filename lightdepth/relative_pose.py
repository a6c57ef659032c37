"""Where another keyframe stood relative to this one, by their images, when the map's poses have it wrong.

Poses that drift turn a few pixels of error into false distances: what a pixel shows lies beside its epipolar line, and
the best match along the line is at another distance than the true one. The shift across the line tells, since no
distance explains it. Corners of one image are tracked into the other (Lucas and Kanade 1981) from where the map expects
them; where they lie beside their lines by more than tracking errs, turn and direction of the step between both
keyframes are fitted to them, held near the map's by a prior. Its length stays the map's: two images do not know it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from lightdepth.camera import CameraModel
from lightdepth.parallax import Look, ParallaxConfig, textured

_LEAST_TRACKS = 40
_TURN, _DIRECTION = np.radians(1.0), np.radians(4.0)  # how far off a map's neighbours are expected to be, one sigma
_TRACKING = 0.7  # pixels
_MENDED = 0.6  # a correction must leave at most this share of the distance from the lines
_THERE_AND_BACK = 0.5  # pixels
_SPREAD = 4.0  # pixels over which brightness and contrast are evened out


@dataclass(frozen=True)
class Tracks:
    """Unit rays (n, 3) of what two keyframes both show, each in its own camera's axes."""

    here: np.ndarray
    there: np.ndarray

    def off_lines(self, there_from_here: np.ndarray) -> np.ndarray:
        """Signed angle (n,), radians, of each ray there from the plane of both cameras and the ray here."""
        turned = self.here @ there_from_here[:3, :3].T
        normal = np.cross(there_from_here[:3, 3], turned)
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
        result: np.ndarray = np.arcsin(np.clip((normal * self.there).sum(1), -1, 1))
        return result


def as_the_images_say(look: Look, other: Look, guess: np.ndarray, config: ParallaxConfig) -> Look:
    """The other look, at the pose relative to the first that the images tell where the map's contradicts them.

    `guess` (h, w) is the distance about each pixel of the first, map units. The other comes back as it is where its
    pose agrees (median distance from the epipolar lines at most `config.off_line` pixels), where too little can be
    tracked, where its image is of another size, or where no turn and direction near the map's brings that distance to
    60 % of what it was.
    """
    start = other.keyframe.cam_from_map @ np.linalg.inv(look.keyframe.cam_from_map)
    if np.linalg.norm(start[:3, 3]) < 1e-12 or look.usable.shape != other.usable.shape:
        return other
    tracks = tracked(look, other, guess, start, config)
    pixels = pixels_per_radian(other.keyframe.camera)
    before = np.median(np.abs(tracks.off_lines(start))) * pixels if len(tracks.here) >= _LEAST_TRACKS else 0.0
    if before <= config.off_line:
        return other
    found = fitted(tracks, start, _TRACKING / pixels)
    if np.median(np.abs(tracks.off_lines(found))) * pixels > _MENDED * before:
        return other
    return replace(other, keyframe=replace(other.keyframe, cam_from_map=found @ look.keyframe.cam_from_map))


def tracked(look: Look, other: Look, guess: np.ndarray, there_from_here: np.ndarray, config: ParallaxConfig) -> Tracks:
    """What both show, tracked there and back from where the guess (h, w) and the map's poses expect it."""
    none = Tracks(np.zeros((0, 3)), np.zeros((0, 3)))
    pixels = textured(look, config)
    if not len(pixels):
        return none
    rays, known = look.keyframe.camera.unproject(pixels)
    column, row = pixels.astype(int).T
    distance = guess[row, column]
    known &= distance > 0
    pixels, rays, distance = pixels[known], rays[known], distance[known]
    expected, seen = other.keyframe.camera.project(
        rays * distance[:, None] @ there_from_here[:3, :3].T + there_from_here[:3, 3]
    )
    seen &= _inside(expected, other, 4.0)
    if seen.sum() < _LEAST_TRACKS:
        return none
    pixels, rays = pixels[seen], rays[seen]
    found, kept = _there_and_back(look, other, pixels, expected[seen])
    kept &= _inside(found, other, 1.0)
    there, within = other.keyframe.camera.unproject(found)
    kept &= within
    return Tracks(rays[kept], there[kept])


def fitted(tracks: Tracks, start: np.ndarray, tracking: float) -> np.ndarray:
    """The pose (4, 4) near `start` whose epipolar planes the tracks lie nearest to, robustly; its step is as long.

    `tracking` is how far a track errs, radians. The prior is one degree of turn, four of direction.
    """
    length = float(np.linalg.norm(start[:3, 3]))
    ahead = start[:3, 3] / length
    beside = np.linalg.svd(ahead[None])[2][1:]

    def pose(x: np.ndarray) -> np.ndarray:
        result = np.eye(4)
        result[:3, :3] = cv2.Rodrigues(x[:3])[0] @ start[:3, :3]
        direction = ahead + x[3:] @ beside
        result[:3, 3] = length * direction / np.linalg.norm(direction)
        return result

    prior = 1 / np.array([_TURN] * 3 + [_DIRECTION] * 2)

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([tracks.off_lines(pose(x)) / tracking, x * prior])

    return pose(least_squares(residuals, np.zeros(5), loss="cauchy").x)


def pixels_per_radian(camera: CameraModel) -> float:
    """In the middle of the image."""
    middle = np.array([camera.width / 2, camera.height / 2])
    rays = camera.unproject(np.stack([middle, middle + (1, 0)]))[0]
    return 1 / float(np.linalg.norm(rays[1] - rays[0]))


def _inside(pixels: np.ndarray, look: Look, margin: float) -> np.ndarray:
    height, width = look.usable.shape
    low, high = pixels - margin, np.array([width, height]) - margin - pixels
    result: np.ndarray = np.minimum(low, high).min(1) > 0
    return result


def _there_and_back(look: Look, other: Look, pixels: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) in the other image, and which of them lead back to where they came from (n,)."""
    images = _even(look), _even(other)
    start, guess = ((p - 0.5).astype(np.float32)[:, None] for p in (pixels, expected))
    found, forth = _followed(*images, start, guess)
    again, back = _followed(*images[::-1], found, start)
    kept: np.ndarray = forth & back & (np.linalg.norm(again - start, axis=2)[:, 0] < _THERE_AND_BACK)
    return found[:, 0].astype(float) + 0.5, kept


def _followed(
    here: np.ndarray, there: np.ndarray, start: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 1, 2) in another image, OpenCV's pixels, from where they are guessed, and which were found (n,)."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        here,
        there,
        start,
        guess.copy(),
        winSize=(13, 13),
        maxLevel=2,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found), np.asarray(status)[:, 0] > 0


def _even(look: Look) -> np.ndarray:
    """Brightness in 8 bits, (h, w), evened out: light and exposure are other ones in the other image."""
    light = look.brightness
    off = light - cv2.GaussianBlur(light, (0, 0), _SPREAD)
    spread = np.sqrt(cv2.GaussianBlur(off**2, (0, 0), _SPREAD)) + 0.01
    return np.clip(127 + 50 * off / spread, 0, 255).astype(np.uint8)
