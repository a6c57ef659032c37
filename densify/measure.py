"""Lengths and areas on a surface: straight and along the wall, of a disc and of an outlined patch.

The way along the wall starts as the shortest path over edges and between the far corners of neighbouring triangles, and
is then pulled tight: each point moves to the middle of its neighbours and back onto the surface, coarse steps first.
All lengths are in the surface's own unit; areas in its square.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

from densify.coverage import patches, triangle_areas
from densify.dense_map import DenseMapFiles, Surface, run_record
from lightdepth.errors import InputError
from lightdepth.reporting.report import number


@dataclass(frozen=True, eq=False)
class Wall:
    """vertices (n, 3) and triangles (m, 3) to measure on; `step`, the typical length of an edge, is its resolution."""

    vertices: np.ndarray
    triangles: np.ndarray

    def __post_init__(self) -> None:
        if not len(self.triangles):
            raise InputError("the surface", "it has no triangles", "there is nothing to measure on: choose another map")

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.vertices, self.triangles)

    @cached_property
    def step(self) -> float:
        return float(np.sqrt(4 / 3**0.5 * triangle_areas(self.vertices, self.triangles).mean()))

    @cached_property
    def graph(self) -> csr_matrix:
        """Lengths of edges, and of the ways across them between the corners on either side where these run inside."""
        import trimesh

        mesh = trimesh.Trimesh(self.vertices, self.triangles, process=False)
        low, high = mesh.edges_unique.T
        a, b = mesh.face_adjacency_edges.T
        c, d = mesh.face_adjacency_unshared.T  # the corners on either side of the edge a b
        ways, inside = _unfolded(*(self.vertices[i] for i in (a, b, c, d)))
        start, end = np.concatenate([low, c[inside]]), np.concatenate([high, d[inside]])
        lengths = np.concatenate([mesh.edges_unique_length, ways[inside]])
        lengths += 1e-12 * self.step  # a length of 0 would be no edge
        count = len(self.vertices)
        key, first = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_index=True)
        return coo_matrix((lengths[first], (key // count, key % count)), (count, count)).tocsr()


def _unfolded(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (n,) from c to d across the edge a b when both triangles lie in one plane, and whether it crosses a b."""
    edge = b - a
    length = np.maximum(np.linalg.norm(edge, axis=1), 1e-300)
    unit = edge / length[:, None]
    x, y = [], []
    for p in (c, d):
        along = ((p - a) * unit).sum(1)
        x.append(along)
        y.append(np.linalg.norm(p - a - along[:, None] * unit, axis=1))
    where = x[0] + (x[1] - x[0]) * y[0] / np.maximum(y[0] + y[1], 1e-300)
    return np.hypot(x[1] - x[0], y[0] + y[1]), (where > 0) & (where < length) & (y[0] > 0) & (y[1] > 0)


@dataclass(frozen=True)
class Way:
    """A path along the wall: points (n, 3), its length, that of the straight line between its ends, and the length of
    those parts of it that cross a hole."""

    points: np.ndarray
    length: float
    straight: float
    over_holes: float

    def scaled(self, scale: float) -> Way:
        """The same in another unit."""
        return Way(self.points * scale, self.length * scale, self.straight * scale, self.over_holes * scale)


@dataclass(frozen=True)
class Area:
    """An area on the wall, the triangles (k,) that it touches, and the length of its outline where one was given."""

    area: float
    triangles: np.ndarray
    outline: float | None = None

    def scaled(self, scale: float) -> Area:
        """The same in another unit."""
        outline = None if self.outline is None else self.outline * scale
        return Area(self.area * scale**2, self.triangles, outline)


def on_wall(wall: Wall, points: np.ndarray, reach: float = 5.0) -> np.ndarray:
    """The places (n, 3) on the wall that are meant by points (n, 3). Raises InputError where one is farther from it
    than `reach` steps."""
    found = wall.surface.closest(points)[0]
    off = np.linalg.norm(found - points, axis=1)
    if (off > reach * wall.step).any():
        worst = int(off.argmax())
        raise InputError(
            f"point {np.round(points[worst], 4).tolist()}",
            f"it is {off[worst]:.3g} from the surface, whose resolution is {wall.step:.2g}",
            f"the nearest place on it is {np.round(found[worst], 4).tolist()}",
        )
    return found


