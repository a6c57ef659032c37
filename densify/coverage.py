"""What of the wall was seen, how well, and what was not: confidence, weakly seen patches, holes.

A vertex has been seen well when enough keyframes saw it with enough weight (a keyframe that looks straight at a lit
wall counts 1; a slanted, dark, saturated or uncertain look counts less), and when it is expected to be off by little:
looks from afar err together, however many they are (densify.trust). A hole is a rim of the surface that runs around
missing wall; the rims at the two ends of a piece of tube, and the outer rim of a patch, are not holes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from densify.dense_map import DOUBTED, Contribution, DenseMap
from densify.fusion.rectify import FULL, SurfaceView
from densify.judging.images import Seen
from densify.trust import coarse_sigma, expected_error, vertex_normals
from lightdepth.datasets import FrameSequence
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import at_least, checked
from lightdepth.sparse_map import Keyframe


@dataclass(frozen=True)
@checked
class CoverageConfig:
    """When wall counts as seen well, and what is too small to mention."""

    views: Annotated[int, at_least(0)] = 3
    """Least number of keyframes that must have seen a piece of wall for the report to call it seen well; the surface
    stays as it is. More make less wall count as seen well."""
    weight: Annotated[float, at_least(0)] = 1.0
    """Least sum of the weights of all keyframes that see a piece of wall, for it to be called seen well: one that looks
    straight at lit wall counts 1, and a slanted, dark, saturated or uncertain view less. A larger one makes less wall
    count as seen well."""
    error: Annotated[float, at_least(0)] = DOUBTED
    """Largest expected error of a vertex for it to be called seen well, as a share of the distance of a typical inlier.
    A larger one calls more wall seen well, and more of it is wrong."""
    min_voxels: Annotated[float, at_least(0)] = 5.0
    """Side of a square, in voxels: holes and weakly seen patches smaller than this square in area are not listed in the
    report. A larger one lists fewer."""


@dataclass(frozen=True)
class Region:
    """A weakly seen patch or a hole: its area (unit²), middle (3,), and the number of the frame that is nearest to it
    among those that look towards it."""

    area: float
    center: np.ndarray
    frame: int


@dataclass(frozen=True)
class Coverage:
    """Areas in the surface's unit²: all of it, the part seen well, and the listed patches and holes, largest first."""

    area: float
    well: float
    weak: tuple[Region, ...]
    holes: tuple[Region, ...]

    @property
    def well_share(self) -> float:
        """Share of the wall, holes included, that was seen well."""
        return self.well / max(self.area + self.hole_area, 1e-300)

    def scaled(self, scale: float) -> Coverage:
        """The same in another unit."""

        def of(regions: tuple[Region, ...]) -> tuple[Region, ...]:
            return tuple(Region(r.area * scale**2, r.center * scale, r.frame) for r in regions)

        return Coverage(self.area * scale**2, self.well * scale**2, of(self.weak), of(self.holes))

    def record(self) -> dict[str, object]:
        """For run.json: areas, shares, and every listed region with its place and frame."""
        regions = {
            name: [{"area": r.area, "center": r.center.tolist(), "frame": r.frame} for r in found]
            for name, found in (("weak", self.weak), ("holes", self.holes))
        }
        areas = {"area": self.area, "well_area": self.well, "hole_area": self.hole_area, "well_share": self.well_share}
        return {**areas, **regions}

    @property
    def hole_area(self) -> float:
        return float(sum(h.area for h in self.holes))


def triangle_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    from trimesh.triangles import area  # not at the top: trimesh takes half a second, which live surfaces do not need

    result: np.ndarray = area(vertices[triangles])  # type: ignore[no-untyped-call]  # trimesh has no annotation for it
    return result


def seen_well(dense: DenseMap, config: CoverageConfig = CoverageConfig()) -> np.ndarray:
    """Which vertices (n,) were seen well."""
    assert dense.weights is not None and dense.views is not None
    well: np.ndarray = (dense.views >= config.views) & (dense.weights >= config.weight)
    if dense.expected_error is not None and dense.aligned:
        well &= dense.expected_error <= config.error * dense.inlier_distance
    return well


def coverage(dense: DenseMap, config: CoverageConfig = CoverageConfig()) -> Coverage:
    """Of a dense map that knows the weights and views of its vertices, in the unit of the map."""
    areas = triangle_areas(dense.vertices, dense.triangles)
    good = seen_well(dense, config)[dense.triangles].all(1)
    least = (config.min_voxels * dense.voxel) ** 2
    middles = dense.vertices[dense.triangles].mean(1)
    weak = []
    for patch in patches(dense.triangles, np.flatnonzero(~good)):
        area = float(areas[patch].sum())
        if area >= least:
            center = np.average(middles[patch], axis=0, weights=areas[patch])
            weak.append(Region(area, center, _frame_before(center, dense.submap.keyframes)))
    holes = [
        Region(area, center, _frame_before(center, dense.submap.keyframes))
        for area, center in find_holes(dense.vertices, dense.triangles)
        if area >= least
    ]

    def largest_first(regions: list[Region]) -> tuple[Region, ...]:
        return tuple(sorted(regions, key=lambda r: -r.area))

    return Coverage(float(areas.sum()), float(areas[good].sum()), largest_first(weak), largest_first(holes))


