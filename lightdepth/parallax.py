"""Distance by the images alone: what a textured pixel does from one keyframe to others whose poses are known.

A map's points and a network's distances can err alike. The images are a witness of their own: at the right distance
the patch around a pixel looks in other keyframes as it looks here. Notation: pixel p of keyframe i on the unit ray r,
L the log distance that is guessed for it; hypotheses d_k = exp(L + s_k), s_k evenly spaced on either side of 0. Each
hypothesis carries p, and two places beside it, into keyframe j; the three projections are an affine map of the patch
around p. Its zero-mean normalised cross-correlation (NCC) with what j shows, averaged over the j that see it, is the
score of s_k; the best one, to a part of a step by a parabola, is the distance (plane sweep; Collins 1996). A pixel
speaks only where the best score is high, no other hypothesis comes near it, and it falls off to both sides: without
texture, or without parallax, it does not.

The guess is the map's: the median distance of the points that the keyframe observed nearby. So what is judged has no
part in where is looked. It decides how a patch is slanted too; not what is found. Poses that contradict the images are
mended before (lightdepth.relative_pose); one factor on all of them, or a slow drift of it, cannot be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from scipy.spatial import cKDTree

from lightdepth.brief import Brief
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.frame import Frame, brightest
from lightdepth.observations import ObservedDistances, sample_distance
from lightdepth.patch_ncc import ncc
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import Range, above, at_least, checked
from lightdepth.sparse_map import Keyframe, Submap

_GRID, _NEAREST = 24, 7
_SATURATED = 0.97  # of the brightest value: highlights wander with the camera
_BESIDE = 2.0  # pixels from the middle of a patch to the places that tell its slant


@dataclass(frozen=True)
@checked
class ParallaxConfig:
    """How the images measure distance."""

    on: bool = True
    """Whether distances measured between the images of keyframes (by parallax) help to judge bends and surface;
    switched off, only the map's points do."""
    width: Annotated[int, at_least(16, up_to=10_000)] = 320
    """Width to which wider images are shrunk before they are compared, pixels. A larger one measures finer and takes
    longer."""
    across: Annotated[int, at_least(1, up_to=10_000)] = 24
    """Number of cells across the image, and in proportion down; in each, the pixel with most texture is measured. More
    give more distances and take longer."""
    neighbours: Annotated[int, at_least(1, up_to=1000)] = 4
    """Largest number of other keyframes that each is compared with. More make distances surer and take longer."""
    patch: Annotated[int, at_least(3, up_to=255)] = 7
    """Side of the square patches of image that are compared, pixels, an odd number. A larger one needs less texture and
    blurs edges."""
    angle: Annotated[float, above(0, up_to=180)] = 12.0
    """Parallax preferred in the choice of those keyframes, degrees: the angle between both cameras' rays to a shared
    point. A larger one measures distance more finely, between images that look less alike."""
    least_angle: Annotated[float, at_least(0, up_to=180)] = 2.0
    """Parallax below which two keyframes are not compared, degrees. A larger one leaves out more pairs."""
    least_score: Annotated[float, Range(-1, 1)] = 0.7
    """Least correlation, at most 1, of a patch with what the other keyframes show of it, for its distance to count. A
    larger one gives fewer, surer distances."""
    off_line: Annotated[float, at_least(0)] = 1.0
    """Distance of what two keyframes both show from its epipolar line, the median in pixels, above which the images
    tell how the two stood to each other, in place of the map's poses. A larger one trusts the map's poses more."""

    def __post_init__(self) -> None:
        if self.patch % 2 == 0:
            raise InputError("parallax.patch", f"{self.patch}", "expected an odd number, such as 7")


@dataclass(frozen=True, repr=False)
class Look(Brief):
    """A keyframe's image as it is compared: brightness (h, w) float32 in log, what of it is usable (h, w), and the
    keyframe under the camera of that size."""

    keyframe: Keyframe
    brightness: np.ndarray
    usable: np.ndarray

    @classmethod
    def of(cls, keyframe: Keyframe, frame: Frame, width: int) -> Look:
        """Of a keyframe and its frame, whose camera is the keyframe's."""
        image, valid, camera = frame.image, frame.valid, keyframe.camera
        clear = brightest(image) < _SATURATED * max(float(image.max()), 1e-6)
        gray: np.ndarray = (0.3 * image[..., 0] + 0.7 * image[..., 1]).astype(np.float32)
        if camera.width > width:
            size = (width, max(1, round(camera.height * width / camera.width)))
            camera = camera.resized(*size)
            gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
            valid, clear = (
                cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99 for m in (valid, clear)
            )
        light = np.log(np.clip(gray, 0, None) + 4 / 255).astype(np.float32)
        return cls(replace(keyframe, camera=camera), light, valid & clear)


