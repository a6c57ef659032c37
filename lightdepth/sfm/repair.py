"""A better map of the same keyframes: the images are asked anew, the map's poses are where the search begins.

A SLAM sees each frame once and in a hurry: its scale drifts, and points of one track err together. Here the keyframes
are matched with all that look alike, points are triangulated at the poses that the map gives, and poses and points are
adjusted together, in rounds whose tolerance shrinks, so that poses that are some pixels off are still drawn in. A
mapping that knows no poses is made besides, for maps that are too far off. Of the two, the one that holds more
keyframes, and then more observations closer to their points, is brought to the map's frame and scale. The calibration
stays as it is.

With sfm.features, sfm.mapping and sfm.reconstruction the only module that uses pycolmap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.camera import Scaramuzza
from lightdepth.files.working import working_folder
from lightdepth.frame import Frame
from lightdepth.maps import write_text_model
from lightdepth.maps.colmap import read_submap
from lightdepth.native import pycolmap
from lightdepth.sfm.config import Progress, SfmConfig
from lightdepth.sfm.features import features_and_matches, frame_file, quiet, write_images
from lightdepth.sfm.keeping import KeptDatabase
from lightdepth.sfm.mapping import mapping_options
from lightdepth.sfm.reconstruction import (
    fisheye_fit,
    model_at_poses,
    silent,
    triangulated_anew,
    turn_of,
    with_camera,
)
from lightdepth.sparse_map import Submap

_ROUNDS_PX = (16.0, 8.0, 4.0)  # how far an observation may be from its point; the last is COLMAP's own bound
_NEAR_PX = 2.0  # an observation this far from its point says nothing for a pose: wrong poses have many such
_POSED = 10  # points that a keyframe must see: fewer do not hold its pose
_KEPT = 0.75  # of the keyframes must be held by the images: a map with fewer is no better one


@dataclass(frozen=True)
class Repair:
    """What a repair found, before and after it; after it is as before where the map was left as it was."""

    map: int
    """the submap's id"""
    keyframes: tuple[int, int]
    """how many keyframes it has"""
    points: tuple[int, int]
    """how many points it has"""
    px: tuple[float, float]
    """median reprojection error of the map's own observations, pixels"""
    agree: tuple[int, int]
    """how many observations of the new matches lie within 4 px of their point, at the poses given and at the new"""
    agree_px: tuple[float, float]
    """how far these are from their points, root mean square, pixels"""
    moved: float
    """median displacement of the camera centres, as a share of the path's length"""
    begun: str = ""
    """where the poses come from: the map's, or a mapping without them"""
    left: str = ""
    """why the map was left as it was; empty where it was not"""

    def __str__(self) -> str:
        if self.left:
            return f"map {self.map} is left as it was: {self.left}"
        told = [
            f"{what} {_figure(a)} -> {_figure(b)}"
            for what, (a, b) in (
                ("keyframes", self.keyframes),
                ("points", self.points),
                ("median px", self.px),
                ("new observations that agree", self.agree),
                ("their px", self.agree_px),
            )
        ]
        moved = f"centres moved by {self.moved:.2%} of the path in the median"
        return f"map {self.map} is made anew from {self.begun}: {', '.join(told)}; {moved}"


def repaired_submap(
    submap: Submap,
    frames: Sequence[Frame],
    out_folder: Path,
    config: SfmConfig | None = None,
    progress: Progress | None = None,
    database: KeptDatabase | None = None,
) -> tuple[Submap, Repair]:
    """The submap made anew from `frames`, those of its keyframes, and what that changed; written to `out_folder` as a
    COLMAP text model. Its frame of reference and scale are the old one's. It comes back as it was, with the reason,
    where the images do not hold three quarters of its keyframes or agree no better with the new poses. `database`
    keeps features and matches."""
    config, progress = config or SfmConfig(), progress or silent
    if len(frames) < max(3, config.min_model_size):
        reason = f"{len(frames)} of its {len(submap.keyframes)} keyframes have a frame"
        return _as_it_was(submap, out_folder, reason)
    out_folder.parent.mkdir(parents=True, exist_ok=True)
    with working_folder(out_folder.parent) as work:
        for part in ("images", "masks", "colmap", "mapping", "model"):
            (work / part).mkdir()
        written = write_images(frames, work / "images", work / "masks", config, progress)
        fit = fisheye_fit(written.camera, written.valid) if isinstance(written.camera, Scaramuzza) else None
        camera = fit.camera if fit else written.camera
        features_and_matches(work, camera, sorted(written.names), config, progress, database)
        given = {frame_file(k.name): turn_of(fit) @ k.cam_from_map for k in submap.keyframes}
        given = {name: pose for name, pose in given.items() if name in written.names}
        progress("mapping", 0, len(given))
        before, found = _made_anew(work, given, config)
        progress("mapping", len(given), len(given))
        begun, (model, after) = max(found.items(), key=lambda made: made[1][1].key, default=("", (None, _Held())))
        if model is None or after.keyframes < _KEPT * len(given) or model.num_points3D() < config.min_points:
            reason = f"the images hold {after.keyframes} of {len(given)} keyframes together"
            return _as_it_was(submap, out_folder, reason, before)
        if after.score <= before.score:
            reason = f"the images agree with its poses as they are ({before}; with new ones {after})"
            return _as_it_was(submap, out_folder, reason, before)
        _bring_to(model, given)
        model.write_text(work / "model")
        (work / "model").rename(out_folder)
        new = replace(read_submap(out_folder, submap.id), origin=submap.origin)
        if any(new.origin):
            write_text_model(new, out_folder)  # where the old one lies
    if fit:
        new = with_camera(new, written.camera, fit.rotation)
    return new, Repair(
        submap.id,
        (len(submap.keyframes), len(new.keyframes)),
        (len(submap.points), len(new.points)),
        (_px(submap), _px(new)),
        (before.observations, after.observations),
        (before.px, after.px),
        _moved(submap, new),
        begun,
    )


