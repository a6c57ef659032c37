"""Measuring between two places that are clicked: the wall under a click, and the way between two such.

The figures are those of `lightdepth measure`, on the whole surface of the files, not on the thinner one that is drawn.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from densify.measure import Measured, Wall, measured
from densify.viewing.watched import ViewedMap

_LAYERS = 50
"""Walls behind each other that a click may go through, at most."""


@dataclass(frozen=True, eq=False)
class Place:
    """Where a click meets a wall: the map's name, the place (3,) on it, and the distance from the viewer."""

    map: str
    point: np.ndarray
    distance: float


class Ruler:
    """The walls of maps, made when they are first asked for; `scale` is the millimetres of a unit, 1 to leave it."""

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale
        self._walls: dict[str, tuple[ViewedMap, Wall]] = {}

    def wall(self, viewed: ViewedMap) -> Wall:
        """That of a map as it is now."""
        kept = self._walls.get(viewed.name)
        if kept is None or kept[0] is not viewed:
            self._walls[viewed.name] = kept = (viewed, Wall(viewed.read.vertices, viewed.read.triangles))
        return kept[1]

    def place(self, maps: Iterable[ViewedMap], eye: np.ndarray, ray: np.ndarray, through: bool) -> Place | None:
        """The nearest wall of these maps along a ray (3,) from an eye (3,); `through` passes wall that is seen from
        behind, as it is not drawn then."""
        ray = ray / np.linalg.norm(ray)
        found = []
        for viewed in maps:
            wall = self.wall(viewed)
            distance = _first(wall, eye, ray, through)
            if np.isfinite(distance):
                found.append(Place(viewed.name, eye + distance * ray, distance))
        return min(found, key=lambda place: place.distance, default=None)

    def between(self, viewed: ViewedMap, start: np.ndarray, end: np.ndarray) -> Measured:
        """The way along the wall of a map between two places. Raises InputError where there is none."""
        return measured(viewed.read, np.stack([start, end]), scale=self.scale, wall=self.wall(viewed))


def _first(wall: Wall, eye: np.ndarray, ray: np.ndarray, through: bool) -> float:
    """Distance to the first triangle, of those that face the eye where `through`; infinite where there is none."""
    past = 0.0
    for _ in range(_LAYERS):
        step, triangle = wall.surface.meet(eye + past * ray, ray[None])
        if not np.isfinite(step[0]):
            break
        a, b, c = wall.vertices[wall.triangles[triangle[0]]]
        if not through or np.cross(b - a, c - a) @ ray < 0:
            return past + float(step[0])
        past += float(step[0]) + 1e-3 * wall.step
    return np.inf