def textured(look: Look, config: ParallaxConfig) -> np.ndarray:
    """Pixels (n, 2) of most texture, one of each cell that has any."""
    height, width = look.usable.shape
    reach = config.patch // 2 + 1
    usable = cv2.erode(look.usable.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8), borderValue=0) > 0
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(look.brightness, (0, 0), 0.8), 5, ksize=3)
    strength = np.where(usable, strength, 0)
    rows = np.linspace(0, height, max(2, round(config.across * height / width)) + 1).astype(int)
    columns = np.linspace(0, width, config.across + 1).astype(int)
    found = []
    for top, bottom in zip(rows[:-1], rows[1:], strict=True):
        for left, right in zip(columns[:-1], columns[1:], strict=True):
            cell = strength[top:bottom, left:right]
            if cell.size:
                row, column = divmod(int(cell.argmax()), cell.shape[1])
                if cell[row, column] > 0:
                    found.append((left + column + 0.5, top + row + 0.5))
    return np.array(found).reshape(-1, 2)


def parallax_neighbours(submap: Submap, config: ParallaxConfig) -> list[list[int]]:
    """For each keyframe the others that it is compared with: those that share points with it at a parallax nearest to
    the wanted one, as many from before it as from after it where there are."""
    rows = [submap.rows_of(submap.observed_points(k)[0])[0] for k in submap.keyframes]
    sees = np.zeros((len(rows), len(submap.points)), bool)
    for row, seen in zip(sees, rows, strict=True):
        row[seen] = True
    found = []
    for i, keyframe in enumerate(submap.keyframes):
        off = {}
        for j, other in enumerate(submap.keyframes):
            points = submap.points[sees[i] & sees[j]]
            if j == i or len(points) < 8:
                continue
            here, there = (p / np.linalg.norm(p, axis=1).clip(min=1e-12)[:, None] for p in
                           (points - keyframe.center, points - other.center))  # fmt: skip
            angle = float(np.degrees(np.median(np.arccos(np.clip((here * there).sum(1), -1, 1)))))
            if angle >= config.least_angle:
                off[j] = abs(np.log(angle / config.angle))
        before, after = (sorted((j for j in off if (j > i) == later), key=off.__getitem__) for later in (False, True))
        half = config.neighbours // 2
        chosen = before[:half] + after[:half]
        rest = sorted(before[half:] + after[half:], key=off.__getitem__)
        found.append(sorted(chosen + rest[: config.neighbours - len(chosen)]))
    return found


def guessed(keyframe: Keyframe, submap: Submap) -> np.ndarray:
    """Distance (h, w), map units, about every pixel of a keyframe by the map alone: the median of the points observed
    nearest to it, coarsely. NaN where the keyframe observed too few."""
    camera = keyframe.camera
    points = keyframe.in_camera(submap.observed_points(keyframe)[1])
    at, seen = camera.project(points)
    at, distance = at[seen], np.linalg.norm(points[seen], axis=1)
    if len(distance) < _NEAREST:
        return np.full((camera.height, camera.width), np.nan)
    rows, columns = max(2, round(_GRID * camera.height / camera.width)), _GRID
    size = np.array([camera.width, camera.height])
    grid = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), -1).reshape(-1, 2) / (columns, rows)
    nearest = cKDTree(at).query(grid * size, k=_NEAREST)[1]
    coarse = np.median(np.log(distance[nearest]), 1).reshape(rows, columns).astype(np.float32)
    smooth = cv2.resize(cv2.GaussianBlur(coarse, (0, 0), 1.0), (camera.width, camera.height))
    result: np.ndarray = np.exp(smooth)
    return result


def measured(
    look: Look, others: Sequence[Look], guess: np.ndarray, prediction: DepthPrediction, config: ParallaxConfig
) -> ObservedDistances:
    """Distances by parallax, as if they were points of the map: `mapped` is what the images say, within a factor of
    1.8 of the guess (h, w), map units; `predicted` is what the prediction says. All are of the look's size. `pixels`
    (n, 2) are in [0, 1]², over the image's size. Empty where no pixel speaks. `point_ids` number those that were tried.
    """
    pixels = textured(look, config)
    if not others or not len(pixels) or not np.isfinite(guess).any():
        return _none(0)
    sweep = _Sweep.of(look, pixels, guess, config.patch)
    total, count = np.zeros(sweep.shape), np.zeros(sweep.shape)
    for other in others:
        score, seen = sweep.compared(look, other)
        total += score
        count += seen
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count > 0, total / count, -1.0)
    step, speaks = _best(mean, config.least_score)
    predicted, valid = sample_distance(prediction, pixels)
    speaks &= sweep.known & valid
    camera, at = look.keyframe.camera, pixels[speaks]
    mapped, predicted = np.exp(sweep.guess[speaks] + step[speaks]), predicted[speaks]
    x = at / (camera.width, camera.height)
    return ObservedDistances(np.flatnonzero(speaks), mapped, predicted, x, camera.unproject(at)[0])


