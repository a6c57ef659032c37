"""How far a surface may be off, vertex by vertex, by what is known of it without truth.

Many looks do not make far wall right: keyframes that stand close together err together, and so do neighbouring pixels.
So looks are not counted. What speaks of the error of a vertex, as shares of the distance D of a typical inlier, is

    e = 1.7 m^.5 g^.2 u^.2 p^.3 r^.15

with m the median distance of the map's inliers around it from the surface, which bending could not close; g the reach
of the map's inliers around it, so that what lies beyond the map is known less; u the least, over the looks at it, of
its distance times the predicted uncertainty; p the lower quartile of how far distances by parallax around it, which
nothing was fitted to, are from the surface (their upper ones are mistaken patches more often than wrong wall); and r
the reach of these. To each .005 is added. Where the images say nothing, e = 1.7 m^.65 g^.35 u^.35.

It is a product because witnesses differ by the map: where all points are off by much, only a place that is worse than
others by several of them is the wrong one. The exponents were set on 48 maps of colons with truth, a third of which err
together, so that two thirds of the vertices are off by less than e.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from scipy.spatial import cKDTree

from densify.dense_map import DenseMap
from densify.judging.images import Seen
from lightdepth.prediction import DepthPrediction

_CELL = 4.0  # voxels; one vertex of each cell is looked at, and the others follow: errors change slowly along the wall
_AROUND = 12  # inliers that are asked how far they are from the surface; half as far reaches g
_SIGMA = 0.1  # of log distance, where a model does not say how uncertain it is
_EVERY = 8  # pixels; uncertainty is smooth
_HIDDEN = 3.0  # voxels by which a surface may lie before a vertex and still be the vertex's own
_FLOOR = 0.005
_BY_MAP = (1.7, 0.65, 0.35, 0.35)
_BY_BOTH = (1.7, 0.5, 0.2, 0.2, 0.3, 0.15)
"""A factor, and the exponents of m, g, u, and of p and r where the images speak."""
_PIXELS = 20  # of the images that are asked around a vertex; a quarter of them reaches r
_LEAST_PIXELS = 60
_SMOOTH = 4  # neighbouring cells, itself among them, whose geometric mean a cell is given
_FARTHEST = 2.0  # typical distances of inliers, beyond which nothing is less known


def coarse_sigma(prediction: DepthPrediction) -> np.ndarray | None:
    """Uncertainty (h, w) float16 of every eighth pixel each way, NaN where invalid; None where the model has none."""
    if prediction.uncertainty is None:
        return None
    half = _EVERY // 2
    found = np.where(prediction.valid, prediction.uncertainty, np.nan)[half::_EVERY, half::_EVERY]
    result: np.ndarray = found.astype(np.float16)
    return result


def expected_error(
    dense: DenseMap, sigmas: Mapping[str, np.ndarray], seen: Mapping[str, Seen] = MappingProxyType({})
) -> np.ndarray | None:
    """e (n,) of each vertex in map units; None where no keyframe is aligned, or the surface is empty.

    `sigmas` are the keyframes' coarse uncertainties by name, as far as they are known; `seen` what their images tell.
    """
    points = dense.submap.points[dense.judged_points()[1]]
    if not len(dense.triangles) or not len(points):
        return None
    some, cell = _one_in_each_cell(dense.vertices, _CELL * dense.voxel)
    chosen = np.zeros(len(dense.vertices), bool)
    chosen[some] = True
    own = dense.triangles[chosen[dense.triangles].any(1)]
    places, normals = dense.vertices[some], vertex_normals(dense.vertices, own)[some]
    gap, around = _nearest(points, places, _AROUND)
    typical = dense.inlier_distance
    most = _FARTHEST * typical
    met = np.median(dense.surface.distance(points)[around], 1)
    told = [met, gap[:, : _AROUND // 2][:, -1].clip(max=most), _unsure(dense, places, normals, sigmas, most)]
    by_images = _by_images(dense, places, seen, most)
    factor, *exponents = _BY_MAP if by_images is None else _BY_BOTH
    shares = np.stack(told + (by_images or []), 1) / typical + _FLOOR
    error = factor * typical * np.exp(np.log(shares) @ exponents)
    beside = _nearest(places, places, _SMOOTH)[1]
    smooth = np.exp(np.log(error)[beside].mean(1))
    result: np.ndarray = smooth[cell]
    return result


def _nearest(points: np.ndarray, places: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and rows (n, k) of the nearest points (m, 3) to places (n, 3), k being `count` where there are that
    many."""
    gap, rows = cKDTree(points).query(places, min(count, len(points)))
    return gap.reshape(len(places), -1), rows.reshape(len(places), -1)


