"""A submap as a monocular SLAM that follows points makes it: short tracks, and errors that neighbours share.

A keyframe follows the points that the one before it observed, loses some, and fills up with new corners; a lost point
that is found again is a new one. A point's distance is wrong by a factor exp(e), which all keyframes that follow it
share, with

    e  =  c (pi_typical / pi)^0.65 h (sqrt(q) f(p) + sqrt(1 - q) g),   |e| at most log 1.25

pi the parallax between the first and the last ray that saw the point, f a smooth random field over space and g a
deviate of the point's own, both normal, h a factor of the point's own that makes the tails of Student's t, and c such
that the median of |e| is as asked. Power, tails, share q and length of f are what two maps of stella_vslam showed of a
colon with truth. The better one had a median |e| of 8.5 % at 1 degree of parallax, 1.7 % beyond 12, 3.3 % over all, a
90th percentile of 13 %, errors correlated by .21 within 1 % of the image's width and by .07 within 5 %, and 3.6
observations of a point; the worse one 8.2 %, 36 %, .35, .31 and 3.8. The wrong points that are known come on top, by
factors beyond 1.3. Lengths in mm.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightdepth.frame import Frame
from lightdepth.tube.breathing import Breathing
from lightdepth.tube.observed import points_at_corners, projected, sees, true_pose

_LOST = 0.2
"""Share of the points in view that a keyframe does not find again, beyond the second that observes them."""
_PARALLAX_POWER, _FREEDOM = 0.65, 4
_MOST, _WRONG = float(np.log(1.25)), float(np.log(1.3))


def tracks(
    frames: Sequence[Frame], count: int, rng: np.random.Generator, breathing: Breathing | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """World points (n, 3) and who observed them (frames, n) bool: up to `count` a frame, each by two at least.
    The points of a wall that is `breathing` are given at rest."""
    world, seen = np.zeros((0, 3)), np.zeros((len(frames), 0), bool)
    for k, frame in enumerate(frames):
        here = at(frame, world, breathing)
        if k:
            young = seen[: k - 1].sum(0) == 0  # a second look is what makes it a point
            seen[k] = seen[k - 1] & sees(frame, here) & (young | (rng.random(len(world)) >= _LOST))
        followed = projected(frame, here[seen[k]])
        new = points_at_corners(frame, count)
        if len(followed):
            apart = np.linalg.norm(projected(frame, new)[:, None] - followed, axis=-1).min(1) > 2
            new = new[apart]
        new = new[: max(0, count - len(followed))]
        if breathing is not None:
            new = breathing.at_rest(new, frame.time or 0.0)
        world = np.concatenate([world, new])
        seen = np.concatenate([seen, np.zeros((len(frames), len(new)), bool)], 1)
        seen[k, len(world) - len(new) :] = True
    kept = seen.sum(0) >= 2
    return world[kept], seen[:, kept]


def at(frame: Frame, rest: np.ndarray, breathing: Breathing | None) -> np.ndarray:
    """Where points (n, 3) of the wall at rest are when the frame is taken."""
    return rest if breathing is None else breathing.at(rest, frame.time or 0.0)


def distance_factors(
    frames: Sequence[Frame],
    world: np.ndarray,
    seen: np.ndarray,
    size: float,
    shared: float,
    length_mm: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """exp(e) of each point: `size` is the median of |e|, `shared` is q, `length_mm` how far f is alike."""
    centers = np.stack([true_pose(frame)[:3, 3] for frame in frames])
    first, last = seen.argmax(0), len(frames) - 1 - seen[::-1].argmax(0)
    rays = [world - centers[row] for row in (first, last)]
    cosine = (rays[0] * rays[1]).sum(1) / (np.linalg.norm(rays[0], axis=1) * np.linalg.norm(rays[1], axis=1))
    parallax = np.arccos(cosine.clip(-1, 1)).clip(min=1e-3)
    blurred = (np.median(parallax) / parallax) ** _PARALLAX_POWER
    tail = 1 / np.sqrt(rng.chisquare(_FREEDOM, len(world)) / _FREEDOM)
    own = rng.standard_normal(len(world))
    error = blurred * tail * (np.sqrt(shared) * smooth_field(world, length_mm, rng) + np.sqrt(1 - shared) * own)
    error *= size / max(float(np.median(np.abs(error))), 1e-12)
    result: np.ndarray = np.exp(error.clip(-_MOST, _MOST))
    return result


def wrong_factors(count: int, rng: np.random.Generator) -> np.ndarray:
    """Factors beyond 1.3 of distances that are wrong; two in three are too far, as where parallax is small."""
    size = _WRONG + rng.exponential(0.4, count)
    result: np.ndarray = np.exp(np.where(rng.random(count) < 2 / 3, size, -size))
    return result


def smooth_field(places: np.ndarray, length: float, rng: np.random.Generator, waves: int = 256) -> np.ndarray:
    """A normal deviate (n,) at places (n, 3), correlated by exp(-d² / 2 length²) (random Fourier features: Rahimi and
    Recht 2007)."""
    frequency, phase = rng.standard_normal((3, waves)) / length, rng.uniform(0, 2 * np.pi, waves)
    result: np.ndarray = np.sqrt(2 / waves) * np.cos(places @ frequency + phase).sum(1)
    return result
