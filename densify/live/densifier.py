"""Densifier: the surface of one submap while a SLAM is still making it, keyframe by keyframe.

The steps are those of densify.pipeline (predict, observe, align, bend, rectify, fuse), with one difference: depth is
bent by a keyframe's own points alone, because the keyframes that will overlap it are not there yet. Beyond them it can
move keyframes after a loop closure, by taking their depth out of the volume and putting it back where it belongs, and
it extracts only the part of the surface that changed.

Memory: the blocks of the volume that a surface passes near (10 kB each), the triangles, and for each keyframe its
packed depth and image (densify.live.packed, some 120 kB at 320x256) and its points.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from densify.aligned import AlignedKeyframe, align_alone, align_together
from densify.alignment import Alignment
from densify.config import DensifyConfig, LiveConfig, MethodConfig
from densify.coverage import Given, with_contributions
from densify.dense_map import DenseMap
from densify.fusers import device_of, view_to_fuse
from densify.fusion.chosen import Volume, volume_on
from densify.fusion.marching_cubes import unpacked
from densify.fusion.patches import BlockSurface, Patch, joined
from densify.fusion.rectify import SurfaceView
from densify.judging.ahead import AheadConfig
from densify.judging.images import Seen
from densify.live.ahead import AheadJudge, images_of
from densify.live.packed import PackedView, Packing
from densify.predictions import Predictor, SeenKeyframe
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.images import unit_range
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, Submap

STEPS = ("predict", "judge", "align", "integrate", "extract")
"""What a keyframe's time goes into: the paper's own split, and the judge."""

_NEW_VOXEL = 1.25  # a map whose typical distance has changed by more, in its units, is given another voxel size


@dataclass(frozen=True)
class StepTime:
    """Seconds on the clock, and of all the process's threads together."""

    wall: float = 0.0
    cpu: float = 0.0

    def __add__(self, other: StepTime) -> StepTime:
        return StepTime(self.wall + other.wall, self.cpu + other.cpu)


