"""How far a surface may be off, vertex by vertex, by what is known of it without truth.

Many looks do not make far wall right: keyframes that stand close together err together, and so do neighbouring pixels.
So looks are not counted as witnesses of one another. What speaks of the error of a vertex is

    e^2 = (.65 m)^2 + (.055 g)^2 + (.15 u)^2,    times 1 + .65 / W

with m the median distance of the map's inliers around it from the surface, which bending could not close; g the reach
of the map's inliers around it, so that what lies beyond the map is known less; u the least, over the looks at it, of
its distance times the predicted uncertainty; and W the looks at it, straight ones from near being worth 1. All lengths
in map units. The numbers were set on colons with truth (28 surfaces), so that two thirds of the vertices are off by
less than e; m, g and u are those of the map at hand, so e grows with a worse map, endoscope or model.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from densify.dense_map import DenseMap
from lightdepth.prediction import DepthPrediction

_CELL = 4.0  # voxels; one vertex of each cell is looked at, and the others follow: errors change slowly along the wall
_AROUND = 12  # inliers that are asked how far they are from the surface; half as far reaches g
_SIGMA = 0.1  # of log distance, where a model does not say how uncertain it is
_EVERY = 8  # pixels; uncertainty is smooth
_HIDDEN = 3.0  # voxels by which a surface may lie before a vertex and still be the vertex's own
_LEAST_LOOKS = 0.05
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


def expected_error(dense: DenseMap, sigmas: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """e (n,) of each vertex in map units; None where no keyframe is aligned, or the surface is empty.

    `sigmas` are the keyframes' coarse uncertainties by name, as far as they are known.
    """
    points = dense.submap.points[dense.judged_points()[1]]
    if not len(dense.triangles) or not len(points):
        return None
    some, cell = _one_in_each_cell(dense.vertices, _CELL * dense.voxel)
    chosen = np.zeros(len(dense.vertices), bool)
    chosen[some] = True
    own = dense.triangles[chosen[dense.triangles].any(1)]
    places, normals = dense.vertices[some], vertex_normals(dense.vertices, own)[some]
    gap, around = cKDTree(points).query(places, min(_AROUND, len(points)))
    gap, around = gap.reshape(len(places), -1), around.reshape(len(places), -1)
    most = _FARTHEST * dense.inlier_distance
    reach = gap[:, : _AROUND // 2][:, -1].clip(max=most)
    met = np.median(dense.surface.distance(points)[around], 1)
    looks, unsure = _looks(dense, places, normals, sigmas, most)
    least = 1e-3 * dense.inlier_distance
    error = np.sqrt((0.65 * met) ** 2 + (0.055 * reach) ** 2 + (0.15 * unsure) ** 2 + least**2)
    error *= 1 + 0.65 / looks.clip(min=_LEAST_LOOKS)
    beside = cKDTree(places).query(places, min(_SMOOTH, len(places)))[1].reshape(len(places), -1)
    smooth = np.exp(np.log(error)[beside].mean(1))
    result: np.ndarray = smooth[cell]
    return result


def _looks(
    dense: DenseMap, places: np.ndarray, normals: np.ndarray, sigmas: Mapping[str, np.ndarray], most: float
) -> tuple[np.ndarray, np.ndarray]:
    """W and u of places (n, 3) on the surface, u at most `most`.

    A look counts cos(slant) / (1 + (d / D)^4), D being how far nine in ten inliers of its keyframe are: beyond them
    its depth is an extrapolation, and any number of such looks is worth little.
    """
    looks, unsure = np.zeros(len(places)), np.full(len(places), most)
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
        looks[rows] += facing[rows] / (1 + (distance[rows] / alignment.range_90) ** 4)
        own = distance[rows] * _sigma_at(sigmas.get(keyframe.name), pixels[rows])
        unsure[rows] = np.minimum(unsure[rows], own)
    return looks, unsure


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