def _none(n: int) -> ObservedDistances:
    return ObservedDistances(np.zeros(n, int), np.zeros(n), np.zeros(n), np.zeros((n, 2)), np.zeros((n, 3)))


_STEP, _STEPS_EACH_WAY, _APART, _FALL_AT = 0.025, 24, 5, 6
_MARGIN, _FALL = 0.1, 0.1
HYPOTHESES = _STEP * np.arange(-_STEPS_EACH_WAY, _STEPS_EACH_WAY + 1)
"""Log distances from the guess at which a patch is compared."""


@dataclass(frozen=True)
class _Sweep:
    """The patches of one look: their values less the mean (n, q), and of every hypothesis the three places of each in
    camera axes (n, k, 3, 3)."""

    guess: np.ndarray
    known: np.ndarray
    own: np.ndarray
    places: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.guess), len(HYPOTHESES)

    @classmethod
    def of(cls, look: Look, pixels: np.ndarray, guess: np.ndarray, patch: int) -> _Sweep:
        camera: CameraModel = look.keyframe.camera
        three = (pixels[:, None] + np.array([[0, 0], [_BESIDE, 0], [0, _BESIDE]])).reshape(-1, 2)
        distance = _sampled(guess.astype(np.float32), three[None])[0].astype(float).reshape(-1, 3)
        rays, inside = camera.unproject(three)
        known = inside.reshape(-1, 3).all(1) & (distance > 0).all(1)
        distance = np.where(known[:, None], distance, 1.0)
        places = rays.reshape(-1, 1, 3, 3) * (distance[:, None] * np.exp(HYPOTHESES)[:, None])[..., None]
        half = patch // 2
        grid = np.stack(np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)), -1).reshape(-1, 2)
        own = _sampled(look.brightness, pixels[:, None] + grid)
        own -= own.mean(1, keepdims=True)
        return cls(np.log(distance[:, 0]), known, own, places)

    def compared(self, look: Look, other: Look) -> tuple[np.ndarray, np.ndarray]:
        """NCC (n, k) of every hypothesis with what another keyframe shows, 0 where it does not see it, and whether it
        does (n, k)."""
        other_from_this = other.keyframe.cam_from_map @ np.linalg.inv(look.keyframe.cam_from_map)
        moved = self.places.reshape(-1, 3) @ other_from_this[:3, :3].T + other_from_this[:3, 3]
        projected, seen = other.keyframe.camera.project(moved)
        known = seen.reshape(*self.shape, 3).all(2) & self.known[:, None]
        return ncc(other.brightness, other.usable, projected.reshape(*self.shape, 3, 2), known, self.own, _BESIDE)


def _sampled(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (n, m) float32 at pixels (n, m, 2), bilinear."""
    place = (at - 0.5).astype(np.float32)
    result: np.ndarray = cv2.remap(image, place[..., 0], place[..., 1], cv2.INTER_LINEAR)
    return result


def _best(score: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """The best hypothesis (n,) in log distance from the guess, and whether it can be told (n,)."""
    n, count = score.shape
    index, every = score.argmax(1), np.arange(n)
    top = score[every, index]

    def beside(offset: int) -> np.ndarray:
        result: np.ndarray = score[every, np.clip(index + offset, 0, count - 1)]
        return result

    near = np.abs(np.arange(count) - index[:, None]) < _APART
    rival = np.where(near, -1.0, score).max(1)
    fall = top - np.maximum(beside(-_FALL_AT), beside(_FALL_AT))
    speaks = (index >= 3) & (index < count - 3) & (top > least) & (top - rival > _MARGIN) & (fall > _FALL)
    left, right = beside(-1), beside(1)
    bend = np.minimum(left - 2 * top + right, -1e-9)
    part = np.clip(0.5 * (left - right) / bend, -0.5, 0.5)
    return HYPOTHESES[index] + _STEP * part, speaks
