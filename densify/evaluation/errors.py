"""Errors against truth: trajectory (ATE), surface (accuracy, completeness), depth per frame; the gap of two surfaces.

After the densification paper: the Sim(3) that minimises the ATE between map and true camera centres carries the map to
millimetres; accuracy is the distance from each point of a model to its closest point of the true cloud, which is made
by unprojecting true distance at true poses. RMS and median (MedA) in mm. Completeness is the way back: from each point
of the true cloud, one in each small cube, to the model's closest point.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from densify.dense_map import DenseMapFiles, Surface
from densify.evaluation.records import DistanceFigures, Gap, SurfaceFigures
from densify.evaluation.smoothness import NO_EDGES, Edges, edges
from densify.similarity import Similarity
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.geometry import depth_from_distance
from lightdepth.prediction import DepthPrediction

CUBE_MM = 0.2
"""The true cloud keeps one point in each cube of this size."""


def ate(source: np.ndarray, target: np.ndarray, similarity: Similarity) -> np.ndarray:
    """Distance (n,) of camera centres (n, 3) after alignment."""
    result: np.ndarray = np.linalg.norm(similarity.apply(source) - target, axis=1)
    return result


def rms_ate(source: np.ndarray, target: np.ndarray, similarity: Similarity) -> float:
    """Root mean square distance of camera centres (n, 3) after alignment."""
    return rms(ate(source, target, similarity))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def sideways_agreement(source: np.ndarray, target: np.ndarray, similarity: Similarity) -> float:
    """Correlation, at most 1, of the aligned centres (n, 3) with the true ones across the true line of travel.

    Along a straight line of travel only noise is left across it. Then the Sim(3) may turn the map about the line by any
    angle at the same ATE, and the distances of its surface are those of chance.
    """
    moved, true = similarity.apply(source), target - target.mean(0)
    moved = moved - moved.mean(0)
    line = np.linalg.svd(true, full_matrices=False)[2][0]
    across = [points - np.outer(points @ line, line) for points in (moved, true)]
    size = np.linalg.norm(across[0]) * np.linalg.norm(across[1])
    return float((across[0] * across[1]).sum() / max(size, 1e-300))


def closest(points: np.ndarray, tree: cKDTree) -> np.ndarray:
    """Distance (n,) from each point (n, 3) to the closest point of the tree. Raises InputError without points."""
    if not len(points):
        raise InputError("the model", "it has no points", "expected at least one")
    result: np.ndarray = tree.query(points, workers=-1)[0]
    return result


def thinned(points: np.ndarray, cube: float) -> np.ndarray:
    """One point in each cube of this size: the one closest to the cube's centre, in the order of the cubes.

    It does not depend on the order of the points (n, 3), nor on how often one is among them.
    """
    if not len(points):
        return points
    cell = np.floor(points / cube)
    if not np.abs(cell).max() < 1 << 20:  # three numbers of 21 bits make a key
        raise InputError("the true surface", f"it reaches {np.abs(points).max() / 1000:.0f} m", "are its poses in mm?")
    off = np.square(points / cube - cell - 0.5).sum(1)
    x, y, z = cell.astype(np.int64).T + (1 << 20)
    key = (x << 42) | (y << 21) | z
    order = np.lexsort((off, key))
    first = np.concatenate([[True], np.diff(key[order]) > 0])
    result: np.ndarray = points[order[first]]
    return result


@dataclass(frozen=True)
class TrueSurface:
    """The wall [mm] in the true world: a cloud (n, 3), with how it was sampled, and a mesh where there is one."""

    cloud: np.ndarray
    sampling: str
    mesh: Surface | None = None
    mesh_source: str = ""
    edges: Edges = NO_EDGES
    """of the mesh, or of the one that was there"""

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.cloud)

    @cached_property
    def spacing_mm(self) -> float:
        """Median distance between neighbouring points of the cloud, of some thousand of them: no accuracy below about
        half of it can be told from none."""
        some = self.cloud[:: max(1, len(self.cloud) // 5000)]
        return float(np.median(self.tree.query(some, k=2)[0][:, 1])) if len(self.cloud) > 1 else float("inf")


def true_cloud(frames: Iterable[Frame], stride: int = 2, cube: float = CUBE_MM) -> np.ndarray:
    """World points (n, 3) [mm] of every stride-th pixel of frames with true distance and pose, one in each cube.

    Raises InputError when there is none."""
    clouds, waiting = [np.zeros((0, 3))], 0
    for frame in frames:
        points, known = true_points(frame, stride)
        clouds.append(thinned(points[known], cube))
        waiting += len(clouds[-1])
        if waiting > 5_000_000:  # neighbouring frames see the same wall: keep memory flat
            clouds, waiting = [thinned(np.concatenate(clouds), cube)], 0
    cloud = thinned(np.concatenate(clouds), cube)
    if not len(cloud):
        raise InputError(
            "the truth", "no frame has both valid true distance and a true pose", "give a sequence that has both"
        )
    return cloud


def true_points(frame: Frame, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """World points (h, w, 3) [mm] of every stride-th pixel each way, and which are known (h, w)."""
    rays = frame.camera.rays()[0][::stride, ::stride]
    if frame.true_distance is None or frame.true_world_from_cam is None:
        return np.zeros(rays.shape), np.zeros(rays.shape[:2], bool)
    check_numbers(frame)
    distance = frame.true_distance[::stride, ::stride].astype(np.float64)
    known = (distance > 0) & frame.valid[::stride, ::stride]
    pose = frame.true_world_from_cam
    points = rays * np.where(known, distance, 0)[..., None]
    return points @ pose[:3, :3].T + pose[:3, 3], known


def depth_triangles(frame: Frame, stride: int, jump: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """What a frame's true distance shows as a mesh: vertices (n, 3) [mm] and triangles (m, 3), without those whose
    corners' distances from the camera differ by more than `jump` of the least: they would span folds."""
    points, known = true_points(frame, stride)
    height, width = known.shape
    index = np.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    if frame.true_distance is None:
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    distance = frame.true_distance[::stride, ::stride].ravel()[triangles]
    whole = known.ravel()[triangles].all(1)
    triangles = triangles[whole & (distance.max(1) <= (1 + jump) * distance.min(1))]
    used, flat = np.unique(triangles, return_inverse=True)
    return points.reshape(-1, 3)[used], flat.reshape(-1, 3)


