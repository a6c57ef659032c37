"""A sparse map from frames alone: structure from motion with COLMAP, for sequences that no SLAM has seen.

Frames become PNG files with masks and evened contrast in a temporary folder; SIFT features are matched between frames
that follow each other or look alike, verified, and mapped incrementally with the calibration held fixed. What does not
connect becomes a submap of its own, with its own scale; a frame that finds no place is named with the likely reason.
Where poses are known, points are only triangulated. COLMAP knows no Scaramuzza camera: such a lens is replaced by the
Kannala-Brandt camera that comes closest, and given back to the keyframes.

The only module that uses pycolmap. With one thread and a seed, as is the default, equal frames give equal maps.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lightdepth.camera import CameraModel, KannalaBrandt, Scaramuzza
from lightdepth.camera_conversion import Conversion, convert_camera
from lightdepth.errors import InputError
from lightdepth.frame import Frame, frame_number
from lightdepth.image_quality import Measures, Meter
from lightdepth.maps import read_map
from lightdepth.maps.colmap import holds_model
from lightdepth.native import pycolmap
from lightdepth.sfm.retrieval import frame_pairs
from lightdepth.sfm.unmapped import Matching, reasons, summary
from lightdepth.sparse_map import Keyframe, SparseMap, Submap, check_rigid

log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
"""Called with the stage ("images", "features", "matches", "mapping"), how much of it is done, and of how much."""

_ADVICE = (
    "What helps: more frames; at least 5 mm of travel with some of it sideways (pure forward motion over 3 mm fails); "
    "sharp frames (blurred ones have no features); the calibration of this very image size; "
    "a mask that leaves the tissue free. A lower `peak_threshold` finds more features in smooth tissue"
)


@dataclass(frozen=True)
class SfmConfig:
    """How frames are mapped."""

    max_features: int = 4096
    """Largest number of SIFT features in a frame; the strongest ones are taken. More find more points and take
    longer."""
    peak_threshold: float = 0.003
    """Least contrast of a feature, in [0, 1]; COLMAP's 0.0067 misses smooth tissue. A higher one finds fewer
    features."""
    mask_erosion_px: int = 4
    """Distance that features keep from the border of the mask, pixels. A larger one leaves out more of the image."""
    highlight: float = 0.98
    """Brightness, in [0, 1], which all three channels of a pixel reach in a highlight. A higher one takes fewer
    pixels for highlights."""
    highlight_margin_px: int = 3
    """Distance that features keep from a highlight, pixels. A larger one leaves out more of the image."""
    contrast: float = 2.0
    """Clip limit of CLAHE, a factor, which evens the contrast of dark and bright tissue; 0 leaves it as it is. A
    larger one brings out more, noise included."""
    matching: Literal["auto", "sequential", "exhaustive"] = "auto"
    """Which frames are matched: sequential, those that follow each other or look alike; exhaustive, all with all;
    auto, exhaustive for few frames."""
    exhaustive_up_to: int = 40
    """Number of frames up to which `auto` matches all with all; longer sequences are matched sequentially. More find
    more connections, in time that grows with their square."""
    overlap: int = 10
    """Number of frames matched ahead of each, when sequential. More bridge longer gaps and take longer."""
    alike: int = 5
    """Number of frames matched with each besides, when sequential: those farther off that look most alike. More close
    more loops and take longer."""
    min_model_size: int = 3
    """Least number of frames in a submap. More leave out small submaps."""
    min_points: int = 8
    """Least number of points in a submap. More leave out poor submaps."""
    init_min_tri_angle: float = 4.0
    """Least angle between the rays of the first pair of frames, degrees. A larger one starts from a safer pair, where
    there is one."""
    init_min_num_inliers: int = 50
    """Least number of matches that the first pair of frames needs. More start from a safer pair, where there is
    one."""
    num_threads: int = 1
    """Number of threads for features, matches and mapping. More change the last bits from run to run, and were not
    faster on two cores."""
    seed: int = 0
    """Number that draws the samples of every RANSAC in it. Another one makes a slightly different map."""


@dataclass(frozen=True)
class SfmMap(SparseMap):
    """A sparse map, and the frames that found no place in it, by name, with the likely reason."""

    failed: dict[str, str] = field(default_factory=dict)

    @property
    def unregistered(self) -> tuple[str, ...]:
        return tuple(self.failed)


def sparse_map_from_frames(
    frames: Sequence[Frame],
    out_folder: Path,
    config: SfmConfig | None = None,
    progress: Progress | None = None,
    poses: Mapping[int, np.ndarray] | None = None,
) -> SfmMap:
    """Frames -> submaps by number of frames, largest first, also written as COLMAP text models to out_folder/0, 1, ...

    Keyframes are named by their frame's number, six digits, `.png`. With `poses`, map_from_cam (4, 4) by frame number,
    nothing is moved: points are triangulated at these poses, in their unit, and there is one submap. Raises
    InputError, leaving out_folder as it was, when the frames cannot be mapped or the folder already holds a map.
    """
    config, progress, out_folder = config or SfmConfig(), progress or _silent, Path(out_folder)
    _check_free(out_folder)
    # On the target's disk, so that the finished models arrive by a rename.
    existing = next(p for p in out_folder.resolve().parents if p.is_dir())
    with tempfile.TemporaryDirectory(prefix=".sfm-", dir=existing) as work:
        images, masks, models = (Path(work) / part for part in ("images", "masks", "models"))
        for folder in (images, masks, models):
            folder.mkdir()
        written = _write_images(frames, images, masks, config, progress)
        fit = fisheye_fit(written.camera, written.valid) if isinstance(written.camera, Scaramuzza) else None
        camera, names = fit.camera if fit else written.camera, sorted(written.names)
        known = None if poses is None else _known_poses(poses, written.names, fit)
        matching = _features_and_matches(Path(work), camera, names, config, progress)
        if known is None:
            count = _reconstruct(Path(work), len(names), config, progress)
        else:
            count = _triangulated(Path(work), known, config, progress)
        submaps = read_map(models).submaps if count else ()
        if fit:
            submaps = tuple(_with_camera(s, written.camera, fit.rotation) for s in submaps)
        registered = {k.name for s in submaps for k in s.keyframes}
        why = reasons(written.measures, matching, np.array([name in registered for name in names]))
        failed = {written.names[name]: reason for name, reason in zip(names, why, strict=True) if reason}
        if known is not None:
            failed = {n: r if frame_file(n) in known else "it has no known pose" for n, r in failed.items()}
        if not count:
            raise InputError(
                f"no sparse map could be made of {len(frames)} frames of {written.camera.width}x"
                f"{written.camera.height}: COLMAP connected no {config.min_model_size} of them by "
                f"{config.min_points} points ({summary(why)}). {_ADVICE}"
            )
        _move_models(models, out_folder)
    if failed:
        log.warning("%d of %d frames are not in the map: %s", len(failed), len(frames), summary(list(failed.values())))
    return SfmMap(submaps, str(out_folder), failed)


def frame_file(name: str) -> str:
    """The name of a frame's keyframe and image file."""
    return f"{frame_number(name):06d}.png"