def contribution(view: SurfaceView, prediction: DepthPrediction) -> Contribution:
    """What a view gives to the fusion, of all pixels that its prediction calls valid."""
    fused = int(np.count_nonzero(view.weights))
    merged = float(prediction.valid.size / (len(view.weights) - 1))
    share = fused * merged / max(int(np.count_nonzero(prediction.valid)), 1)
    return Contribution(min(share, 1.0), int(view.weights.sum(dtype=int)) / max(fused, 1) / FULL)


def looked_at(dense: DenseMap, keyframe: Keyframe, given: Contribution, stride: int = 8) -> Contribution:
    """The contribution of a keyframe with what it looks at filled in, from every stride-th pixel each way."""
    assert dense.confidence is not None and dense.views is not None
    rays, valid = (a[stride // 2 :: stride, stride // 2 :: stride] for a in keyframe.camera.rays())
    triangles = dense.surface.meet(keyframe.center, rays[valid] @ keyframe.cam_from_map[:3, :3])[1]
    corners = dense.triangles[triangles[triangles >= 0]]
    if not len(corners):
        return given
    return replace(given, confidence=float(dense.confidence[corners].mean()), views=float(dense.views[corners].mean()))


@dataclass(frozen=True, eq=False)
class Given:
    """What a keyframe gave to the fusion, and the coarse uncertainty (h, w) of its prediction, where it has one."""

    contribution: Contribution
    sigma: np.ndarray | None

    @classmethod
    def of(cls, view: SurfaceView, prediction: DepthPrediction) -> Given:
        return cls(contribution(view, prediction), coarse_sigma(prediction))


def with_contributions(
    dense: DenseMap, given: Mapping[str, Given], seen: Mapping[str, Seen] = MappingProxyType({})
) -> DenseMap:
    """The dense map with the error that is expected of its vertices, with what each of its aligned keyframes gave, by
    name, and what it looks at. `seen` is what the keyframes' images tell of distances, as far as they were asked."""
    sigmas = {name: g.sigma for name, g in given.items() if g.sigma is not None}
    dense = replace(dense, expected_error=expected_error(dense, sigmas, seen))
    own = [k for k in dense.submap.keyframes if k.name in given]
    return replace(dense, contributions={k.name: looked_at(dense, k, given[k.name].contribution) for k in own})


def seen_share(dense: DenseMap, frames: FrameSequence, stride: int = 8) -> float:
    """Share of the aligned keyframes' masked pixels, every stride-th each way, whose rays meet the surface."""
    hits = total = 0
    for keyframe in dense.aligned_keyframes:
        rows, columns = frames.of_keyframe(keyframe).valid[::stride, ::stride].nonzero()
        rays = keyframe.camera.rays()[0][::stride, ::stride][rows, columns]
        hits += int(np.isfinite(dense.surface.cast(keyframe.center, rays @ keyframe.cam_from_map[:3, :3])).sum())
        total += len(rays)
    return hits / max(total, 1)


def find_holes(vertices: np.ndarray, triangles: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Area and middle (3,) of each hole in a surface whose triangles turn their front to the cameras.

    With A the area vector of a rim, run through with the surface on its left, and n the mean normal of the surface
    along it: around missing wall, A points against n; at the outer rim of a patch, with it; and at the open end of a
    tube the normals, which point inwards from all sides, cancel.
    """
    normals = vertex_normals(vertices, triangles)
    found = []
    for rim in rims(triangles):
        points, middle = vertices[rim], vertices[rim].mean(0)
        spokes = points - middle
        fans = 0.5 * np.cross(spokes, np.roll(spokes, -1, 0))
        steps = np.linalg.norm(np.roll(points, -1, 0) - points, axis=1) + 1e-300
        mean = np.average(normals[rim], axis=0, weights=steps)
        if np.linalg.norm(mean) > 0.5 and fans.sum(0) @ mean < 0:
            found.append((float(np.linalg.norm(fans, axis=1).sum()), middle))
    return found


def rims(triangles: np.ndarray) -> list[np.ndarray]:
    """Closed loops of the edges that only one triangle has, each as vertices in the direction of its triangle."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    count = int(triangles.max(initial=-1)) + 1
    backward = np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])
    following: dict[int, list[int]] = {}
    for a, b in edges[~backward].tolist():
        following.setdefault(a, []).append(b)
    loops = []
    while following:
        start = vertex = next(iter(following))
        loop = []
        while vertex in following:
            loop.append(vertex)
            ends = following[vertex]
            after = ends.pop()
            if not ends:
                del following[vertex]
            vertex = after
            if vertex == start:
                break
        if len(loop) > 2:
            loops.append(np.array(loop))
    return loops


def patches(triangles: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """Some rows of triangles (m, 3), one array for each part that hangs together by vertices."""
    if not len(rows):
        return []
    corners = triangles[rows]
    count = int(triangles.max()) + 1
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    part = connected_components(graph, directed=False)[1][corners[:, 0]]
    order = np.argsort(part, kind="stable")
    return np.split(rows[order], np.flatnonzero(np.diff(part[order])) + 1)


def _frame_before(point: np.ndarray, keyframes: Sequence[Keyframe]) -> int:
    """The frame whose camera is nearest to a point in front of it; the nearest of all where none looks that way."""
    distance = np.array([np.linalg.norm(k.center - point) for k in keyframes])
    behind = np.array([k.in_camera(point[None])[0, 2] <= 0 for k in keyframes])
    return keyframes[int(np.argmin(distance + np.where(behind & ~behind.all(), distance.max() + 1, 0)))].number