@dataclass(frozen=True)
class SurfaceErrors:
    """Distances [mm]: from each model point to the closest true point, to the true mesh where there is one, and from
    each true point to the closest model point. All (n,) of their own length."""

    accuracy: np.ndarray
    to_mesh: np.ndarray | None
    completeness: np.ndarray
    edges: Edges = NO_EDGES
    """of the model's mesh, where it has one"""

    def summary(self, thresholds_mm: Sequence[float]) -> SurfaceFigures:
        """Figures for the report. Precision, recall: shares of model and true points within each threshold."""
        precision, recall = (
            {f"{t:g}mm": float((distance <= t).mean()) for t in thresholds_mm}
            for distance in (self.accuracy, self.completeness)
        )
        accuracy = DistanceFigures.of(self.accuracy)
        return SurfaceFigures(
            points=len(self.accuracy),
            rms_mm=accuracy.rms_mm,
            median_mm=accuracy.median_mm,
            p90_mm=accuracy.p90_mm,
            to_mesh=None if self.to_mesh is None else DistanceFigures.of(self.to_mesh),
            completeness=DistanceFigures.of(self.completeness),
            precision=precision,
            recall=recall,
            f_score={key: _harmonic_mean(precision[key], recall[key]) for key in precision},
            chamfer_mm=float(self.accuracy.mean() + self.completeness.mean()) / 2,
            sharp_edges=self.edges.share,
        )


def _harmonic_mean(p: float, r: float) -> float:
    return 2 * p * r / (p + r) if p + r else 0.0


def surface_errors(model: np.ndarray, truth: TrueSurface, triangles: np.ndarray | None = None) -> SurfaceErrors:
    """Of model points (n, 3) [mm], with triangles (m, 3) over them where it is a mesh. Raises InputError when there are
    no points."""
    return SurfaceErrors(
        accuracy=closest(model, truth.tree),
        to_mesh=None if truth.mesh is None else truth.mesh.distance(model),
        completeness=closest(truth.cloud, cKDTree(model)),
        edges=NO_EDGES if triangles is None else edges(model, triangles),
    )


def pooled(errors: Sequence[SurfaceErrors]) -> SurfaceErrors:
    """Of the models together: all of their points, and for each true point the closest of any."""
    meshes = [e.to_mesh for e in errors if e.to_mesh is not None]
    return SurfaceErrors(
        np.concatenate([e.accuracy for e in errors]),
        np.concatenate(meshes) if meshes else None,
        np.min([e.completeness for e in errors], 0),
        Edges(sum(e.edges.sharp for e in errors), sum(e.edges.all for e in errors)),
    )


