"""A scene in three dimensions for a page that loads nothing: surfaces, points and cameras in, one JSON text out.

Notation: n vertices, m triangles. Arrays stand in the JSON as {"KIND": "…"}, KIND being uint8, uint16 or uint32, least
byte first, in base64 of the alphabet for addresses: that has no sign that ends a word, so that hiding the names of
inputs (`names.py`) leaves arrays alone. Places are numbers of steps from a lowest corner: place = low + step · number.
`scene_surface.js` and `scene_viewer.js`, beside this module, draw it.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from lightdepth import native
from lightdepth.foreign_text import for_terminal
from lightdepth.reporting.figures import MeshView, webp

_STEPS = 65535  # of a place along an axis, from one end of the surface to the other
_TOGETHER = 250_000  # triangles of all surfaces
_FEWEST = 4_000  # of each, however many there are
_POINTS, _FEWEST_POINTS = 200_000, 1_000  # the same of points
_ROUGHLY = 10  # times the triangles that are wanted: a larger mesh is thinned out quickly first


@dataclass(frozen=True, eq=False)
class Layer:
    """A way to colour a surface: the colour of a vertex is `palette[values]`, or `values` itself without a palette."""

    title: str
    values: np.ndarray | None
    """(n,) uint8, rows of the palette; (n, 3) uint8 RGB where there is none; None: the palette's first for every one"""
    palette: np.ndarray | None = None
    """(k, 3) uint8 RGB"""
    legend: tuple[tuple[float, str], ...] = ()
    """Places in [0, 1] along the palette, and what they mean."""

    def colors(self) -> np.ndarray | None:
        """(n, 3) in [0, 1]; None where all vertices have one colour."""
        if self.values is None:
            return None
        found: np.ndarray = (self.values if self.palette is None else self.palette[self.values]) / 255
        return found

    def of(self, rows: np.ndarray) -> Layer:
        """The same for some of the vertices."""
        values = None if self.values is None else self.values[rows]
        return Layer(self.title, values, self.palette, self.legend)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (n, 3) of one kind, and the colour that all have."""

    title: str
    points: np.ndarray
    color: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a keyframe was taken: its name, and its pose (4, 4); `used` is whether it is in the surface."""

    name: str
    cam_from_map: np.ndarray
    used: bool = True


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with all that is shown in its frame of reference: vertices (n, 3), triangles (m, 3)."""

    title: str
    vertices: np.ndarray
    triangles: np.ndarray
    layers: tuple[Layer, ...]
    clouds: tuple[Cloud, ...] = ()
    poses: tuple[Pose, ...] = ()
    """In the order of the path."""
    tangents: tuple[float, float] = (1.0, 0.75)
    """Tangents of half of what the camera sees, across and down."""
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3), rows right, down, forward: from where it is looked at first."""
    made: int | None = None
    """Number of triangles before it was thinned; None where it was not."""

    def thinned(self, most: int) -> Surface:
        """The same with at most some `most` triangles."""
        vertices, triangles, rows = thinned(self.vertices, self.triangles, most)
        layers = tuple(layer.of(rows) for layer in self.layers)
        made = len(self.triangles) if self.made is None else self.made
        return replace(self, vertices=vertices, triangles=triangles, layers=layers, made=made)


@dataclass(frozen=True)
class Picture:
    """What is shown of a keyframe, as JPEG; None for what there is not."""

    image: bytes
    distance: bytes | None = None
    uncertainty: bytes | None = None
    residual: bytes | None = None


