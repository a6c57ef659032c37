"""A sparse map from frames alone: structure from motion with COLMAP, for sequences that no SLAM has seen.

Frames become PNG files with masks and evened contrast in a temporary folder; SIFT features are matched between frames
that follow each other or look alike, verified, and mapped incrementally with the calibration held fixed. What does not
connect becomes a submap of its own, with its own scale; a frame that finds no place is named with the likely reason.
Where poses are known, points are only triangulated. COLMAP knows no Scaramuzza camera: such a lens is replaced by the
Kannala-Brandt camera that comes closest, and given back to the keyframes.

With sfm.features, sfm.mapping and sfm.repair the only module that uses pycolmap. With one thread and a seed, as is the
default, equal frames give equal maps.
"""

from __future__ import annotations

import csv
import logging
import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.camera import CameraModel, KannalaBrandt, Scaramuzza
from lightdepth.camera_conversion import Conversion, convert_camera
from lightdepth.errors import InputError
from lightdepth.files.working import working_folder
from lightdepth.foreign_text import for_table
from lightdepth.frame import Frame, frame_number
from lightdepth.maps import read_map
from lightdepth.maps.colmap import holds_model
from lightdepth.native import pycolmap
from lightdepth.sfm.config import ADVICE, Progress, SfmConfig
from lightdepth.sfm.features import far_matches, features_and_matches, frame_file, quiet, write_images
from lightdepth.sfm.keeping import KeptDatabase
from lightdepth.sfm.known_poses import PosesFit, fitting_poses
from lightdepth.sfm.mapping import mapped, mapping_options, write_model
from lightdepth.sfm.unmapped import reasons, summary
from lightdepth.sparse_map import Keyframe, SparseMap, Submap, check_rigid

log = logging.getLogger(__name__)

SOURCES = "images.csv"
_JUDGED = 40  # pairs of frames by whose matches known poses are judged


@dataclass(frozen=True)
class SfmMap(SparseMap):
    """A sparse map, and the frames that found no place in it, by name, with the likely reason."""

    failed: dict[str, str] = field(default_factory=dict)
    poses: PosesFit | None = None
    """how well the matches fit the poses, where these were known"""

    @property
    def unregistered(self) -> tuple[str, ...]:
        return tuple(self.failed)


def sparse_map_from_frames(
    frames: Sequence[Frame],
    out_folder: Path,
    config: SfmConfig | None = None,
    progress: Progress | None = None,
    poses: Mapping[int, np.ndarray] | None = None,
    database: KeptDatabase | None = None,
    files: Mapping[int, str] | None = None,
) -> SfmMap:
    """Frames -> submaps by number of frames, largest first, also written as COLMAP text models to out_folder/0, 1, ...

    Keyframes are named by their frame's number, six digits, `.png`; images.csv in each model's folder has the name of
    the frame's own file beside, from `files` by number, or else the frame's name. With `poses`, map_from_cam (4, 4) by
    frame number, nothing is moved: points are triangulated at these poses, in their unit, and there is one submap.
    Raises InputError, leaving out_folder as it was, when the frames cannot be mapped, the folder already holds a map,
    or the matches fit the poses only when these are read in another way, which is named. `database` keeps features
    and matches.
    """
    config, progress, out_folder = config or SfmConfig(), progress or silent, Path(out_folder)
    check_free(out_folder)
    # On the target's disk, so that the finished models arrive by a rename.
    existing = next(p for p in out_folder.resolve().parents if p.is_dir())
    with working_folder(existing) as work:
        images, masks, models = (work / part for part in ("images", "masks", "models"))
        for folder in (images, masks, models):
            folder.mkdir()
        written = write_images(frames, images, masks, config, progress)
        fit = fisheye_fit(written.camera, written.valid) if isinstance(written.camera, Scaramuzza) else None
        camera, names = fit.camera if fit else written.camera, sorted(written.names)
        known = None if poses is None else _known_poses(poses, written.names)
        matching = features_and_matches(work, camera, names, config, progress, database)
        fitting = None
        if known is None:
            count = mapped(work, names, config, progress)
        else:
            fitting = fitting_poses(far_matches(work, sorted(known), _JUDGED), known, camera, turn_of(fit))
            if fitting.poor:
                warnings.warn(f"known poses: only {fitting}: are they the poses of these frames?", stacklevel=2)
            at = {name: turn_of(fit) @ np.linalg.inv(pose) for name, pose in known.items()}
            count = _triangulated(work, at, config, progress)
        submaps = read_map(models).submaps if count else ()
        if fit:
            submaps = tuple(with_camera(s, written.camera, fit.rotation) for s in submaps)
        registered = {k.name for s in submaps for k in s.keyframes}
        why = reasons(written.measures, matching, np.array([name in registered for name in names]))
        failed = {written.names[name]: reason for name, reason in zip(names, why, strict=True) if reason}
        if known is not None:
            failed = {n: r if frame_file(n) in known else "it has no known pose" for n, r in failed.items()}
        failed |= written.unread
        if not count:
            size = f"{written.camera.width}x{written.camera.height}"
            raise InputError(
                "the frames",
                f"no sparse map could be made of {len(frames)} of {size}: COLMAP connected no "
                f"{config.min_model_size} of them by {config.min_points} points ({summary(list(failed.values()))})",
                ADVICE,
            )
        _write_sources(
            models, submaps, {n: (files or {}).get(frame_number(n), own) for n, own in written.names.items()}
        )
        _move_models(models, out_folder)
    if failed:
        log.warning("%d of %d frames are not in the map: %s", len(failed), len(frames), summary(list(failed.values())))
    return SfmMap(submaps, str(out_folder), failed, fitting)


