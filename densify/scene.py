"""What a densify run shows in three dimensions: its surfaces, the joined ones first, the points that they rest on, and
the cameras with their pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from densify.aligned import AlignedKeyframe
from densify.coverage import seen_well
from densify.dense_map import GREEN, GREY, RED, DenseMap
from densify.evaluation.pictures import FARTHEST_COLOR_MM, error_colors
from densify.evaluation.records import ErrorMesh
from densify.joining import Merged, joined_name
from densify.pipeline import SubmapResult
from densify.predictions import SeenKeyframe
from lightdepth.camera import CameraModel
from lightdepth.reporting.figures import PLAIN, MeshView, colored_distance, jpeg, level_colors, outside_axes, thumbnail
from lightdepth.reporting.scene import Cloud, Layer, Picture, Pose, Scene, Surface
from lightdepth.sparse_map import SparseMap

SEEN_WELL, SEEN_WEAKLY, DOUBTFUL = (0.45, 0.75, 0.55), (0.95, 0.6, 0.15), (0.8, 0.15, 0.15)
TRUSTED = 0.2
"""Confidence below which wall is red: it is expected to be off by twice what is doubted."""

PICTURES = 24
"""The most keyframes whose pictures a scene has."""
_WIDTH = 240  # of such a picture
_TRIANGLES = 250_000  # of all surfaces together
_FEWEST = 4_000  # of each, however many there are


class Thumbnails:
    """Pictures of some keyframes, spread over all submaps, taken as they pass; `found` has them by keyframe."""

    def __init__(self, sparse_map: SparseMap, most: int = PICTURES):
        names = list(dict.fromkeys(k.name for s in sparse_map.submaps for k in s.keyframes))
        rows = np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int)
        self._chosen = {names[i] for i in rows}
        self.found: dict[str, Picture] = {}

    def __call__(self, aligned: AlignedKeyframe, seen: SeenKeyframe) -> None:
        name = aligned.keyframe.name
        if name not in self._chosen or name in self.found or seen.frame is None or seen.prediction is None:
            return
        depth = colored_distance(seen.prediction.distance, seen.prediction.valid)
        self.found[name] = Picture(*(jpeg(thumbnail(each, _WIDTH), 80) for each in (seen.frame.image, depth)))


def scene_of(
    results: Sequence[SubmapResult],
    pictures: Mapping[str, Picture],
    merged: Merged | None = None,
    errors: Sequence[ErrorMesh] = (),
) -> Scene | None:
    """The joined surfaces, then the submaps that are in none of them; None where there is no surface. `errors` are the
    surfaces' distances from the truth, by the names of their folders."""
    joined = [] if merged is None else list(zip(merged.results, merged.groups, strict=True))
    named = [
        (f"{joined_name(r)}: maps {', '.join(map(str, sorted(group)))} as one", joined_name(r), r.dense)
        for r, group in joined
    ]
    within = {i for r, group in joined if len(r.dense.triangles) for i in group}
    alone = [r.dense for r in results if r.dense.submap.id not in within]
    named += [(f"map {d.submap.id}", f"map_{d.submap.id:03d}", d) for d in alone]
    named = [each for each in named if len(each[2].triangles)]
    if not named:
        return None
    distances = {mesh.name: mesh.distance for mesh in errors}
    first = named[0][2]
    still = jpeg(MeshView.of(first.vertices, first.triangles).picture(first.colors))
    most = max(min(Scene.most, _TRIANGLES // len(named)), _FEWEST)
    surfaces = tuple(_surface(title, dense, distances.get(name)) for title, name, dense in named)
    return Scene(surfaces, still, pictures, most)


def _surface(title: str, dense: DenseMap, distance: np.ndarray | None) -> Surface:
    judged, inlier = dense.judged_points()
    points = dense.submap.points
    clouds = (
        Cloud("Points used", points[judged & inlier], GREEN),
        Cloud("Points found wrong", points[judged & ~inlier], RED),
        Cloud("Points not judged", points[~judged], GREY),
    )
    poses = tuple(
        Pose(k.name, k.cam_from_map, a.ok) for k, a in zip(dense.submap.keyframes, dense.alignments, strict=True)
    )
    middle = dense.submap.keyframes[len(dense.submap.keyframes) // 2]
    return Surface(
        title,
        dense.vertices,
        dense.triangles,
        _layers(dense, distance),
        tuple(cloud for cloud in clouds if len(cloud.points)),
        poses,
        tangents(middle.camera),
        outside_axes(dense.vertices),
    )


def _layers(dense: DenseMap, distance: np.ndarray | None) -> tuple[Layer, ...]:
    """Colours, shape, and as far as they are known: confidence, how well it was seen, and error."""
    layers = [
        Layer("Of the images", _bytes(dense.colors)),
        Layer("Shape alone", None, _bytes(np.array([PLAIN]))),
    ]
    shades = np.linspace(0, 1, 256)
    if dense.confidence is not None:
        marks = ((0.0, "confidence 0"), (0.5, "0.5"), (1.0, "1"))
        layers.append(Layer("Confidence", _bytes(dense.confidence), _bytes(level_colors(shades)), marks))
    if (kinds := seen_kinds(dense)) is not None:
        marks = ((0.0, "seen well"), (0.5, "seen weakly"), (1.0, f"confidence below {TRUSTED}"))
        layers.append(Layer("How well seen", kinds, _bytes(KINDS), marks))
    if distance is not None and len(distance) == len(dense.vertices):
        far = FARTHEST_COLOR_MM
        marks = ((0.0, "off by 0 mm"), (0.5, f"{far / 2:g} mm"), (1.0, f"{far:g} mm and more"))
        layers.append(Layer("Error", _bytes(distance / far), _bytes(error_colors(far * shades)), marks))
    return tuple(layers)


def _bytes(shares: np.ndarray) -> np.ndarray:
    found: np.ndarray = np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8)
    return found


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
