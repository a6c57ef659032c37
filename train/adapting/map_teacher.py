"""A sparse map as a teacher of the network that will make its surface dense, after SfM-TTR (Izquierdo and Civera, CVPR
2023): its points, and the tissue that two of its keyframes see.

Notation: a distance of a map point from a keyframe, t the network's on the same ray; keyframe i is at the scale s_i
that LMedS gives it, renewed in every step, through which no gradient goes. X a pixel of keyframe i placed in the map by
s_i t, p its projection in keyframe j with centre c_j. Means over points and pixels with weights w:

    points    w |log a - log s_i t|
    overlap   w |log |X - c_j| - log s_j t_j(p)|       both ways; the place p, too, is taken as given

w are Geman-McClure's of the residual in robust deviations: wrong points and hidden tissue teach nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch, readable, to_batch
from lightdepth.robust import lmeds_scale, mad_sigma, robust_weights
from lightdepth.sparse_map import SparseMap, covisibility

from ..loader import collate

LEAST_POINTS = 8  # as many as alignment asks of a keyframe
_NEIGHBOURS = 4  # keyframes that each meets: those that share most points with it
_LEAST_SIGMA = 0.02  # of log distance
_MAX_GAP = 0.5  # of log distance: beyond, it is other tissue
_PIXELS = 1000  # of an image that are compared, or about so many


@dataclass(frozen=True)
class TaughtKeyframe:
    """What one keyframe has to teach: row in its sequence, pose (4, 4), camera of the frame, for its points the places
    (n, 2) in [0, 1]² and distances (n,) in map units, and other keyframes of its submap that see the same tissue."""

    frame: int
    cam_from_map: np.ndarray
    camera: CameraModel
    places: np.ndarray
    distances: np.ndarray
    partners: tuple[int, ...] = ()


@dataclass(frozen=True)
class Lesson:
    """Keyframes that are looked at together, one or two, and their images."""

    keyframes: tuple[TaughtKeyframe, ...]
    batch: FrameBatch


class MapTeacher:
    """Lessons from the keyframes of a map whose frames are in `frames`.

    Points that any of the keyframes numbered `withheld` observed, and those with the ids `hidden` by submap id, are
    never shown, so that they can judge.
    """

    def __init__(
        self,
        frames: FrameSequence,
        sparse_map: SparseMap,
        size: tuple[int, int],
        withheld: Iterable[int],
        seed: int,
        hidden: Mapping[int, np.ndarray] = MappingProxyType({}),
    ) -> None:
        self._frames, self._size, self._seed = frames, size, seed
        self.keyframes = _taught(frames, sparse_map, set(withheld), hidden)
        if not self.keyframes:
            raise InputError(
                sparse_map.source,
                f"no keyframe to learn from has {LEAST_POINTS} points that do not judge",
                "give more frames, or a smaller --held-out",
            )

    def lesson(self, step: int) -> Lesson:
        """The lesson of a step, which follows from it and the seed."""
        rng = np.random.default_rng((self._seed, step))
        first = self.keyframes[rng.integers(len(self.keyframes))]
        chosen = [first]
        if first.partners:
            chosen.append(self.keyframes[first.partners[rng.integers(len(first.partners))]])
        return Lesson(tuple(chosen), collate([to_batch(self._frames[k.frame], self._size) for k in chosen]))


def _taught(
    frames: FrameSequence, sparse_map: SparseMap, withheld: set[int], hidden: Mapping[int, np.ndarray]
) -> list[TaughtKeyframe]:
    camera = frames.first().camera
    rows = {number: row for row, number in enumerate(frames.numbers)}
    found: list[TaughtKeyframe] = []
    for submap in sparse_map.submaps:
        judged = [submap.observed_points(k)[0] for k in submap.keyframes if k.number in withheld]
        judging = np.unique(np.concatenate([*judged, hidden.get(submap.id, np.zeros(0, int))]))
        taught: dict[int, TaughtKeyframe] = {}
        for index, keyframe in enumerate(submap.keyframes):
            if keyframe.number not in rows or keyframe.number in withheld:
                continue
            ids, points, _ = submap.observed_points(keyframe)
            points = keyframe.in_camera(points[~np.isin(ids, judging)])
            pixels, seen = camera.project(points)
            distances = np.linalg.norm(points, axis=1)
            use = seen & (distances > 0)
            row = rows[keyframe.number]
            if use.sum() >= LEAST_POINTS and any(readable(frames, [row])):
                places = pixels[use] / (camera.width, camera.height)
                taught[index] = TaughtKeyframe(row, keyframe.cam_from_map, camera, places, distances[use])
        shared = covisibility(submap)
        place = {index: len(found) + n for n, index in enumerate(taught)}
        for index, alone in taught.items():
            order = [j for j in np.argsort(-shared[index], kind="stable").tolist() if j in taught and j != index]
            partners = tuple(place[j] for j in order[:_NEIGHBOURS] if shared[index, j])
            found.append(replace(alone, partners=partners))
    return found


def map_terms(distance: Tensor, lesson: Lesson) -> dict[str, Tensor]:
    """`points` and `overlap`, zero where there is nothing to compare. distance (B, 1, H, W) of the lesson's images."""
    log_t = distance.log()
    mask = lesson.batch.mask.to(distance.device)
    terms: dict[str, list[Tensor]] = {"points": [], "overlap": []}
    scales: list[float | None] = []
    for i, keyframe in enumerate(lesson.keyframes):
        predicted, known = _at(log_t[i], mask[i], keyframe.places)
        if int(known.sum()) < LEAST_POINTS:
            scales.append(None)
            continue
        log_a = torch.as_tensor(np.log(keyframe.distances[known]), dtype=distance.dtype, device=distance.device)
        seen = predicted.detach().double().cpu().numpy()
        log_scale = float(np.log(lmeds_scale(keyframe.distances[known], np.exp(seen)).scale))
        scales.append(log_scale)
        terms["points"].append(_robust_mean(log_a - log_scale - predicted))
    if len(scales) == 2 and None not in scales:
        rays = lesson.batch.rays.to(distance.device)
        log_d = log_t + distance.new_tensor(scales).reshape(-1, 1, 1, 1)
        for i, j in ((0, 1), (1, 0)):
            gap = _gap(log_d, mask, rays, lesson.keyframes, i, j)
            if len(gap):
                terms["overlap"].append(_robust_mean(gap))
    return {name: torch.stack(values).mean() if values else log_t.new_zeros(()) for name, values in terms.items()}


