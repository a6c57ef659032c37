"""The shape of a surface: FPFH features, and ICP with scale, point to plane both ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from densify.dense_map import DenseMap
from densify.joining.join import MergeConfig
from densify.similarity import Similarity
from lightdepth import native
from lightdepth.robust import robust_weights


@dataclass(frozen=True)
class Shape:
    """A surface in units of its reach: points (n, 3), normals (n, 3), FPFH features (n, 33), and the tone (n,), which
    is how much brighter a point is than its surroundings."""

    points: np.ndarray
    normals: np.ndarray
    features: np.ndarray
    tone: np.ndarray
    tree: cKDTree


def shape_of(dense: DenseMap, unit: float, config: MergeConfig) -> Shape:
    """The shape of a surface whose reach is `unit` map units."""
    o3d = native.open3d()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(dense.vertices / unit), o3d.utility.Vector3iVector(dense.triangles)
    )
    mesh.compute_vertex_normals()
    cloud = o3d.geometry.PointCloud(mesh.vertices)
    cloud.normals, cloud.colors = mesh.vertex_normals, o3d.utility.Vector3dVector(dense.colors)
    brightness = np.log(dense.colors.mean(1) + 0.02)
    fine = cKDTree(dense.vertices / unit)
    cloud = cloud.voxel_down_sample(config.grain)
    points = np.asarray(cloud.points)
    search = o3d.geometry.KDTreeSearchParamHybrid(config.feature_radius, 100)
    features = np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data).T
    normals = np.asarray(cloud.normals)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-9)
    near = fine.query(points, k=min(64, len(dense.vertices)))[1]
    tone = brightness[near[:, :4]].mean(1) - brightness[near].mean(1)
    return Shape(points, normals, features, tone, cKDTree(points))


def icp(similarity: Similarity, to: Shape, own: Shape) -> Similarity:
    """ICP with scale: the Sim(3) near the given one with the least robust distance between points of either surface
    and the tangent planes of the other. Both ways, since one way alone would shrink."""
    for reach in (0.2, 0.1, 0.05):
        for _ in range(15):
            moved, turned = similarity.apply(own.points), own.normals @ similarity.rotation.T
            there = to.tree.query(moved, distance_upper_bound=reach)
            back = own.tree.query(similarity.inverse().apply(to.points), distance_upper_bound=reach / similarity.scale)
            met, met_back = np.isfinite(there[0]), np.isfinite(back[0])
            i, j = there[1][met], back[1][met_back]
            p, q = np.concatenate([moved[met], moved[j]]), np.concatenate([to.points[i], to.points[met_back]])
            n = np.concatenate([to.normals[i], turned[j]])
            facing = (n * np.concatenate([turned[met], to.normals[met_back]])).sum(1) > 0.5
            p, q, n = p[facing], q[facing], n[facing]
            if len(p) < 20:
                return similarity
            off = ((q - p) * n).sum(1)
            weight = robust_weights(4 * off / reach, "geman_mcclure")
            middle = p.mean(0)
            arms = p - middle
            slopes = np.concatenate([np.cross(arms, n), n, (arms * n).sum(1)[:, None]], 1)
            normal = (slopes * weight[:, None]).T @ slopes
            step = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(7), (slopes * weight[:, None]).T @ off)
            turn, grow = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
            similarity = Similarity(grow, turn, middle + step[3:6] - grow * turn @ middle) @ similarity
            if np.abs(step).max() < 1e-4:
                break
    return similarity


def meeting_points(similarity: Similarity, to: Shape, own: Shape, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points of either surface that lie on each other."""
    distance, there = to.tree.query(similarity.apply(own.points), distance_upper_bound=reach)
    met = np.isfinite(distance)
    return there[met], np.flatnonzero(met)


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Pearson's, of values (n,)."""
    a, b = one - one.mean(), other - other.mean()
    return float((a * b).sum() / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12))