def _known_poses(
    poses: Mapping[int, np.ndarray], names: Mapping[str, str], fit: Conversion | None
) -> dict[str, np.ndarray]:
    """cam_from_map (4, 4) by file name, of the camera that COLMAP is given."""
    turn = np.eye(4)
    if fit:
        turn[:3, :3] = fit.rotation
    known = {}
    for name in names:
        pose = poses.get(frame_number(name))
        if pose is not None:
            check_rigid(pose, f"pose of frame {frame_number(name)}")
            known[name] = turn @ np.linalg.inv(pose)
    if len(known) < 2:
        raise InputError(f"{len(known)} of {len(names)} frames have a known pose; triangulation needs at least 2")
    return known


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


@dataclass(frozen=True)
class _Written:
    """What went to the image folder: the camera, the valid pixels of the first frame, frame names by file name, and
    what the images are like, in the order of file names."""

    camera: CameraModel
    valid: np.ndarray
    names: dict[str, str]
    measures: Measures


def _write_images(
    frames: Sequence[Frame], images: Path, masks: Path, config: SfmConfig, progress: Progress
) -> _Written:
    """Frames as PNG files, named by number so that they sort in time, each with its COLMAP mask (a.png: a.png.png)."""
    import cv2

    first: Frame | None = None
    meter: Meter | None = None
    names: dict[str, str] = {}
    for done, frame in enumerate(frames, 1):
        first = first or frame
        if frame.camera != first.camera:
            raise InputError(
                f"{frame.name}: another camera than {first.name}'s; map the frames of one camera at a time"
            )
        name = frame_file(frame.name)
        if name in names:
            raise InputError(f"{frame.name} and {names[name]} are both frame {frame.number}; numbers must be unique")
        names[name] = frame.name
        image = np.rint(255 * np.clip(frame.image, 0, 1)).astype(np.uint8)
        meter = Meter(frame.valid) if meter is None else meter
        meter.add(image)
        for folder, file, pixels in (
            (images, name, evened(image, frame.valid, config.contrast)[..., ::-1]),
            (masks, f"{name}.png", 255 * usable_pixels(frame, config).astype(np.uint8)),
        ):
            if not cv2.imwrite(str(folder / file), pixels):
                raise InputError(f"{folder / file}: cannot be written; is the disk full?")
        progress("images", done, len(frames))
    if first is None or meter is None or len(names) < config.min_model_size:
        raise InputError(f"{len(names)} frames; a sparse map needs at least {config.min_model_size}. {_ADVICE}")
    order, found = np.argsort(list(names)), meter.result()
    measures = Measures(*(getattr(found, f.name)[order] for f in fields(Measures)))
    return _Written(first.camera, first.valid, names, measures)