def _gap(log_d: Tensor, mask: Tensor, rays: Tensor, keyframes: Sequence[TaughtKeyframe], i: int, j: int) -> Tensor:
    """log |X - c_j| - log d_j(p) of pixels X of i that j sees as well (n,)."""
    height, width = log_d.shape[-2:]
    step = max(1, round((height * width / _PIXELS) ** 0.5))
    grid = torch.zeros(height, width, dtype=torch.bool, device=log_d.device)
    grid[step // 2 :: step, step // 2 :: step] = True
    row, column = (grid & mask[i, 0]).nonzero(as_tuple=True)
    j_from_i = torch.as_tensor(
        keyframes[j].cam_from_map @ np.linalg.inv(keyframes[i].cam_from_map), dtype=log_d.dtype, device=log_d.device
    )
    points = rays[i, :, row, column].T * log_d[i, 0, row, column].exp()[:, None] @ j_from_i[:3, :3].T + j_from_i[:3, 3]
    camera = keyframes[j].camera
    pixels, seen = camera.project(points.detach().double().cpu().numpy())
    places = np.where(seen[:, None], pixels / (camera.width, camera.height), -1.0)
    there, known = _at(log_d[j], mask[j], places)
    gap = points[torch.as_tensor(known, device=log_d.device)].norm(dim=1).clamp(min=1e-9).log() - there
    result: Tensor = gap[gap.detach().abs() < _MAX_GAP]
    return result


def _at(image: Tensor, mask: Tensor, places: np.ndarray) -> tuple[Tensor, np.ndarray]:
    """Values of image (1, H, W) at those of the places (n, 2) in [0, 1]² where it is known, and which those are."""
    grid = torch.as_tensor(2 * places - 1, dtype=image.dtype, device=image.device)[None, None]
    known = F.grid_sample(mask[None].to(image.dtype), grid, align_corners=False)[0, 0, 0] > 0.999
    values = F.grid_sample(image[None], grid[:, :, known], align_corners=False, padding_mode="border")[0, 0, 0]
    return values, known.cpu().numpy()


def _robust_mean(residual: Tensor) -> Tensor:
    """Mean |residual| (n,), weighted so that outliers do not count."""
    size = residual.detach().abs().double().cpu().numpy()
    sigma = mad_sigma(size, _LEAST_SIGMA)
    weight = torch.as_tensor(robust_weights(size / sigma), dtype=residual.dtype, device=residual.device)
    return (weight * residual.abs()).sum() / weight.sum().clamp(min=1e-9)