@dataclass(frozen=True, eq=False)
class LiveMesh:
    """The surface in patches, each inside one block of 8³ voxels, by the block's place. `renewed` are the places of all
    blocks that have been looked at again since the last mesh: a viewer replaces these, and drops those without a patch.
    """

    patches: Mapping[int, Patch]
    renewed: np.ndarray

    def joined(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As one mesh: vertices (n, 3) in map units, triangles (m, 3), colors (n, 3) in [0, 1]. Costs what the whole
        map costs."""
        return joined(self.patches.values())


@dataclass(frozen=True, eq=False)
class _Kept:
    """What is kept of a keyframe, so that it can be taken out of the volume and put in again."""

    keyframe: Keyframe
    points: np.ndarray
    """positions (n, 3), in map units, of the points that it observed"""
    view: PackedView
    """its image and prediction, packed"""
    alignment: Alignment
    """how it was aligned when it was fused"""
    given: Given | None = None
    """what it gave to the surface; None where it was not fused"""


class Densifier:
    """One submap's surface, which grows with every keyframe. Not safe to be used by several threads at once.

    `model` predicts a frame's distance; `light` and `mask` (H, W)
    belong to images that are given as arrays.
    """

    def __init__(
        self,
        model: Predictor,
        config: MethodConfig = LiveConfig(),
        id: int = 0,
        light: PhotometricCalibration | None = None,
        mask: np.ndarray | None = None,
    ):
        self.config = config
        self.id = id
        self.times: dict[str, StepTime] = {}
        self.ahead: list[np.ndarray] = []
        """errors of earlier depth at the new points of each keyframe, as densify.judging.ahead.Ahead takes them"""
        judge = config.judge if isinstance(config, LiveConfig | DensifyConfig) else AheadConfig()
        self._judge = AheadJudge(config, judge.on)
        self._parallax = replace(judge.parallax, on=judge.on and judge.parallax.on)
        self._model = model
        self._light, self._mask = light or PhotometricCalibration(), mask
        self._kept: dict[str, _Kept] = {}
        self._device = device_of(model)
        self._volume: Volume | None = None
        self._surface = BlockSurface()
        self._changed: list[np.ndarray] = []

    @property
    def alignments(self) -> tuple[Alignment, ...]:
        """Of all keyframes, in the order in which they came."""
        return tuple(kept.alignment for kept in self._kept.values())

    @property
    def kept_bytes(self) -> int:
        """Memory taken by what is kept of the keyframes."""
        parts = ((k.view.size, k.points, k.keyframe.pixels, k.keyframe.point_ids) for k in self._kept.values())
        sigmas = (k.given.sigma for k in self._kept.values() if k.given is not None)
        kept = sum(size + sum(array.nbytes for array in arrays) for size, *arrays in parts)
        return kept + sum(sigma.nbytes for sigma in sigmas if sigma is not None)

    def warm_up(self, camera: CameraModel) -> None:
        """Does once, for a camera, what the first keyframe would otherwise wait for: tables, libraries' first calls."""
        rng = np.random.default_rng(0)
        image = rng.uniform(0.3, 0.6, (camera.height, camera.width, 3)).astype(np.float32)
        rays, valid = camera.rays()
        rows, columns = (axis[:: max(1, len(axis) // 64)] for axis in valid.nonzero())
        points, pixels = rays[rows, columns], np.stack([columns, rows], -1) + 0.5
        ghost = Densifier(self._model, self.config, light=self._light, mask=self._mask)
        ghost.add_keyframe(image, Keyframe("0", camera, np.eye(4), pixels, np.arange(len(points))), points)
        ghost.mesh()
        ghost.remove_keyframes(["0"])

    def add_keyframe(self, image: np.ndarray | Frame, keyframe: Keyframe, points: np.ndarray) -> Alignment:
        """Predicts, aligns and fuses a keyframe; its alignment, or the reason why it took no part.

        `image` is a frame, or RGB (H, W, 3), uint8 or float in [0, 1]; `points` (n, 3) are the positions, in map units,
        of keyframe.point_ids. Raises InputError, and changes nothing, where these do not fit.
        """
        if keyframe.name in self._kept:
            raise InputError(f"keyframe {keyframe.name}", "already there", "its pose is changed by update_poses")
        points = np.asarray(points, np.float64)
        if points.shape != (len(keyframe.point_ids), 3):
            raise InputError(
                f"keyframe {keyframe.name}",
                f"points of shape {points.shape}",
                f"expected ({len(keyframe.point_ids)}, 3), one for each point that it observed",
            )
        frame = self._frame(image, keyframe)
        packing = Packing(frame.image)
        with self._timed("predict"):
            prediction = self._model(frame)
        with self._timed("integrate"):
            prediction = packing.round(prediction)
        with self._timed("judge"):
            last = self._kept.get(self._judge.last)
            self.ahead.append(self._judge.asked(keyframe, points, last.keyframe if last else None))
        with self._timed("align"):
            aligned = self._aligned(keyframe, points, SeenKeyframe(frame, prediction))
        with self._timed("integrate"):
            self._add(_Kept(keyframe, points, packing.done(), aligned.alignment), prediction)
        self._judge.saw(aligned)
        return aligned.alignment

    def update_poses(
        self,
        poses: Mapping[str, np.ndarray],
        point_ids: np.ndarray | None = None,
        points: np.ndarray | None = None,
    ) -> int:
        """Moves keyframes after a loop closure or a bundle adjustment: cam_from_map (4, 4) by name. How many were fused
        anew.

        Where the SLAM says where its points are now (`points` (n, 3) in map units, of `point_ids`), the keyframes that
        observed them are aligned anew; other points are carried along by their keyframe, whose scale stays. Raises
        InputError, and changes nothing, for a keyframe that is not there or a pose that is none.
        """
        unknown = [name for name in poses if name not in self._kept]
        if unknown:
            raise InputError(
                f"keyframe {unknown[0]}",
                f"not among the {len(self._kept)} of map {self.id}",
                "expected one that was added",
            )
        where = _Positions(point_ids, points)
        renewed: dict[str, _Kept] = {}
        for name, kept in self._kept.items():
            moved = self._moved(kept, poses.get(name), where)
            if moved is not kept:
                renewed[name] = moved
        with self._timed("integrate"):
            return self._replace(renewed)

    def remove_keyframes(self, names: list[str]) -> None:
        """Takes out keyframes that the SLAM has culled. Raises InputError for one that is not there."""
        unknown = [name for name in names if name not in self._kept]
        if unknown:
            raise InputError(
                f"keyframe {unknown[0]}",
                f"not among the {len(self._kept)} of map {self.id}",
                "expected one that was added",
            )
        for name in names:
            self._take_out(self._kept.pop(name))

    def adopt(
        self,
        other: Densifier,
        poses: Mapping[str, np.ndarray],
        point_ids: np.ndarray | None = None,
        points: np.ndarray | None = None,
    ) -> int:
        """Takes over the keyframes of another submap that has been merged into this one; how many.

        `poses` are theirs in this map's frame and scale, `points` as in `update_poses` (needed where the scale is
        another). Of a keyframe that both have, this map's stays. Raises InputError, and changes nothing, where a pose
        is missing or none.
        """
        new = {name: kept for name, kept in other._kept.items() if name not in self._kept}
        missing = [name for name in new if name not in poses]
        if missing:
            raise InputError(
                f"keyframe {missing[0]}", f"its pose in map {self.id} is missing", "expected one for each keyframe"
            )
        where = _Positions(point_ids, points)
        moved = {name: self._moved(kept, poses[name], where) for name, kept in new.items()}
        for kept in moved.values():
            self._add(kept)
            self._judge.knows(kept.keyframe)
        self.ahead += other.ahead
        return len(moved)

    def mesh(self) -> LiveMesh:
        """The surface as it is now. Costs what has changed since the last call, not what the map has grown to."""
        with self._timed("extract"):
            changed = np.concatenate([np.zeros(0, np.int64), *self._changed])
            self._changed = []
            if self._volume is not None:
                self._surface.renew(self._volume, changed)
        return LiveMesh(self._surface.patches, unpacked(self._surface.renewed))

    def seen(self) -> dict[str, Seen]:
        """What the images of the keyframes tell of distances, by keyframe; nothing where the judge is switched off. It
        takes some 0.15 s a keyframe, so it is for the end. Raises InputError while there is no keyframe."""
        views = {name: kept.view for name, kept in self._kept.items()}
        return images_of(views, self._submap(), self._parallax) if self._parallax.on else {}

    def dense_map(self, seen: Mapping[str, Seen] = MappingProxyType({})) -> DenseMap:
        """The surface with all that it rests on, as densify makes it; what its images tell, where `seen` was asked, is
        in its confidence. Raises InputError while there is no keyframe."""
        volume = volume_on("cpu", 1.0, self.config.fusion) if self._volume is None else self._volume
        given = {k.keyframe.name: k.given for k in self._kept.values() if k.given}
        return with_contributions(DenseMap.of(volume, self._submap(), self.alignments), given, seen)

    def _submap(self) -> Submap:
        if not self._kept:
            raise InputError(f"map {self.id}", "no keyframe yet", "add one first")
        keyframes = tuple(kept.keyframe for kept in self._kept.values())
        # A point is where the last keyframe that observed it has it.
        ids = np.concatenate([k.point_ids for k in keyframes])[::-1]
        points = np.concatenate([kept.points for kept in self._kept.values()])[::-1]
        ids, first = np.unique(ids, return_index=True)
        return Submap(self.id, keyframes, ids, points[first])

    @contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        taken = StepTime(time.perf_counter() - wall, time.process_time() - cpu)
        self.times[step] = self.times.get(step, StepTime()) + taken

    def _frame(self, image: np.ndarray | Frame, keyframe: Keyframe) -> Frame:
        if isinstance(image, Frame):
            return replace(image, camera=keyframe.camera)
        pixels = unit_range(image) if image.dtype == np.uint8 else image.astype(np.float32, copy=False)
        return Frame(keyframe.name, pixels, keyframe.camera, self._light, self._mask)

    def _aligned(self, keyframe: Keyframe, points: np.ndarray, seen: SeenKeyframe) -> AlignedKeyframe:
        if not len(points):
            return AlignedKeyframe(keyframe, Alignment(keyframe.name, reason="it observed no points of the map"))
        ids, first = np.unique(keyframe.point_ids, return_index=True)
        submap = Submap(self.id, (keyframe,), ids, points[first])
        alone = align_alone(keyframe, submap, seen, self.config.alignment)
        (bent,) = align_together([alone], np.zeros((1, 1), int), self.config)
        return bent

    def _moved(self, kept: _Kept, pose: np.ndarray | None, where: _Positions) -> _Kept:
        """The keyframe at another pose and with its points where they are now; itself where nothing has changed."""
        old = kept.keyframe
        keyframe = old if pose is None or np.array_equal(pose, old.cam_from_map) else replace(old, cam_from_map=pose)
        points = kept.points
        if keyframe is not old:
            points = (old.in_camera(points) - keyframe.cam_from_map[:3, 3]) @ keyframe.cam_from_map[:3, :3]
        points, known = where.of(keyframe.point_ids, points)
        if keyframe is old and (not known or np.array_equal(points, kept.points)):
            return kept
        if not known:
            return replace(kept, keyframe=keyframe, points=points)
        aligned = self._aligned(keyframe, points, SeenKeyframe(prediction=kept.view.prediction()))
        self._judge.saw_again(aligned)
        return _Kept(keyframe, points, kept.view, aligned.alignment)

    def _replace(self, renewed: dict[str, _Kept]) -> int:
        """Puts keyframes in the place of those of the same name; how many had to be fused anew."""
        pairs = [(self._kept[name], new) for name, new in renewed.items()]
        pairs = [(old, new) for old, new in pairs if not _fused_alike(old, new)]
        self._kept.update(renewed)
        voxel = self._voxel()
        fits = self._volume is not None and 1 / _NEW_VOXEL < voxel / self._volume.voxel < _NEW_VOXEL
        # Taking out costs as much as putting in: where most has moved, it is cheaper to begin again.
        if self._volume is not None and (2 * len(pairs) > len(self._kept) or not fits):
            self._changed.append(self._surface.places)
            self._volume = volume_on(self._device, self._volume.voxel if fits else voxel, self.config.fusion)
            for kept in list(self._kept.values()):
                self._add(kept)
            return len(pairs)
        for old, new in pairs:
            view = self._take_out(old)
            self._add(new, view=view if new.alignment is old.alignment else None)
        return len(pairs)

    def _view(self, kept: _Kept, prediction: DepthPrediction) -> SurfaceView:
        return view_to_fuse(kept.alignment, prediction, kept.view.image(), self.config)

    def _add(self, kept: _Kept, prediction: DepthPrediction | None = None, view: SurfaceView | None = None) -> None:
        """Keeps a keyframe, in the place of one of the same name, and fuses it if it is aligned. Its prediction and its
        view are made from what is kept where they are not at hand."""
        given = None
        if kept.alignment.ok:
            if view is None:
                prediction = kept.view.prediction() if prediction is None else prediction
                view = self._view(kept, prediction)
                given = Given.of(view, prediction)
            if self._volume is None:
                self._volume = volume_on(self._device, self._voxel(kept), self.config.fusion)
            self._changed.append(self._volume.integrate(view, kept.keyframe.cam_from_map))
        self._kept[kept.keyframe.name] = kept if given is None else replace(kept, given=given)

    def _take_out(self, kept: _Kept) -> SurfaceView | None:
        if not kept.alignment.ok:
            return None
        view = self._view(kept, kept.view.prediction())
        assert self._volume is not None
        self._changed.append(self._volume.remove(view, kept.keyframe.cam_from_map))
        return view

    def _voxel(self, first: _Kept | None = None) -> float:
        """As densify chooses it, from the first keyframe that was aligned: a live map has no more at that time."""
        first = first or next((k for k in self._kept.values() if k.alignment.ok), None)
        if self.config.fusion.voxel or first is None:
            return self.config.fusion.voxel or 1.0
        ids, rows = np.unique(first.keyframe.point_ids, return_index=True)
        submap = Submap(self.id, (first.keyframe,), ids, first.points[rows])
        return self.config.fusion.voxel_for(submap)


def _fused_alike(one: _Kept, other: _Kept) -> bool:
    same_pose = np.array_equal(one.keyframe.cam_from_map, other.keyframe.cam_from_map)
    return (same_pose and one.alignment is other.alignment) or not (one.alignment.ok or other.alignment.ok)


class _Positions:
    """Where points are now, by id."""

    def __init__(self, ids: np.ndarray | None, points: np.ndarray | None):
        if (ids is None) != (points is None):
            raise InputError("points", "point_ids without points, or the other way round", "expected both or neither")
        ids = np.zeros(0, int) if ids is None else np.asarray(ids)
        points = np.zeros((0, 3)) if points is None else np.asarray(points, np.float64)
        if points.shape != (len(ids), 3):
            raise InputError("points", f"shape {points.shape}", f"expected ({len(ids)}, 3), one for each of point_ids")
        if not np.isfinite(points).all():
            raise InputError(
                f"point {ids[~np.isfinite(points).all(1)][0]}", "its position is not finite", "expected finite X Y Z"
            )
        self._ids, first = np.unique(ids, return_index=True)
        self._points = points[first]

    def of(self, ids: np.ndarray, otherwise: np.ndarray) -> tuple[np.ndarray, bool]:
        """Positions (n, 3) of points (n,), `otherwise` (n, 3) where unknown; and whether any is known."""
        if not len(self._ids):
            return otherwise, False
        row = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
        known = self._ids[row] == ids
        return np.where(known[:, None], self._points[row], otherwise), bool(known.any())