def path(wall: Wall, start: np.ndarray, end: np.ndarray) -> Way:
    """The shortest way along the wall between two points (3,) on it. Raises InputError when there is none."""
    ends = np.stack([start, end])
    triangles = wall.surface.closest(ends)[1]
    first, last = (int(_nearest(wall, t, p)) for t, p in zip(triangles, ends, strict=True))
    distance, before = dijkstra(wall.graph, directed=False, indices=first, return_predecessors=True)
    if not np.isfinite(distance[last]):
        raise InputError(
            "the two points",
            "no path along the surface joins them: they lie on parts that do not touch",
            f"the straight distance is {np.linalg.norm(end - start):.4g}",
        )
    chain = [last]
    while chain[-1] != first:
        chain.append(int(before[chain[-1]]))
    points = np.concatenate([start[None], wall.vertices[chain[::-1]], end[None]])
    points = _tightened(wall, points)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    middles = 0.5 * (points[1:] + points[:-1])
    gap = np.linalg.norm(wall.surface.closest(middles)[0] - middles, axis=1) > wall.step
    return Way(points, float(steps.sum()), float(np.linalg.norm(end - start)), float(steps[gap].sum()))


def _nearest(wall: Wall, triangle: int, point: np.ndarray) -> int:
    corners = wall.triangles[triangle]
    return int(corners[np.linalg.norm(wall.vertices[corners] - point, axis=1).argmin()])


def _tightened(wall: Wall, points: np.ndarray, coarsest: float = 8.0, rounds: int = 60) -> np.ndarray:
    """A chain of points on the wall, pulled tight with steps of 8, 4, 2, 1 and half the wall's resolution."""
    spacing = coarsest * wall.step
    while spacing >= 0.5 * wall.step:
        points = _resampled(points, spacing)
        for _ in range(rounds):
            middle = 0.25 * (points[:-2] + 2 * points[1:-1] + points[2:])
            moved = wall.surface.closest(middle)[0]
            shift = np.abs(moved - points[1:-1]).max(initial=0)
            points[1:-1] = moved
            if shift < 1e-3 * spacing:
                break
        spacing /= 2
    return points


def _resampled(points: np.ndarray, spacing: float) -> np.ndarray:
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    count = max(2, int(np.ceil(along[-1] / spacing)) + 1)
    places = np.linspace(0, along[-1], count)
    return np.stack([np.interp(places, along, points[:, axis]) for axis in range(3)], 1)


def disc(wall: Wall, center: np.ndarray, radius: float) -> Area:
    """The wall around a point (3,) on it, as far as it lies within a straight distance and hangs together."""
    beyond = np.linalg.norm(wall.vertices - center, axis=1) - radius
    return _area(wall, beyond, wall.surface.closest(center[None])[1])


def patch(wall: Wall, corners: np.ndarray) -> Area:
    """The wall inside the outline whose corners (n >= 3, 3) on it are joined by shortest ways, seen along its mean
    normal. Raises InputError for an outline that lies on a line."""
    parts = [path(wall, corners[i], corners[(i + 1) % len(corners)]) for i in range(len(corners))]
    outline = np.concatenate([p.points[:-1] for p in parts])
    middle = outline.mean(0)
    _, extent, axes = np.linalg.svd(outline - middle, full_matrices=False)
    if extent[1] < 0.01 * extent[0]:
        raise InputError(f"the {len(corners)} corners", "they lie on a line", "an area needs corners around it")
    flat = (outline - middle) @ axes[:2].T
    reach = np.linalg.norm(outline - middle, axis=1).max()
    near = np.linalg.norm(wall.vertices - middle, axis=1) < 1.5 * reach
    beyond = np.full(len(wall.vertices), np.inf)
    beyond[near] = _beyond_outline((wall.vertices[near] - middle) @ axes[:2].T, flat)
    found = _area(wall, beyond, wall.surface.closest(outline)[1])
    return Area(found.area, found.triangles, float(sum(p.length for p in parts)))


