"""Predicted distance sampled where map points were seen: the pairs that alignment works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightdepth.brief import Brief
from lightdepth.frame import check_image_size
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, Submap


@dataclass(frozen=True, repr=False)
class ObservedDistances(Brief):
    """For each usable point that a keyframe observed: its id, distance from the camera in map units (mapped), the
    predicted distance on the same ray (predicted), the pixel (n, 2) of that ray, and the ray (n, 3) in camera axes."""

    point_ids: np.ndarray
    mapped: np.ndarray
    predicted: np.ndarray
    pixels: np.ndarray
    rays: np.ndarray

    def __len__(self) -> int:
        return len(self.mapped)

    def subset(self, chosen: np.ndarray) -> ObservedDistances:
        return ObservedDistances(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def with_others(self, others: ObservedDistances) -> ObservedDistances:
        """These, then the others."""
        names = self.__dataclass_fields__
        return ObservedDistances(*(np.concatenate([getattr(o, name) for o in (self, others)]) for name in names))


def observed_distances(keyframe: Keyframe, submap: Submap, prediction: DepthPrediction) -> ObservedDistances:
    """Pairs of mapped and predicted distance at the projections of the points that the keyframe observed.

    The prediction is sampled at the projection of the point, not at the detected keypoint: so both distances lie on one
    ray, and their 3-D difference is exactly |mapped - s predicted|. Points behind the camera, outside the image,
    where the prediction is not valid, or whose ratio of distances is zero or infinite take no part.
    """
    check_image_size(prediction.name, prediction.camera.width, prediction.camera.height, keyframe.camera)
    ids, points, _ = submap.observed_points(keyframe)
    in_camera = keyframe.in_camera(points)
    pixels, seen = keyframe.camera.project(in_camera)
    predicted, valid = sample_distance(prediction, pixels)
    mapped = np.linalg.norm(in_camera, axis=1)
    with np.errstate(divide="ignore", over="ignore"):
        proposal = mapped / predicted
    use = seen & valid & (mapped > 0) & np.isfinite(predicted) & np.isfinite(proposal) & (proposal > 0)
    rays = in_camera[use] / mapped[use, None]
    return ObservedDistances(ids[use], mapped[use], predicted[use], pixels[use], rays)


def unobserved(keyframe: Keyframe, submap: Submap, prediction: DepthPrediction) -> str:
    """Counts, by reason, of the observations that cannot be used; empty when every one can."""
    _, points, _ = submap.observed_points(keyframe)
    in_camera = keyframe.in_camera(points)
    pixels, seen = keyframe.camera.project(in_camera)
    behind = ~seen & (in_camera[:, 2] <= 0)
    counts = {
        "of points that the map does not hold": int((~submap.rows_of(keyframe.point_ids)[1]).sum()),
        "behind the camera": int(behind.sum()),
        "outside the image": int((~seen & ~behind).sum()),
        "where nothing is predicted": int((seen & ~sample_distance(prediction, pixels)[1]).sum()),
    }
    told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    return f"of {len(keyframe.point_ids)} observations {told}" if told else ""


def sample_distance(prediction: DepthPrediction, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance at pixels (n, 2), bilinear in log distance over the valid of the four neighbours, and validity (n,).

    A sample is valid when the neighbours that are carry at least half of its weight.
    """
    height, width = prediction.distance.shape
    x, y = pixels[:, 0] - 0.5, pixels[:, 1] - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    total, weight = np.zeros(len(pixels)), np.zeros(len(pixels))
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = np.clip(x0 + dx, 0, width - 1), np.clip(y0 + dy, 0, height - 1)
            known = prediction.valid[row, column]
            share = (1 - np.abs(x - (x0 + dx))) * (1 - np.abs(y - (y0 + dy))) * known
            with np.errstate(divide="ignore", invalid="ignore"):
                log_distance = np.log(np.where(known, prediction.distance[row, column], 1.0))
                total += np.where(share > 0, share * log_distance, 0)
            weight += share
    valid = weight >= 0.5
    return np.exp(total / np.where(valid, weight, 1.0)), valid
