"""What a dense map shows in three dimensions: its surface, the points that it rests on, and its cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.coverage import seen_well
from densify.dense_map import GREEN, GREY, RED, DenseMap, DenseMapFiles, KeyframeRow
from densify.evaluation.pictures import error_layer
from lightdepth.camera import CameraModel
from lightdepth.reporting.figures import (
    PLAIN,
    level_colors,
    outside_axes,
)
from lightdepth.reporting.scene import Cloud, Layer, Pose, Scene, Surface, bytes_of

SEEN_WELL, SEEN_WEAKLY, DOUBTFUL = (0.45, 0.75, 0.55), (0.95, 0.6, 0.15), (0.8, 0.15, 0.15)
TRUSTED = 0.2
"""Confidence below which wall is red: it is expected to be off by twice what is doubted."""
MANY = 9
"""Keyframes that saw a piece of wall from which on its colour stays the same."""

SURFACE_FILES = {
    "map_*/mesh.*": "the surface",
    "*/cloud.ply": "its vertices alone",
    "*/sparse.ply": "the points of the map, green used, red found wrong",
    "*/keyframes.csv": "scale, inliers and reasons for each keyframe",
    "*/trajectory.tum": "the path of the camera",
    "*/camera.json": "the camera",
}
"""What the files of a surface are, by pattern."""

KEYFRAMES = "keyframes"
"""The folder in a run with a row of small pictures for each keyframe."""
TRIANGLES = Scene.most
"""The most triangles that are shown of a surface."""


def surface_of(title: str, dense: DenseMap, distance: np.ndarray | None = None) -> Surface:
    """All that is shown of a dense map. `distance` (n,) [mm] is that of its vertices from the truth, where there is
    any."""
    judged, inlier = dense.judged_points()
    points = dense.submap.points
    clouds = (
        Cloud("Points used", points[judged & inlier], GREEN),
        Cloud("Points found wrong", points[judged & ~inlier], RED),
        Cloud("Points not judged", points[~judged], GREY),
    )
    keyframes = dense.submap.keyframes
    layers = [*_looks(dense.colors), *_confidence(dense.confidence)]
    layers += _seen(seen_kinds(dense))
    return Surface(
        title,
        dense.vertices,
        dense.triangles,
        (*layers, *_error(distance, len(dense.vertices))),
        tuple(cloud for cloud in clouds if len(cloud.points)),
        tuple(Pose(k.name, k.cam_from_map, a.ok) for k, a in zip(keyframes, dense.alignments, strict=True)),
        tangents(keyframes[len(keyframes) // 2].camera),
        outside_axes(dense.vertices) if len(dense.vertices) else np.eye(3),
    )


def surface_of_files(
    title: str, read: DenseMapFiles, keyframes: Sequence[KeyframeRow], distance: np.ndarray | None = None
) -> Surface:
    """As `surface_of`, for what was read back from a map folder; also by how many keyframes saw it."""
    wrong = np.zeros(len(read.sparse), bool) if read.sparse_wrong is None else read.sparse_wrong
    clouds = (
        Cloud("Points used", read.sparse[read.sparse_inlier], GREEN),
        Cloud("Points found wrong", read.sparse[wrong], RED),
        Cloud("Points not judged", read.sparse[~(read.sparse_inlier | wrong)], GREY),
    )
    colors = np.broadcast_to(bytes_of(np.array([PLAIN])), (len(read.vertices), 3))
    layers = [*_looks((colors if read.colors is None else read.colors) / 255), *_confidence(read.confidence)]
    layers += _seen(read.seen)
    if read.views is not None:
        marks = ((0.0, "seen by 1 keyframe"), (0.5, f"{(MANY + 1) // 2}"), (1.0, f"{MANY} and more"))
        steps = np.clip((read.views - 1) / (MANY - 1), 0, 1)
        layers.append(
            Layer("Keyframes that saw it", bytes_of(steps), bytes_of(level_colors(np.linspace(0, 1, 256))), marks)
        )
    poses = zip(keyframes, read.map_from_cam, strict=True)
    return Surface(
        title,
        read.vertices,
        read.triangles,
        (*layers, *_error(distance, len(read.vertices))),
        tuple(cloud for cloud in clouds if len(cloud.points)),
        tuple(Pose(row.name, np.linalg.inv(pose), row.used) for row, pose in poses),
        tangents(read.camera),
        outside_axes(read.vertices) if len(read.vertices) else np.eye(3),
    )


def _looks(colors: np.ndarray) -> list[Layer]:
    """The colours of the images (n, 3) in [0, 1], and the shape without them."""
    return [
        Layer("Of the images", bytes_of(colors)),
        Layer("Shape alone", None, bytes_of(np.array([PLAIN]))),
    ]


def _confidence(confidence: np.ndarray | None) -> list[Layer]:
    """Where it is known."""
    if confidence is None:
        return []
    marks = ((0.0, "confidence 0"), (0.5, "0.5"), (1.0, "1"))
    return [Layer("Confidence", bytes_of(confidence), bytes_of(level_colors(np.linspace(0, 1, 256))), marks)]


def _seen(kinds: np.ndarray | None) -> list[Layer]:
    """Where it is known; of a file of a stranger's, numbers that are none of the kinds are not."""
    if kinds is None or not np.isin(kinds, range(len(KINDS))).all():
        return []
    marks = ((0.0, "seen well"), (0.5, "seen weakly"), (1.0, f"confidence below {TRUSTED}"))
    return [Layer("How well seen", kinds.astype(np.uint8), bytes_of(KINDS), marks)]


def _error(distance: np.ndarray | None, count: int) -> list[Layer]:
    """Distance (n,) [mm] from the truth, where it is that of the vertices, of which there are `count`."""
    return [] if distance is None or len(distance) != count else [error_layer(distance)]


KINDS = np.array([SEEN_WELL, SEEN_WEAKLY, DOUBTFUL])
"""The colours of `seen_kinds`."""


def seen_kinds(dense: DenseMap) -> np.ndarray | None:
    """How well each vertex (n,) was seen: 0 well, 1 weakly, 2 weakly and with little confidence."""
    if dense.weights is None or dense.confidence is None:
        return None
    kinds: np.ndarray = np.where(seen_well(dense), 0, np.where(dense.confidence < TRUSTED, 2, 1)).astype(np.uint8)
    return kinds


def tangents(camera: CameraModel) -> tuple[float, float]:
    """Tangents of half of what a camera sees, across and down, as far as it is ahead."""
    rays, valid = camera.rays()
    ahead = rays[valid & (rays[..., 2] > 0.1)]
    if not len(ahead):
        return 1.0, 0.75
    across, down = np.quantile(np.abs(ahead[:, :2] / ahead[:, 2:]), 0.995, axis=0)
    return float(across), float(down)