@dataclass(frozen=True)
class ComparedDepth:
    """One frame's predicted and true depth (H, W) [mm, unless the prediction is up to scale], where both are to be
    compared (H, W), and the share of the image and of the valid truth that these pixels are."""

    predicted: np.ndarray
    truth: np.ndarray
    valid: np.ndarray
    share_of_image: float
    share_of_truth: float

    def errors(self, alignments: Iterable[str]) -> dict[str, float]:
        """Every error of lightdepth.metrics under every alignment, by NAME_ALIGNMENT."""
        import torch

        from lightdepth.metrics import depth_errors  # brings torchmetrics, which takes seconds to import

        p, q, v = (torch.from_numpy(np.ascontiguousarray(a)) for a in (self.predicted, self.truth, self.valid))
        found: dict[str, float] = {}
        for alignment in alignments:
            errors = depth_errors(p, q, v, alignment)
            assert errors is not None
            found |= {f"{name}_{alignment}": float(value) for name, value in errors.items()}
        return found

    def within(self, edges_mm: np.ndarray, alignment: str) -> np.ndarray:
        """Share of the pixels with |p - q| of at most each edge (k,), after alignment."""
        import torch

        from lightdepth.metrics import aligned, compared

        p, q = compared(*(torch.from_numpy(np.ascontiguousarray(a)) for a in (self.predicted, self.truth, self.valid)))
        error = np.sort((aligned(p, q, alignment) - q).abs().numpy())
        return np.searchsorted(error, edges_mm, "right") / len(error)


def check_numbers(frame: Frame) -> None:
    """Raises InputError where the true distance is no number: readers give 0 for what is unknown."""
    bad = 0 if frame.true_distance is None else int((~np.isfinite(frame.true_distance)).sum())
    if bad:
        raise InputError(frame.name, f"the true depth is NaN or infinite at {bad} pixels", "expected 0 where unknown")


def true_depth(frame: Frame, max_depth_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) [mm] along the axis, and where it is known, in the mask and within (0, max_depth_mm) (H, W)."""
    assert frame.true_distance is not None
    check_numbers(frame)
    truth = depth_from_distance(frame.true_distance, frame.camera.rays()[0][..., 2])
    return truth, frame.valid & (truth > 0) & (truth < max_depth_mm)


def compare_depth(prediction: DepthPrediction, frame: Frame, max_depth_mm: float = 100.0) -> ComparedDepth:
    """A prediction against its frame's truth. Raises InputError where sizes differ, there is no truth to compare with,
    or the prediction has no number at a pixel that it calls valid."""
    if frame.true_distance is None:
        raise InputError(frame.name, "no true depth", "give a sequence that has it")
    if frame.true_distance.shape != prediction.distance.shape:
        h, w = prediction.distance.shape
        raise InputError(
            frame.name,
            f"the prediction is {w}x{h}, the truth {frame.camera.width}x{frame.camera.height}",
            "predict at the size of the truth",
        )
    bad = int((prediction.valid & ~np.isfinite(prediction.distance)).sum())
    if bad:
        raise InputError(
            frame.name,
            f"the predicted depth is NaN or infinite at {bad} pixels that are marked valid",
            "expected numbers there",
        )
    truth, known = true_depth(frame, max_depth_mm)
    if not known.any():
        raise InputError(
            frame.name,
            f"the true depth is invalid everywhere (0, or at least {max_depth_mm:g} mm)",
            "expected mm; leave the frame out",
        )
    predicted = depth_from_distance(prediction.distance, frame.camera.rays()[0][..., 2])
    common = known & prediction.valid & (predicted > 0)
    if not common.any():
        raise InputError(frame.name, "the prediction is valid nowhere where the truth is", "leave the frame out")
    return ComparedDepth(predicted, truth, common, float(common.mean()), float(common.sum() / known.sum()))


def evaluate_depth(
    prediction: DepthPrediction, frame: Frame, max_depth_mm: float = 100.0, alignments: Iterable[str] | None = None
) -> dict[str, float]:
    """Depth errors [mm] of one frame, over pixels valid in truth, prediction and mask with 0 < depth < max_depth_mm,
    under all alignments where none are chosen. Raises InputError as `compare_depth` does."""
    from lightdepth.metrics import ALIGNMENTS

    found = compare_depth(prediction, frame, max_depth_mm)
    counts = {"pixels": int(found.valid.sum()), "share_of_image": found.share_of_image}
    return {**found.errors(alignments or ALIGNMENTS), **counts, "share_of_truth": found.share_of_truth}


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
        raise InputError("the two surfaces", "no ray meets both", "is the Sim(3) right (second = scale · R first + t)?")
    gap = np.abs(one[both] - two[both]) / one[both]
    either = np.isfinite(one) | np.isfinite(two)
    return Gap(int(both.sum()), float(np.median(gap)), float(np.quantile(gap, 0.9)), float(both.sum() / either.sum()))