def _beyond_outline(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Distance (n,) of points (n, 2) from a closed outline (k, 2), negative inside (crossing number)."""
    nearest, crossings = np.full(len(points), np.inf), np.zeros(len(points), int)
    for a, b in zip(outline, np.roll(outline, -1, 0), strict=True):
        side = b - a
        share = np.clip((points - a) @ side / max(side @ side, 1e-300), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - a - share[:, None] * side, axis=1))
        between = (points[:, 1] < a[1]) != (points[:, 1] < b[1])
        if between.any():
            crossings += between & (points[:, 0] < a[0] + (points[:, 1] - a[1]) * side[0] / side[1])
    return np.where(crossings % 2 == 1, -nearest, nearest)


def _area(wall: Wall, beyond: np.ndarray, seeds: np.ndarray) -> Area:
    """The part of the wall where `beyond` (n,), linear over each triangle, is negative and that most seeds lie in."""
    touched = np.flatnonzero((beyond[wall.triangles] < 0).any(1))
    parts = [p for p in patches(wall.triangles, touched) if np.isin(seeds, p).any()]
    if not parts:
        return Area(0.0, np.zeros(0, int))
    chosen = max(parts, key=lambda p: np.isin(seeds, p).sum())
    values = np.sort(np.minimum(beyond[wall.triangles[chosen]], 1e12), axis=1)
    low, mid, high = values.T
    # Of a triangle with one corner on its side of the line, the share in the ratio of the sides cut.
    one = low**2 / np.maximum((low - mid) * (low - high), 1e-300)
    two = 1 - high**2 / np.maximum((high - mid) * (high - low), 1e-300)
    share = np.where(high <= 0, 1.0, np.where(mid <= 0, two, one))
    areas = triangle_areas(wall.vertices, wall.triangles[chosen])
    return Area(float((areas * share).sum()), chosen)


def chosen_map(maps: Sequence[DenseMapFiles], wanted: int | None, run: Path) -> DenseMapFiles:
    """The map of that number, or the only one. Raises InputError where there is none, or no telling which."""
    ids = [m.id for m in maps]
    if wanted is None and len(maps) > 1:
        raise InputError(run, f"it has maps {ids}, each in its own frame of reference", "choose one with --map")
    found = [m for m in maps if wanted in (None, m.id)]
    if not found:
        raise InputError(run, f"no map {wanted}", f"it has {ids}")
    return found[0]


def run_unit(run: Path, mm_per_unit: float | None) -> str:
    """The unit of lengths: mm where the run knew it or mm_per_unit says it, else map units, which mean nothing outside.

    Raises InputError where both say it.
    """
    unit = str(run_record(run).get("unit", "map units"))
    if mm_per_unit is None:
        return unit
    if not mm_per_unit > 0 or not np.isfinite(mm_per_unit):
        raise InputError("--mm-per-unit", f"{mm_per_unit}", "expected a positive number of millimetres")
    if unit == "mm":
        raise InputError(run, "its surfaces are in mm already", "leave --mm-per-unit out")
    return "mm"


def places_in_frame(dense: DenseMapFiles, frame: int, pixels: np.ndarray) -> np.ndarray:
    """The places (n, 3) of the surface in pixels (n, 2) of a keyframe. Raises InputError where one shows none."""
    row = np.flatnonzero(dense.numbers == frame)
    if not len(row):
        near = dense.numbers[np.abs(dense.numbers - frame).argmin()]
        raise InputError(f"map {dense.id}", f"frame {frame} is no keyframe of it", f"the nearest is {near}")
    pose = dense.map_from_cam[row[0]]
    rays, valid = dense.camera.unproject(pixels)
    inside = valid & (pixels >= 0).all(1) & (pixels <= (dense.camera.width, dense.camera.height)).all(1)
    distance = Surface(dense.vertices, dense.triangles).cast(pose[:3, 3], rays @ pose[:3, :3].T)
    for what, bad in (("is outside the image", ~inside), ("sees no surface", ~np.isfinite(distance))):
        if bad.any():
            raise InputError(
                f"frame {frame}", f"pixel {pixels[bad][0].tolist()} {what}", "choose a pixel that shows the surface"
            )
    result: np.ndarray = pose[:3, 3] + distance[:, None] * (rays @ pose[:3, :3].T)
    return result


@dataclass(frozen=True)
class Measured:
    """What was measured at places of a surface: a way between two of them, or the area around or between them."""

    places: np.ndarray
    """the places (n, 3) on the surface that were meant"""
    found: Way | Area
    """lengths and areas, in the unit asked for"""
    least_confidence: float | None = None
    """least confidence of the vertices there, where the surface has it"""
    least_views: int | None = None
    """least number of keyframes that saw a vertex there, where the surface has it"""

    def record(self, reach: float | None = None) -> dict[str, object]:
        """For a file; with intervals, where nine of ten scales are off by a factor of `reach` at most."""
        record: dict[str, object] = {"places": self.places.tolist()}
        if isinstance(self.found, Way):
            way = self.found
            record |= {"length": way.length, "straight": way.straight, "over_holes": way.over_holes}
        else:
            record |= {"area": self.found.area, "outline": self.found.outline}
        if reach is not None:
            record["intervals"] = {
                name: None if value is None else [value / reach**power, value * reach**power]
                for name, value, power in self._figures
            }
        if self.least_views is not None:
            record |= {"least_confidence": self.least_confidence, "least_views": self.least_views}
        return record

    @property
    def _figures(self) -> list[tuple[str, float | None, int]]:
        """Names and values, with the power of the scale that each goes with."""
        if isinstance(self.found, Way):
            return [("length", self.found.length, 1), ("straight", self.found.straight, 1)]
        return [("area", self.found.area, 2), ("outline", self.found.outline, 1)]

    def summary(self, unit: str, reach: float | None = None) -> str:
        """What was measured, for people; `reach` as in `record`."""

        def told(value: float, power: int = 1) -> str:
            text = f"{number(value)} {unit}{'²' if power == 2 else ''}"
            if reach is None:
                return text
            return f"{text} ({number(value / reach**power)} to {number(value * reach**power)})"

        if isinstance(self.found, Way):
            way = self.found
            text = f"along the surface {told(way.length)}, straight {told(way.straight)}"
            if way.over_holes > 0:
                text += f"; {number(way.over_holes)} {unit} of it over holes"
        else:
            text = f"area {told(self.found.area, 2)}"
            if self.found.outline is not None:
                text += f", outline {told(self.found.outline)}"
        if self.least_views is not None:
            text += f"; seen by {self.least_views} keyframes or more, confidence {self.least_confidence:.2f} or more"
        if unit != "mm":
            text += ". A map has no size of its own: --mm-per-unit gives it one, or `lightdepth scale`"
        return text


def measured(
    dense: DenseMapFiles,
    places: np.ndarray,
    radius: float | None = None,
    scale: float = 1.0,
    wall: Wall | None = None,
) -> Measured:
    """What one place and a radius (an area), two places (a length), or an outline of more (both) measure.

    `scale` multiplies lengths at the end; radius is in the scaled unit; `wall` is the map's, where it was made before.
    Raises InputError for anything else.
    """
    if not np.isfinite(places).all():
        raise InputError("places", f"{places.tolist()}", "expected finite numbers")
    if (len(places) == 1) != (radius is not None):
        raise InputError(
            "places",
            f"{len(places)}{'' if radius is None else ' and a radius'}",
            "expected one place with a radius, two places, or the three or more corners of an outline",
        )
    if radius is not None and not (radius > 0 and np.isfinite(radius)):
        raise InputError("--radius", f"{radius}", "expected a positive length")
    wall = wall or Wall(dense.vertices, dense.triangles)
    places = on_wall(wall, places)
    found: Way | Area
    if len(places) == 2:
        found = path(wall, *places)
        triangles = wall.surface.closest(found.points)[1]
    else:
        found = disc(wall, places[0], radius / scale) if radius is not None else patch(wall, places)
        triangles = found.triangles
    confidence, views = None, None
    if dense.confidence is not None and dense.views is not None and len(triangles):
        seen = dense.triangles[triangles]
        confidence, views = float(dense.confidence[seen].min()), int(dense.views[seen].min())
    return Measured(places * scale, found.scaled(scale), confidence, views)