def evened(image: np.ndarray, valid: np.ndarray, limit: float) -> np.ndarray:
    """(H, W, 3) uint8 with the contrast of its lightness evened out (CLAHE), so that the dark far wall and the bright
    near one have features alike. Outside the valid pixels (H, W) the mean stands: a black frame would be evened too."""
    import cv2

    if not limit or not valid.any():
        return image
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    lightness = np.where(valid, lab[..., 0], np.uint8(lab[..., 0][valid].mean()))
    lab[..., 0] = cv2.createCLAHE(limit, (8, 8)).apply(lightness)
    return cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)


def usable_pixels(frame: Frame, config: SfmConfig) -> np.ndarray:
    """(H, W) bool: valid, and neither at the border of the mask nor near a highlight, which moves with the light."""
    import cv2

    def grown(pixels: np.ndarray, margin: int) -> np.ndarray:
        shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
        return cv2.dilate(pixels.astype(np.uint8), shape) > 0

    highlight = frame.image.min(-1) >= config.highlight
    return ~(grown(~frame.valid, config.mask_erosion_px) | grown(highlight, config.highlight_margin_px))


def _features_and_matches(
    work: Path, camera: CameraModel, names: list[str], config: SfmConfig, progress: Progress
) -> Matching:
    """Fills work/database.db from work/images and work/masks; what there was to match, frames by place in names."""
    pc, database = pycolmap(), work / "database.db"
    with _quiet(pc):
        pc.set_random_seed(config.seed)
        _extract(pc, work, database, camera, names, config, progress)
        with pc.Database.open(database) as opened:
            ids = [opened.read_image_with_name(name).image_id for name in names]
            features = np.array([opened.num_keypoints_for_image(i) for i in ids])
            pairs = _pairs(opened, ids, config)
        _match(pc, work, [(names[i], names[j]) for i, j in pairs], config, progress)
        place = {image_id: k for k, image_id in enumerate(ids)}
        flat = pc.TwoViewGeometryConfiguration
        flat = {int(v) for v in (flat.PLANAR, flat.PANORAMIC, flat.PLANAR_OR_PANORAMIC)}
        found = []
        with pc.Database.open(database) as opened:
            for pair_id, geometry in zip(*opened.read_two_view_geometries(), strict=True):
                if len(geometry.inlier_matches):
                    one, other = (place[i] for i in pc.pair_id_to_image_pair(pair_id))
                    found.append((one, other, len(geometry.inlier_matches), int(geometry.config) in flat))
    rows = np.array(found, int).reshape(-1, 4)
    return Matching(features, rows[:, :2], rows[:, 2], rows[:, 3] > 0)