def _by_images(dense: DenseMap, places: np.ndarray, seen: Mapping[str, Seen], most: float) -> list[np.ndarray] | None:
    """p and r of places (n, 3), r at most `most`; None where too few pixels of the images tell a distance."""
    met, off = [np.zeros((0, 3))], [np.zeros(0)]
    for keyframe in dense.submap.keyframes:
        told = seen[keyframe.name].every if keyframe.name in seen else None
        if told is not None and len(told):
            rays = told.rays @ keyframe.cam_from_map[:3, :3]
            hit = dense.surface.cast(keyframe.center, rays)
            there = np.isfinite(hit)
            met.append(keyframe.center + rays[there] * hit[there, None])
            off.append(np.abs(hit - told.mapped)[there])
    if sum(map(len, off)) < _LEAST_PIXELS:
        return None
    gap, around = _nearest(np.concatenate(met), places, _PIXELS)
    return [np.quantile(np.concatenate(off)[around], 0.25, axis=1), gap[:, _PIXELS // 4].clip(max=most)]


def _unsure(
    dense: DenseMap, places: np.ndarray, normals: np.ndarray, sigmas: Mapping[str, np.ndarray], most: float
) -> np.ndarray:
    """u (n,) of places (n, 3) on the surface, at most `most`."""
    unsure = np.full(len(places), most)
    for keyframe, alignment in zip(dense.submap.keyframes, dense.alignments, strict=True):
        if not alignment.ok:
            continue
        rays = places - keyframe.center
        distance = np.linalg.norm(rays, axis=1)
        rays /= distance[:, None] + 1e-300
        facing = -(normals * rays).sum(1)
        pixels, inside = keyframe.camera.project(keyframe.in_camera(places))
        rows = np.flatnonzero(inside & (facing > 0))
        first = dense.surface.cast(keyframe.center, rays[rows])
        rows = rows[first > distance[rows] - _HIDDEN * dense.voxel]
        own = distance[rows] * _sigma_at(sigmas.get(keyframe.name), pixels[rows])
        unsure[rows] = np.minimum(unsure[rows], own)
    return unsure


def _sigma_at(sigma: np.ndarray | None, pixels: np.ndarray) -> np.ndarray:
    if sigma is None or not sigma.size:
        return np.full(len(pixels), _SIGMA)
    column, row = (pixels // _EVERY).astype(int).T
    found = sigma[row.clip(0, sigma.shape[0] - 1), column.clip(0, sigma.shape[1] - 1)].astype(float)
    return np.where(np.isfinite(found), found, _SIGMA)


def _one_in_each_cell(vertices: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (m,) of vertices (n, 3), one for each cube of a grid that has any; and which of these is whose (n,)."""
    # Aside, because vertices lie on edges of voxels: on the border of two cubes, rounding would choose.
    cells = np.floor(vertices / side + 0.377).astype(np.int64)
    cells -= cells.min(0)
    size = cells.max(0) + 1
    names = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    _, first, cell = np.unique(names, return_index=True, return_inverse=True)
    return first, cell


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3), of triangles by their area; 0 where a vertex has no triangle."""
    from trimesh.geometry import mean_vertex_normals  # not at the top: it takes half a second, live surfaces need none
    from trimesh.triangles import cross

    result: np.ndarray = mean_vertex_normals(len(vertices), triangles, cross(vertices[triangles]))  # type: ignore[no-untyped-call]  # trimesh has no annotation for it
    return result