def _as_it_was(submap: Submap, folder: Path, reason: str, held: _Held | None = None) -> tuple[Submap, Repair]:
    write_text_model(submap, folder)
    keyframes, points, px, held = len(submap.keyframes), len(submap.points), _px(submap), held or _Held()
    agree, agree_px = (held.observations, held.observations), (held.px, held.px)
    same = Repair(submap.id, (keyframes, keyframes), (points, points), (px, px), agree, agree_px, 0.0)
    return submap, replace(same, left=reason)


@dataclass(frozen=True)
class _Held:
    """What the images hold of a model."""

    keyframes: int = 0
    observations: int = 0
    px: float = float("nan")
    """root mean square distance of observations from their points"""

    score: float = 0.0
    """observations, each counting less the farther it is: 1 at its point, 0 from 2 px on (MSAC)"""

    @property
    def key(self) -> tuple[int, float]:
        """Of two models the one with the larger is better."""
        return self.keyframes, self.score

    def __str__(self) -> str:
        return f"{self.observations} observations {self.px:.2f} px from their points"


def _made_anew(
    work: Path, given: Mapping[str, np.ndarray], config: SfmConfig
) -> tuple[_Held, dict[str, tuple[Any, _Held]]]:
    """What the images hold at the poses given, and the models made, by where their poses come from."""
    pc = pycolmap()
    made: dict[str, Any] = {}
    with quiet(pc):
        model = triangulated_anew(model_at_poses(work, given), work, mapping_options(pc, config))
        before = _held(model)
        for px in _ROUNDS_PX:
            options = mapping_options(pc, config)
            options.mapper.filter_max_reproj_error = px
            options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = px
            model = triangulated_anew(model, work, options)
            if model.num_points3D() < config.min_points:
                break
            _adjust(pc, model, config)
        else:
            made["its poses"] = model
        mapping = mapping_options(pc, config)
        mapping.multiple_models = False
        models = pc.incremental_mapping(work / "database.db", work / "images", work / "mapping", mapping)
        if models:
            made["the images alone"] = max(models.values(), key=lambda m: m.num_reg_images())
        for begun, model in made.items():
            # Once more as at the poses given: what is compared was triangulated alike.
            made[begun] = triangulated_anew(model, work, mapping_options(pc, config))
            _without_loose_images(made[begun])
    return before, {begun: (model, _held(model)) for begun, model in made.items()}


def _adjust(pc: Any, model: Any, config: SfmConfig) -> None:
    """Poses and points together, wrong matches weighing less. Not pc.bundle_adjustment, which turns COLMAP's log on."""
    options = pc.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pc.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = config.num_threads
    images = pc.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        images.add_image(image_id)
    images.fix_gauge(pc.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pc.create_default_bundle_adjuster(options, images, model).solve()


def _without_loose_images(model: Any) -> None:
    """Takes out the keyframes whose pose the points do not hold."""
    for image_id in list(model.reg_image_ids()):
        image = model.image(image_id)
        if image.num_points3D < _POSED:
            model.deregister_frame(image.frame_id)


def _held(model: Any) -> _Held:
    found = [
        float(((image.project_point(model.point3D(p.point3D_id).xyz) - p.xy) ** 2).sum())
        for image in (model.image(i) for i in model.reg_image_ids())
        for p in image.get_observation_points2D()
    ]
    squares = np.array(found)
    px = float(np.sqrt(squares.mean())) if found else float("nan")
    score = float(np.maximum(1 - squares / _NEAR_PX**2, 0).sum())
    return _Held(int(model.num_reg_images()), len(found), px, score)


def _bring_to(model: Any, given: Mapping[str, np.ndarray]) -> None:
    """Moves, turns and scales the model so that its cameras come closest to the poses given.

    Rotations say how it is turned: camera centres of a straight path could not.
    """
    pc = pycolmap()
    pairs = []
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        pairs.append((np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]), given[image.name]))
    new, old = (np.stack(poses) for poses in zip(*pairs, strict=True))
    u, _, vt = np.linalg.svd((np.swapaxes(old[:, :3, :3], 1, 2) @ new[:, :3, :3]).sum(0))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    centers, wanted = _centers(new), _centers(old)
    turned = (centers - centers.mean(0)) @ rotation.T
    scale = np.linalg.norm(wanted - wanted.mean(0)) / max(float(np.linalg.norm(turned)), 1e-300)
    shift = wanted.mean(0) - scale * rotation @ centers.mean(0)
    model.transform(pc.Sim3d(np.column_stack([scale * rotation, shift])))


def _centers(poses: np.ndarray) -> np.ndarray:
    """Camera centres (n, 3) of cam_from_map (n, 4, 4)."""
    result: np.ndarray = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return result


def _px(submap: Submap) -> float:
    errors = submap.reprojection_errors()
    return float(np.median(errors)) if len(errors) else float("nan")


def _moved(old: Submap, new: Submap) -> float:
    before = {k.number: k.center for k in sorted(old.keyframes, key=lambda k: k.number)}
    path = float(np.linalg.norm(np.diff(np.stack(list(before.values())), axis=0), axis=1).sum())
    away = [float(np.linalg.norm(k.center - before[k.number])) for k in new.keyframes]
    return float(np.median(away)) / max(path, 1e-300)


def _figure(value: float) -> str:
    return f"{value}" if isinstance(value, int) else f"{value:.2f}"