def _pairs(database: Any, ids: list[int], config: SfmConfig) -> list[tuple[int, int]]:
    exhaustive = config.matching == "exhaustive"
    if exhaustive or (config.matching == "auto" and len(ids) <= config.exhaustive_up_to):
        return list(combinations(range(len(ids)), 2))
    descriptors = (
        [np.asarray(database.read_descriptors(i).data) for i in ids] if config.alike else [np.zeros(0)] * len(ids)
    )
    return frame_pairs(descriptors, config.overlap, config.alike, config.seed)


def _reconstruct(work: Path, count: int, config: SfmConfig, progress: Progress) -> int:
    """Maps what work/database.db holds; writes the models as text to work/models/<i>, returns how many."""
    pc = pycolmap()
    registered = 0

    def one_more() -> None:
        nonlocal registered
        registered = min(registered + 1, count)
        progress("mapping", registered, count)

    (work / "colmap").mkdir()
    with _quiet(pc):
        models = pc.incremental_mapping(
            work / "database.db",
            work / "images",
            work / "colmap",
            _mapping_options(pc, config),
            next_image_callback=one_more,
        )
        large = [m for m in models.values() if m.num_reg_images() >= config.min_model_size]
        large = [m for m in large if m.num_points3D() >= config.min_points]
        for index, model in enumerate(sorted(large, key=lambda m: -m.num_reg_images())):
            _write_model(model, work, index)
    progress("mapping", count, count)
    return len(large)


def _triangulated(work: Path, known: Mapping[str, np.ndarray], config: SfmConfig, progress: Progress) -> int:
    """Triangulates the matches at known cam_from_map (4, 4) by file name; writes the model, returns 1, or 0 without."""
    pc, database = pycolmap(), work / "database.db"
    (work / "colmap").mkdir()
    progress("mapping", 0, len(known))
    with _quiet(pc):
        model = pc.Reconstruction()
        with pc.Database.open(database) as opened:
            (camera,) = opened.read_all_cameras()
            model.add_camera_with_trivial_rig(camera)
            for name, pose in sorted(known.items()):
                image_id = opened.read_image_with_name(name).image_id
                image = pc.Image(name=name, camera_id=camera.camera_id, image_id=image_id)
                model.add_image_with_trivial_frame(image, pc.Rigid3d(pose[:3]))
        model = pc.triangulate_points(
            model,
            database,
            work / "images",
            work / "colmap",
            clear_points=True,
            options=_mapping_options(pc, config),
            refine_intrinsics=False,
        )
        if model.num_points3D() < config.min_points:
            return 0
        _write_model(model, work, 0)
    progress("mapping", len(known), len(known))
    return 1


def _write_model(model: Any, work: Path, index: int) -> None:
    folder = work / "models" / str(index)
    folder.mkdir()
    model.write_text(folder)


