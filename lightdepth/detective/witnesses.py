"""Points that two keyframes saw, chosen so that few frames have to be read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lightdepth.brief import Brief
from lightdepth.datasets.counting import Counting
from lightdepth.detective.patches import Picture, Pictures, cornerness, likeness, patches
from lightdepth.sparse_map import Keyframe, Submap, covisibility

PixelMap = Callable[[np.ndarray], np.ndarray]
"""Takes pixels (n, 2) of the map's camera to those where the image shows the same."""

LEAST_SHARED = 8
_POINTS = 60  # of a pair: more tell no more
_FAR = 0.25  # of the points that the nearest two share, which the farthest two have to share
_STEP = 1e-3  # of the distance, by which a point's neighbours are taken


@dataclass(frozen=True, eq=False, repr=False)
class Witnesses(Brief):
    """n sightings of a point by two keyframes of a submap: rows of the keyframes (n, 2), pixels (n, 2, 2) of the
    first and the second in the map's cameras, and shapes (n, 2, 2, 2) of patches of the wall that faces the first."""

    keyframes: tuple[Keyframe, ...]
    rows: np.ndarray
    pixels: np.ndarray
    shapes: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def votes(self, pictures: Pictures, counting: Counting, moved: PixelMap | None = None) -> np.ndarray:
        """NCC (n,) of each sighting's two patches; NaN where a frame is missing or shows nothing there."""
        return likeness(*(self._patches(side, pictures, counting, moved) for side in (0, 1)))

    def chance(self, pictures: Pictures, counting: Counting) -> np.ndarray:
        """NCC (n,) of patches around different points of the same two keyframes: what no pairing at all would give."""
        one, other = (self._patches(side, pictures, counting, None) for side in (0, 1))
        swapped = np.arange(len(self))
        for pair in np.unique(self.rows, axis=0):
            of_pair = np.flatnonzero((self.rows == pair).all(1))
            swapped[of_pair] = np.roll(of_pair, len(of_pair) // 2)
        return likeness(one, other[swapped])

    def corners(self, pictures: Pictures, counting: Counting, moved: PixelMap | None = None) -> np.ndarray:
        """How much of a corner (n,) each sighting's two pixels are: what a map's keypoints were chosen for."""
        sides = [
            self._taken(
                side, pictures, counting, moved, lambda picture, pixels, _: cornerness(picture, pixels)[:, None]
            )
            for side in (0, 1)
        ]
        result: np.ndarray = (sides[0] + sides[1])[:, 0] / 2
        return result

    def _patches(self, side: int, pictures: Pictures, counting: Counting, moved: PixelMap | None) -> np.ndarray:
        return self._taken(side, pictures, counting, moved, patches)

    def _taken(
        self,
        side: int,
        pictures: Pictures,
        counting: Counting,
        moved: PixelMap | None,
        take: Callable[[Picture, np.ndarray, np.ndarray], np.ndarray],
    ) -> np.ndarray:
        """(n, k): what `take` finds in the pictures of a side's keyframes at its pixels, with its shapes."""
        pixels, shapes = self.pixels[:, side], self.shapes[:, side]
        if moved is not None:
            pixels, turned = moved(pixels), _turn(moved, pixels)
            shapes = turned @ shapes
        found: np.ndarray | None = None
        for row in np.unique(self.rows[:, side]):
            keyframe = self.keyframes[row]
            picture = pictures.of(counting.number(keyframe))
            if picture is None:
                continue
            of_row = self.rows[:, side] == row
            height, width = picture.grey.shape
            to_image = (width / keyframe.camera.width, height / keyframe.camera.height)
            taken = take(picture, pixels[of_row] * to_image, shapes[of_row])
            if found is None:
                found = np.full((len(self), taken.shape[1]), np.nan)
            found[of_row] = taken
        return np.full((len(self), 1), np.nan) if found is None else found


def _turn(moved: PixelMap, pixels: np.ndarray) -> np.ndarray:
    """(n, 2, 2): how `moved` turns and shears around pixels, without what it enlarges."""
    along = [moved(pixels + step) - moved(pixels) for step in np.eye(2)]
    jacobian = np.stack(along, -1)
    size = np.sqrt(np.abs(np.linalg.det(jacobian)))
    result: np.ndarray = jacobian / np.maximum(size, 1e-9)[:, None, None]
    return result


def chosen_witnesses(submap: Submap, usable: np.ndarray, places: int) -> Witnesses | None:
    """Sightings at `places` spread along the submap, at each a keyframe with the two that share most points with it
    and the farthest that shares many, of those that are `usable` (k,); None where no two keyframes share
    `LEAST_SHARED` points."""
    shared = covisibility(submap) * (usable[:, None] & usable)
    np.fill_diagonal(shared, 0)
    able = np.flatnonzero(shared.max(1, initial=0) >= LEAST_SHARED)
    if not len(able):
        return None
    pairs: set[tuple[int, int]] = set()
    for row in able[np.unique(np.linspace(0, len(able) - 1, 2 * places + 1).round().astype(int))[1::2]]:
        near = [row, *np.argsort(-shared[row], kind="stable")[:2]]
        enough = np.flatnonzero(shared[row] >= max(LEAST_SHARED, _FAR * shared[row].max()))
        far = enough[np.argmax(np.abs(enough - row))]
        for a, b in ((near[0], near[1]), (near[0], near[2]), (near[1], near[2]), (row, far)):
            if shared[a, b] >= LEAST_SHARED:
                pairs.add((min(a, b), max(a, b)))
    rows, pixels, shapes = [], [], []
    for a, b in sorted(pairs):
        points, seen = _shared_points(submap, submap.keyframes[a], submap.keyframes[b])
        rows.append(np.tile([a, b], (len(points), 1)))
        pixels.append(seen)
        shapes.append(_shapes(submap.keyframes[a], submap.keyframes[b], points))
    return Witnesses(submap.keyframes, np.concatenate(rows), np.concatenate(pixels), np.concatenate(shapes))


def _shared_points(submap: Submap, one: Keyframe, other: Keyframe) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) that both observed, and where (n, 2, 2)."""
    first, points, pixels = submap.observed_points(one)
    second, _, others = submap.observed_points(other)
    _, i, j = np.intersect1d(first, second, return_indices=True)
    chosen = np.unique(np.linspace(0, len(i) - 1, min(_POINTS, len(i))).round().astype(int))
    i, j = i[chosen], j[chosen]
    return points[i], np.stack([pixels[i], others[j]], 1)


def _shapes(one: Keyframe, other: Keyframe, points: np.ndarray) -> np.ndarray:
    """(n, 2, 2, 2): what a step across a wall that faces the first keyframe is in either image. The finer view is
    taken in steps of more than a pixel, so that both show the same stretch. Where a view does not see the point, or
    from very near or far, patches are taken as if nothing turned."""
    ray = points - one.center
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    ray = ray / np.maximum(distance, 1e-12)
    upright = np.abs(ray @ one.cam_from_map[1, :3]) < 0.9
    across = np.cross(np.where(upright[:, None], one.cam_from_map[1, :3], one.cam_from_map[0, :3]), ray)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    steps = [_STEP * distance * side for side in (across, np.cross(ray, across))]
    jacobians, seen = [], np.ones(len(points), bool)
    for keyframe in (one, other):
        at, valid = keyframe.camera.project(keyframe.in_camera(points))
        moved = [keyframe.camera.project(keyframe.in_camera(points + step)) for step in steps]
        jacobians.append(np.stack([pixels - at for pixels, _ in moved], -1))
        seen &= valid & moved[0][1] & moved[1][1]
    singular = ~(np.abs(np.linalg.det(jacobians[0])) > 1e-12)
    jacobians[0][singular] = np.eye(2)
    turn = jacobians[1] @ np.linalg.inv(jacobians[0])
    larger = np.sqrt(np.abs(np.linalg.det(turn)))
    usable = seen & ~singular & (larger > 0.25) & (larger < 4)
    turn[~usable] = np.eye(2)
    finer = np.maximum(1.0, 1 / np.where(usable, larger, 1.0))[:, None, None]
    result: np.ndarray = np.stack([np.eye(2) * finer, turn * finer], 1)
    return result