@dataclass(frozen=True)
class Scene:
    """Surfaces, of which one at a time is shown, and pictures of keyframes by name. `still` (PNG, JPEG or WebP) is
    shown where a browser cannot draw; `most` is the number of triangles that are drawn of each surface."""

    surfaces: tuple[Surface, ...]
    still: bytes
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    kinds: Mapping[str, str] = field(default_factory=dict)
    """What the pictures beside the image show, in words, by the names of their fields."""
    most: int = 50_000
    most_points: int = 20_000

    @classmethod
    def of(
        cls,
        surfaces: Sequence[Surface],
        pictures: Mapping[str, Picture] = MappingProxyType({}),
        kinds: Mapping[str, str] = MappingProxyType({}),
    ) -> Scene | None:
        """Of the surfaces that have a triangle, the first of them in a still picture too; None where there is none.
        Many are shown with fewer triangles each."""
        shown = tuple(surface for surface in surfaces if len(surface.triangles))
        if not shown:
            return None
        still = MeshView.of(shown[0].vertices, shown[0].triangles).cutout(shown[0].layers[0].colors())
        most = max(min(cls.most, _TOGETHER // len(shown)), _FEWEST)
        points = max(min(cls.most_points, _POINTS // len(shown)), _FEWEST_POINTS)
        return cls(shown, webp(still), pictures, kinds, most, points)

    def text(self) -> str:
        """The JSON, which ends no element of HTML that it stands in."""
        used = {pose.name for surface in self.surfaces for pose in surface.poses}
        told = {
            "surfaces": [_surface(surface, self.most, self.most_points) for surface in self.surfaces],
            "pictures": [
                {"name": for_terminal(name)}
                | {kind: packed(np.frombuffer(data, np.uint8)) for kind, data in vars(p).items() if data is not None}
                for name, p in self.pictures.items()
                if name in used
            ],
            "kinds": dict(self.kinds),
        }
        return json.dumps(told, separators=(",", ":")).replace("<", r"\u003c")


def _surface(surface: Surface, most: int, most_points: int) -> dict[str, Any]:
    surface = surface.thinned(most)
    stride = -(-sum(len(cloud.points) for cloud in surface.clouds) // most_points)
    return {
        "title": for_terminal(surface.title),
        "triangles_made": surface.made,
        "points_of": stride,
        "vertices": _places(surface.vertices),
        "triangles": packed(surface.triangles, np.uint16 if len(surface.vertices) <= _STEPS else np.uint32),
        "layers": [_layer(layer) for layer in surface.layers],
        "clouds": [
            {"title": c.title, "color": list(c.color), "points": _places(c.points[:: max(stride, 1)])}
            for c in surface.clouds
        ],
        "poses": [
            {
                "name": for_terminal(pose.name),
                "used": pose.used,
                "axes": _rounded(pose.cam_from_map[:3, :3]),
                "center": (-pose.cam_from_map[:3, :3].T @ pose.cam_from_map[:3, 3]).tolist(),
            }
            for pose in surface.poses
        ],
        "tangents": _rounded(np.array(surface.tangents)),
        "axes": _rounded(surface.axes),
    }


def _layer(layer: Layer) -> dict[str, Any]:
    told: dict[str, Any] = {"title": layer.title, "legend": [list(mark) for mark in layer.legend]}
    if layer.values is not None:
        told["values"] = packed(layer.values)
    if layer.palette is not None:
        told["palette"] = packed(layer.palette)
    return told


def packed(values: np.ndarray, kind: type[np.unsignedinteger[Any]] = np.uint8) -> dict[str, str]:
    """Whole numbers as {"KIND": base64}."""
    data = np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()
    return {kind.__name__: base64.urlsafe_b64encode(data).decode()}


def unpacked(told: Mapping[str, str]) -> np.ndarray:
    """The numbers (n,) that `packed` made a text of."""
    ((kind, text),) = told.items()
    return np.frombuffer(base64.urlsafe_b64decode(text), np.dtype(kind).newbyteorder("<"))


def _places(points: np.ndarray) -> dict[str, Any]:
    """Places (n, 3) as numbers of steps, each at most half a step from where it was."""
    low = points.min(0) if len(points) else np.zeros(3)
    step = np.maximum(np.ptp(points, axis=0) / _STEPS if len(points) else np.zeros(3), np.finfo(np.float32).tiny)
    numbers = np.rint((points - low) / step)
    return {"low": low.tolist(), "step": step.tolist(), **packed(numbers, np.uint16)}


def bytes_of(shares: np.ndarray) -> np.ndarray:
    """Shares in [0, 1] as uint8."""
    found: np.ndarray = np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8)
    return found


def _rounded(values: np.ndarray) -> list[Any]:
    result: list[Any] = np.round(values.astype(float), 6).tolist()
    return result


def thinned(vertices: np.ndarray, triangles: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh of at most some `most` triangles, and for each of its vertices the row of the closest one of the mesh that
    was given. The same mesh gives the same result; one that is small enough stays as it is, every vertex of it."""
    if len(triangles) <= most:
        return vertices, triangles, np.arange(len(vertices))
    from scipy.spatial import cKDTree

    o3d = native.open3d()
    middle = vertices.mean(0)
    coarse, corners = vertices - middle, triangles
    if len(triangles) > _ROUGHLY * most:
        clustered = _clustered(coarse, corners, _ROUGHLY // 2 * most)
        coarse, corners = clustered if len(clustered[1]) else (coarse, corners)  # one far vertex makes one cell of all
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(coarse), o3d.utility.Vector3iVector(corners.astype(np.int32))
    ).simplify_quadric_decimation(most)
    mesh.remove_unreferenced_vertices()
    fewer = np.asarray(mesh.vertices)
    return fewer + middle, np.asarray(mesh.triangles), cKDTree(vertices - middle).query(fewer)[1]


def _clustered(vertices: np.ndarray, triangles: np.ndarray, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of roughly the wanted number of triangles: the vertices in a cell of a grid become their mean. A surface
    has three triangles in the area of a cell's side."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    cells = np.floor((vertices - vertices.min(0)) / np.sqrt(3 * area / wanted)).astype(np.int64)
    sizes = cells.max(0) + 1
    _, cell, count = np.unique(
        (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2], return_inverse=True, return_counts=True
    )
    means = np.stack([np.bincount(cell, vertices[:, k]) for k in range(3)], 1) / count[:, None]
    corners = cell[triangles]
    whole = (corners != np.roll(corners, 1, 1)).all(1)
    return means, corners[whole]