def _extract(
    pc: Any, work: Path, database: Path, camera: CameraModel, names: list[str], config: SfmConfig, progress: Progress
) -> None:
    reader = pc.ImageReaderOptions()
    reader.camera_model, reader.mask_path = camera.name, work / "masks"
    reader.camera_params = ",".join(repr(p) for p in camera.params)
    options = pc.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, config.num_threads
    options.sift.max_num_features, options.sift.peak_threshold = config.max_features, config.peak_threshold
    piece = 4 if config.num_threads == 1 else 64  # small, for progress and so that an interrupt is heard
    for start in range(0, len(names), piece):
        progress("features", start, len(names))
        pc.extract_features(
            database,
            work / "images",
            image_names=names[start : start + piece],
            camera_mode=pc.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pc.Device.cpu,
        )
        reader.existing_camera_id = 1  # the one made by the first piece
    progress("features", len(names), len(names))


def _match(pc: Any, work: Path, pairs: list[tuple[str, str]], config: SfmConfig, progress: Progress) -> None:
    """Matches and verifies the pairs of images, a piece at a time, for progress and so that an interrupt is heard."""
    matching, verification = pc.FeatureMatchingOptions(), pc.TwoViewGeometryOptions()
    matching.use_gpu, matching.num_threads = False, config.num_threads
    verification.ransac.random_seed, verification.detect_watermark = config.seed, False
    pairing, piece = pc.ImportedPairingOptions(), 100
    pairing.match_list_path = work / "pairs.txt"
    for start in range(0, len(pairs), piece):
        progress("matches", start, len(pairs))
        (work / "pairs.txt").write_text("".join(f"{a} {b}\n" for a, b in pairs[start : start + piece]))
        pc.match_image_pairs(
            work / "database.db",
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pc.Device.cpu,
        )
    progress("matches", len(pairs), len(pairs))


def _mapping_options(pc: Any, config: SfmConfig) -> Any:
    options = pc.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = config.seed
    options.num_threads = options.mapper.num_threads = config.num_threads
    options.multiple_models, options.min_model_size = True, config.min_model_size
    # The calibration is given: refining it on a short endoscopic sequence would trade it against the shape.
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.init_min_tri_angle = config.init_min_tri_angle
    options.mapper.init_min_num_inliers = config.init_min_num_inliers
    options.mapper.init_max_forward_motion = 1.0  # an endoscope moves forward: COLMAP would refuse such first pairs
    return options


@contextmanager
def _quiet(pc: Any) -> Iterator[None]:
    """COLMAP's log kept to what ends the process: a failure is reported by us, in one message."""
    before = pc.logging.minloglevel
    pc.logging.minloglevel = 3
    try:
        yield
    finally:
        pc.logging.minloglevel = before


def _with_camera(submap: Submap, camera: CameraModel, rotation: np.ndarray) -> Submap:
    """The submap seen by the camera that was replaced: pixel = mapped(rotation @ ray) = camera(ray)."""
    back = np.eye(4)
    back[:3, :3] = rotation.T

    def restored(keyframe: Keyframe) -> Keyframe:
        return replace(keyframe, camera=camera, cam_from_map=back @ keyframe.cam_from_map)

    return replace(submap, keyframes=tuple(restored(k) for k in submap.keyframes))


def _check_free(out_folder: Path) -> None:
    if out_folder.exists() and not out_folder.is_dir():
        raise InputError(f"{out_folder}: a file; expected a folder to write the map to")
    taken = [p for p in out_folder.glob("*") if p.name.isdigit()] if out_folder.is_dir() else []
    if taken or (out_folder.is_dir() and holds_model(out_folder)):
        raise InputError(f"{out_folder}: holds a map already; remove it, or use it as the map (--map {out_folder})")


def _move_models(models: Path, out_folder: Path) -> None:
    out_folder.mkdir(parents=True, exist_ok=True)
    for folder in sorted(models.iterdir()):
        shutil.move(folder, out_folder / folder.name)


def _silent(stage: str, done: int, count: int) -> None:
    pass