def _known_poses(poses: Mapping[int, np.ndarray], names: Mapping[str, str]) -> dict[str, np.ndarray]:
    """map_from_cam (4, 4) by file name."""
    known = {}
    for name in names:
        pose = poses.get(frame_number(name))
        if pose is not None:
            check_rigid(pose, f"pose of frame {frame_number(name)}")
            known[name] = pose
    if len(known) < 2:
        raise InputError(
            "known poses", f"{len(known)} of {len(names)} frames have one", "triangulation needs at least 2"
        )
    return known


def turn_of(fit: Conversion | None) -> np.ndarray:
    """(4, 4) from the axes of the frames' camera to those of the camera that COLMAP is given."""
    turn = np.eye(4)
    if fit:
        turn[:3, :3] = fit.rotation
    return turn


def fisheye_fit(camera: CameraModel, valid: np.ndarray) -> Conversion:
    """The Kannala-Brandt camera closest to `camera` on the pixels valid (H, W), with a turn about the axis; logged."""
    fit = convert_camera(camera, KannalaBrandt.name, valid, roll=True)
    level = logging.WARNING if fit.max_px > 2 else logging.INFO
    log.log(
        level,
        "%s camera mapped as OPENCV_FISHEYE: residual median %.2f px, largest %.2f px",
        camera.name,
        fit.median_px,
        fit.max_px,
    )
    return fit


def _triangulated(work: Path, known: Mapping[str, np.ndarray], config: SfmConfig, progress: Progress) -> int:
    """Triangulates the matches at known cam_from_map (4, 4) by file name; writes the model, returns 1, or 0 without."""
    pc = pycolmap()
    (work / "colmap").mkdir()
    progress("mapping", 0, len(known))
    with quiet(pc):
        model = triangulated_anew(model_at_poses(work, known), work, mapping_options(pc, config))
        if model.num_points3D() < config.min_points:
            return 0
        write_model(model, work, 0)
    progress("mapping", len(known), len(known))
    return 1


def model_at_poses(work: Path, known: Mapping[str, np.ndarray]) -> Any:
    """A COLMAP model without points: images of work/database.db at known cam_from_map (4, 4) by file name."""
    pc = pycolmap()
    model = pc.Reconstruction()
    with pc.Database.open(work / "database.db") as opened:
        (camera,) = opened.read_all_cameras()
        model.add_camera_with_trivial_rig(camera)
        for name, pose in sorted(known.items()):
            image_id = opened.read_image_with_name(name).image_id
            image = pc.Image(name=name, camera_id=camera.camera_id, image_id=image_id)
            model.add_image_with_trivial_frame(image, pc.Rigid3d(pose[:3]))
    return model


def triangulated_anew(model: Any, work: Path, options: Any) -> Any:
    """The model with all its points triangulated from the matches of work/database.db, at its poses."""
    return pycolmap().triangulate_points(
        model,
        work / "database.db",
        work / "images",
        work / "colmap",
        clear_points=True,
        options=options,
        refine_intrinsics=False,
    )


def with_camera(submap: Submap, camera: CameraModel, rotation: np.ndarray) -> Submap:
    """The submap seen by the camera that was replaced: pixel = mapped(rotation @ ray) = camera(ray)."""
    back = np.eye(4)
    back[:3, :3] = rotation.T

    def restored(keyframe: Keyframe) -> Keyframe:
        return replace(keyframe, camera=camera, cam_from_map=back @ keyframe.cam_from_map)

    return replace(submap, keyframes=tuple(restored(k) for k in submap.keyframes))


def check_free(out_folder: Path) -> None:
    if out_folder.exists() and not out_folder.is_dir():
        raise InputError(out_folder, "a file", "expected a folder to write the map to")
    taken = [p for p in out_folder.glob("*") if p.name.isdigit()] if out_folder.is_dir() else []
    if taken or (out_folder.is_dir() and holds_model(out_folder)):
        raise InputError(out_folder, "holds a map already", f"remove it, or use it as the map (--map {out_folder})")


def _write_sources(models: Path, submaps: Sequence[Submap], sources: Mapping[str, str]) -> None:
    """images.csv in the folder of each model: the way back from its images to the frames' own files, by name."""
    for submap in submaps:
        path = models / str(submap.id) / SOURCES
        with path.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file:
            rows = [[k.name, for_table(sources[k.name])] for k in submap.keyframes]
            csv.writer(file).writerows([["image", "source"], *rows])


def _move_models(models: Path, out_folder: Path) -> None:
    out_folder.mkdir(parents=True, exist_ok=True)
    for folder in sorted(models.iterdir()):
        shutil.move(folder, out_folder / folder.name)


def silent(stage: str, done: int, count: int) -> None:
    pass
