"""Errors against truth: trajectory (RMS ATE), surface accuracy, depth per frame; and the gap between two surfaces.

After the densification paper: the Sim(3) that minimises the ATE between map and true camera centres carries the map to
millimetres; accuracy is the distance from each point of a model to its closest point of the true cloud, which is made
by unprojecting true distance at true poses. RMS and median (MedA) in mm.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from densify.dense_map import DenseMapFiles, Surface
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.geometry import depth_from_distance
from lightdepth.prediction import DepthPrediction


@dataclass(frozen=True)
class Similarity:
    """x -> scale · rotation x + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.translation


def fit_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """The Sim(3) with the least squared error from source to target points (n, 3) (Umeyama 1991).

    Raises InputError when the points cannot fix it: fewer than three, or all on a line.
    """
    if len(source) < 3:
        raise InputError(f"{len(source)} common poses; a similarity needs at least 3")
    s, t = source - source.mean(0), target - target.mean(0)
    for name, points in (("map", s), ("true", t)):
        spread = np.linalg.svd(points, compute_uv=False)
        if spread[1] < 1e-3 * max(spread[0], 1e-300):
            raise InputError(f"the {name} camera centres lie on a line (or in one place): the rotation cannot be found")
    u, d, vt = np.linalg.svd(t.T @ s / len(s))
    sign = np.array([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / (s**2).sum() * len(s))
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def rms_ate(source: np.ndarray, target: np.ndarray, similarity: Similarity) -> float:
    """Root mean square distance of camera centres (n, 3) after alignment."""
    return float(np.sqrt(((similarity.apply(source) - target) ** 2).sum(1).mean()))


@dataclass(frozen=True)
class Accuracy:
    """Distance [mm] from each of `points` model points to the closest point of the true cloud."""

    points: int
    rms_mm: float
    median_mm: float


def accuracy(model: np.ndarray, tree: cKDTree) -> Accuracy:
    """Of model points (n, 3) [mm] against the true cloud. Raises InputError when there is no model."""
    if not len(model):
        raise InputError("the model has no points")
    distance, _ = tree.query(model, workers=-1)
    return Accuracy(len(model), float(np.sqrt((distance**2).mean())), float(np.median(distance)))


def true_cloud(frames: Iterable[Frame], stride: int = 2, max_points: int = 3_000_000) -> np.ndarray:
    """World points (n, 3) [mm] of every stride-th pixel of frames with true distance and pose."""
    clouds = []
    for frame in frames:
        if frame.true_distance is None or frame.true_world_from_cam is None:
            continue
        rays = frame.camera.rays()[0][::stride, ::stride]
        distance = frame.true_distance[::stride, ::stride]
        known = (distance > 0) & np.isfinite(distance) & frame.valid[::stride, ::stride]
        points = rays[known] * distance[known, None]
        pose = frame.true_world_from_cam
        clouds.append(points @ pose[:3, :3].T + pose[:3, 3])
    if not clouds or not sum(map(len, clouds)):
        raise InputError("no frame has both valid true distance and a true pose; there is no truth to compare with")
    cloud = np.concatenate(clouds)
    return cloud[:: -(-len(cloud) // max_points)]


def evaluate_map(
    centers: np.ndarray, true_centers: np.ndarray, clouds: Mapping[str, np.ndarray], tree: cKDTree
) -> dict[str, Any]:
    """Trajectory and surface errors of one submap: camera centres (n, 3) in the map and in truth [mm], clouds of map
    points by name ("sparse", "dense" ...), the true cloud as a tree. A cloud without points gives None."""
    similarity = fit_similarity(centers, true_centers)
    result: dict[str, Any] = {
        "keyframes": len(centers),
        "rms_ate_mm": rms_ate(centers, true_centers, similarity),
        "mm_per_unit": similarity.scale,
    }
    for name, cloud in clouds.items():
        result[name] = asdict(accuracy(similarity.apply(cloud), tree)) if len(cloud) else None
    return result


def evaluate_depth(
    prediction: DepthPrediction, frame: Frame, max_depth_mm: float = 100.0, alignment: str = "median"
) -> dict[str, float]:
    """Depth errors [mm] of one frame, over pixels valid in truth, prediction and mask with 0 < depth < max_depth_mm.

    Raises InputError when no pixel of the truth is valid.
    """
    import torch

    from lightdepth.metrics import depth_errors  # brings torchmetrics, which takes seconds to import

    if frame.true_distance is None:
        raise InputError(f"{frame.name}: no true depth")
    if frame.true_distance.shape != prediction.distance.shape:
        h, w = prediction.distance.shape
        raise InputError(
            f"{frame.name}: the prediction is {w}x{h}, the truth {frame.camera.width}x{frame.camera.height}; "
            "predict at the size of the truth"
        )
    ray_z = frame.camera.rays()[0][..., 2]
    truth = depth_from_distance(frame.true_distance, ray_z)
    valid = frame.valid & np.isfinite(truth) & (truth > 0) & (truth < max_depth_mm)
    if not valid.any():
        raise InputError(f"{frame.name}: the true depth is invalid everywhere (0, or at least {max_depth_mm:g} mm)")
    common = valid & prediction.valid
    predicted = depth_from_distance(prediction.distance, ray_z)
    p, q, v = (torch.from_numpy(np.ascontiguousarray(a)) for a in (predicted, truth, common))
    errors = depth_errors(p, q, v, alignment)
    if errors is None:
        raise InputError(f"{frame.name}: the prediction is valid nowhere where the truth is")
    values = {f"{name}_{alignment}": float(value) for name, value in errors.items()}
    return {**values, "pixels": int(common.sum()), "share_of_truth": float(common.sum() / valid.sum())}


@dataclass(frozen=True)
class Gap:
    """|d1 - d2| / d1 along common rays, d the distances from the camera to two surfaces."""

    rays: int
    median: float
    p90: float
    both_share: float


def surface_gap(first: DenseMapFiles, second: DenseMapFiles, second_from_first: Similarity, stride: int = 16) -> Gap:
    """How far two surfaces are apart, as seen by the keyframes that the maps share (all of the first map's when they
    share none), where both see the tissue."""
    surfaces = Surface(first.vertices, first.triangles), Surface(second.vertices, second.triangles)
    rays, valid = first.camera.rays()
    rays = rays[::stride, ::stride][valid[::stride, ::stride]]
    shared = np.isin(first.numbers, second.numbers)
    hits: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for pose in first.map_from_cam[shared if shared.any() else slice(None)]:
        directions = rays @ pose[:3, :3].T
        hits[0].append(surfaces[0].cast(pose[:3, 3], directions))
        origin = second_from_first.apply(pose[None, :3, 3])[0]
        in_second = surfaces[1].cast(origin, directions @ second_from_first.rotation.T)
        hits[1].append(in_second / second_from_first.scale)
    one, two = (np.concatenate(h) for h in hits)
    both = np.isfinite(one) & np.isfinite(two)
    if not both.any():
        raise InputError("no ray meets both surfaces; is the Sim(3) right (second = scale · R first + t)?")
    gap = np.abs(one[both] - two[both]) / one[both]
    either = np.isfinite(one) | np.isfinite(two)
    return Gap(int(both.sum()), float(np.median(gap)), float(np.quantile(gap, 0.9)), float(both.sum() / either.sum()))
