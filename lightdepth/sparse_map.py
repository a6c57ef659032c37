"""Keyframe, Submap, SparseMap: what a monocular SLAM or SfM knows.

A submap is a set of points and of keyframes that saw them, in one frame of reference and one arbitrary scale ("map
units"). Nothing relates two submaps. Poses are `cam_from_map` (4, 4) float64; pixels (n, 2) have the first pixel's
centre at (0.5, 0.5) whatever the file said.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from lightdepth.brief import Brief
from lightdepth.camera import CameraModel, Provenance
from lightdepth.errors import InputError
from lightdepth.frame import frame_number

_LARGEST = 1e12
"""Magnitude of a coordinate beyond which a map is broken: its squares leave what distances are computed in."""
_FAR = 100  # times the reach of a map that its middle lies away from the origin, from which it is far


@dataclass(frozen=True, eq=False, repr=False)
class Keyframe(Brief):
    """A posed frame and the map points it observed: pixels (n, 2) and point_ids (n,), which index into the submap."""

    name: str
    camera: CameraModel
    cam_from_map: np.ndarray
    pixels: np.ndarray
    point_ids: np.ndarray

    def __post_init__(self) -> None:
        check_rigid(self.cam_from_map, f"keyframe {self.name}")
        if np.abs(self.cam_from_map[:3, 3]).max() > _LARGEST or np.abs(self.pixels).max(initial=0) > _LARGEST:
            what = f"a place or a keypoint beyond {_LARGEST:g}"
            raise InputError(f"keyframe {self.name[:80]}", what, "expected map units and pixels")
        if len(self.pixels) != len(self.point_ids):
            raise InputError(
                f"keyframe {self.name}",
                f"{len(self.pixels)} keypoints, {len(self.point_ids)} point ids",
                "expected as many of both",
            )

    @property
    def number(self) -> int:
        return frame_number(self.name)

    @property
    def center(self) -> np.ndarray:
        """Camera centre in the map (3,)."""
        result: np.ndarray = -self.cam_from_map[:3, :3].T @ self.cam_from_map[:3, 3]
        return result

    def in_camera(self, points: np.ndarray) -> np.ndarray:
        """Map points (n, 3) in camera axes."""
        result: np.ndarray = points @ self.cam_from_map[:3, :3].T + self.cam_from_map[:3, 3]
        return result


@dataclass(frozen=True, eq=False, repr=False)
class PointColors(Brief):
    """Colours (n, 3) of points by id (n,), encoded RGB in [0, 1], as the images showed them that a map was made of."""

    ids: np.ndarray
    values: np.ndarray

    @cached_property
    def _by_id(self) -> np.ndarray:
        return np.argsort(self.ids, kind="stable")

    def of(self, ids: np.ndarray) -> np.ndarray:
        """(n, 3); NaN where a point has none."""
        rows = self._by_id[np.searchsorted(self.ids, ids, sorter=self._by_id).clip(max=len(self.ids) - 1)]
        result: np.ndarray = np.where((self.ids[rows] == ids)[:, None], self.values[rows], np.nan)
        return result


@dataclass(frozen=True, eq=False, repr=False)
class Submap(Brief):
    """Points (n, 3) by id, and the keyframes that share their frame of reference and scale."""

    id: int
    keyframes: tuple[Keyframe, ...]
    point_ids: np.ndarray
    points: np.ndarray
    weak_visibility: bool = False
    """True when observations were guessed by projection instead of read."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where our coordinates begin in those of the map's files: other than 0 for a map that lies far from its own
    origin, where single precision would have no digits left for its shape."""
    localised: tuple[int, ...] | None = None
    """Numbers of the frames whose place the map's SLAM knew, keyframes or not; None where nothing tells."""
    guessed_clock: bool = False
    """True when keyframes are counted from a clock's first stamp, which was taken for the first frame."""
    colors: PointColors | None = None
    """Colours of points, by id; None where the map has none."""

    def __post_init__(self) -> None:
        if not len(self.points):
            raise InputError(f"map {self.id}", "it has no points", "expected at least one")
        if not self.keyframes:
            raise InputError(f"map {self.id}", "it has no keyframes", "expected at least one")
        if len(self.points) != len(self.point_ids):
            raise InputError(
                f"map {self.id}",
                f"{len(self.points)} points, {len(self.point_ids)} point ids",
                "expected as many of both",
            )
        ids, counts = np.unique(self.point_ids, return_counts=True)
        if len(ids) < len(self.point_ids):
            raise InputError(
                f"map {self.id}", f"point {ids[counts > 1][0]} is in it twice", "a point's id must be unique"
            )
        if not np.isfinite(self.points).all():
            bad = self.point_ids[~np.isfinite(self.points).all(1)]
            raise InputError(
                f"map {self.id}",
                f"{len(bad)} points are not finite, the first is point {bad[0]}",
                "expected finite X Y Z",
            )
        if np.abs(self.points).max() > _LARGEST:
            far = self.point_ids[(np.abs(self.points) > _LARGEST).any(1)]
            raise InputError(
                f"map {self.id}",
                f"{len(far)} points have coordinates beyond {_LARGEST:g}, the first is point {far[0]}",
                "expected X Y Z in map units",
            )
        twice = sorted(n for n, times in Counter(k.number for k in self.keyframes).items() if times > 1)
        if twice:
            raise InputError(f"map {self.id}", f"frame {twice[0]} is in it twice", "a keyframe's number must be unique")

    @cached_property
    def _rows_by_id(self) -> np.ndarray:
        return np.argsort(self.point_ids, kind="stable")

    def rows_of(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (n,) of points by id (n,), and whether the map holds each (n,); rows of others are arbitrary."""
        place = np.searchsorted(self.point_ids, ids, sorter=self._rows_by_id)
        rows = self._rows_by_id[np.minimum(place, len(self.point_ids) - 1)]
        return rows, self.point_ids[rows] == ids

    def observed_points(self, keyframe: Keyframe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ids (n,), map points (n, 3) and pixels (n, 2) that a keyframe observed, each point once.

        Observations of points that the map no longer holds are left out.
        """
        rows, held = self.rows_of(keyframe.point_ids)
        first = np.unique(np.where(held, rows, -1), return_index=True)[1]
        chosen = np.sort(first[held[first]])
        return keyframe.point_ids[chosen], self.points[rows[chosen]], keyframe.pixels[chosen].reshape(-1, 2)

    def reprojection_errors(self) -> np.ndarray:
        """Distance in pixels between every observation and its point's projection; points not in view are left out."""
        errors = []
        for keyframe in self.keyframes:
            _, points, pixels = self.observed_points(keyframe)
            projected, valid = keyframe.camera.project(keyframe.in_camera(points))
            errors.append(np.linalg.norm(projected - pixels, axis=1)[valid])
        return np.concatenate(errors)


@dataclass(frozen=True, repr=False)
class SparseMap(Brief):
    """All submaps of one sequence. Where they came from is kept for messages."""

    submaps: tuple[Submap, ...]
    source: str

    def __post_init__(self) -> None:
        if not self.submaps:
            raise InputError(self.source, "no map in it", "expected at least one")
        twice = sorted(i for i, times in Counter(s.id for s in self.submaps).items() if times > 1)
        if twice:
            raise InputError(self.source, f"two maps have the id {twice[0]}", "every submap needs its own")


def with_provenance(submap: Submap, provenance: Provenance | None) -> Submap:
    """The submap, whose files could not say where its camera is from."""
    keyframes = tuple(replace(k, camera=replace(k.camera, provenance=provenance)) for k in submap.keyframes)
    return replace(submap, keyframes=keyframes)


def near_origin(submap: Submap) -> Submap:
    """The submap with its middle taken off where it lies far from the origin, and kept as `origin`."""
    places = np.concatenate([submap.points, [k.center for k in submap.keyframes]])
    middle = np.rint(np.median(places, axis=0))  # of whole units: what is added again is exact
    reach = float(np.median(np.linalg.norm(places - middle, axis=1)))
    if not np.linalg.norm(middle) > _FAR * reach:
        return submap
    return _moved(submap, middle)


def at_its_place(submap: Submap) -> Submap:
    """The submap in the coordinates of the files that it came from."""
    return _moved(submap, -np.array(submap.origin)) if any(submap.origin) else submap


def _moved(submap: Submap, by: np.ndarray) -> Submap:
    """The submap with `by` (3,) taken off its coordinates."""

    def moved(keyframe: Keyframe) -> Keyframe:
        pose = keyframe.cam_from_map.copy()
        pose[:3, 3] += pose[:3, :3] @ by
        return replace(keyframe, cam_from_map=pose)

    x, y, z = (np.array(submap.origin) + by).tolist()
    keyframes = tuple(map(moved, submap.keyframes))
    return replace(submap, keyframes=keyframes, points=submap.points - by, origin=(x, y, z))


def covisibility(submap: Submap) -> np.ndarray:
    """How many points each pair of keyframes shares, (n, n) int with each keyframe's own count on the diagonal."""
    rows = [submap.rows_of(submap.observed_points(keyframe)[0])[0] for keyframe in submap.keyframes]
    ends = np.cumsum([0, *map(len, rows)])
    ones = np.ones(ends[-1], np.int32)
    seen = csr_matrix((ones, np.concatenate(rows), ends), (len(rows), len(submap.points)))
    shared: np.ndarray = (seen @ seen.T).toarray()
    return shared


def typical_distance(submap: Submap) -> float:
    """A typical distance from the keyframes to the points that they observed, in map units: their 35th percentile.

    Wrong points are mostly too far; with 30 % of them this is the median of the right ones.
    """
    distances = [np.linalg.norm(k.in_camera(submap.observed_points(k)[1]), axis=1) for k in submap.keyframes]
    together = np.concatenate(distances)
    if not len(together):
        raise InputError(
            f"map {submap.id}", "no keyframe observes any of its points", "export the map with its observations"
        )
    return float(np.quantile(together, 0.35))


def check_rigid(transform: np.ndarray, what: str) -> None:
    """Raises InputError unless (4, 4) is a finite rotation and translation."""
    if transform.shape != (4, 4):
        raise InputError(what, f"pose of shape {transform.shape}", "expected (4, 4)")
    if not np.isfinite(transform).all():
        raise InputError(what, "the pose has NaN or infinite numbers", "expected a rotation and a translation")
    rotation = transform[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(rotation) < 0:
        raise InputError(
            what,
            f"the pose is not a rotation and translation (R R^T is {off:.2g} from the identity, det "
            f"{np.linalg.det(rotation):.3g})",
            "is it scaled, or mirrored?",
        )
    if np.abs(transform[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(
            what,
            f"the last row of the pose is {transform[3].tolist()}",
            "expected [0, 0, 0, 1]. Is it flattened column by column?",
        )
