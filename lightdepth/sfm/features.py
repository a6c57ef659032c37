"""What COLMAP is given: frames as images with masks and evened contrast, their features, and verified matches.

With sfm.reconstruction and sfm.repair the only module that uses pycolmap.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.images import write_image
from lightdepth.frame import Frame, frame_number
from lightdepth.image_quality import Measures, Meter
from lightdepth.native import pycolmap
from lightdepth.sfm.config import ADVICE, Progress, SfmConfig
from lightdepth.sfm.keeping import KeptDatabase
from lightdepth.sfm.retrieval import frame_pairs
from lightdepth.sfm.unmapped import Matching

GOOD_MATCH = 30
"""Verified matches from which a pair of frames says something about their poses."""


def frame_file(name: str) -> str:
    """The name of a frame's keyframe and image file."""
    return f"{frame_number(name):06d}.png"


@dataclass(frozen=True)
class Written:
    """What went to the image folder: the camera, the valid pixels of the first frame, frame names by file name, what
    the images are like, in the order of file names, and why frames could not be read, by name."""

    camera: CameraModel
    valid: np.ndarray
    names: dict[str, str]
    measures: Measures
    unread: dict[str, str]


def write_images(frames: Sequence[Frame], images: Path, masks: Path, config: SfmConfig, progress: Progress) -> Written:
    """Frames as PNG files, named by number so that they sort in time, each with its COLMAP mask (a.png: a.png.png).
    Those that cannot be read are left out; raises InputError where too few are left."""

    first: Frame | None = None
    meter: Meter | None = None
    names: dict[str, str] = {}
    unread: dict[str, str] = {}
    failed: InputError | None = None
    for done in range(1, len(frames) + 1):
        try:
            frame = frames[done - 1]
        except InputError as error:
            failed = failed or error
            unread[_name_of(frames, done - 1)] = f"cannot be read: {error.found}"
            continue
        first = first or frame
        if frame.camera != first.camera:
            raise InputError(
                frame.name, f"another camera than {first.name}'s", "map the frames of one camera at a time"
            )
        name = frame_file(frame.name)
        if name in names:
            raise InputError(
                frame.name, f"it and {names[name]} are both frame {frame.number}", "numbers must be unique"
            )
        names[name] = frame.name
        image = np.rint(255 * np.clip(frame.image, 0, 1)).astype(np.uint8)
        meter = Meter(frame.valid) if meter is None else meter
        meter.add(image)
        for folder, file, pixels in (
            (images, name, evened(image, frame.valid, config.contrast)[..., ::-1]),
            (masks, f"{name}.png", 255 * usable_pixels(frame, config).astype(np.uint8)),
        ):
            write_image(folder / file, pixels)
        progress("images", done, len(frames))
    if first is None or meter is None or len(names) < config.min_model_size:
        if failed is not None:
            raise failed
        raise InputError(
            "the frames", f"{len(names)} of them", f"a sparse map needs at least {config.min_model_size}; {ADVICE}"
        )
    order, found = np.argsort(list(names)), meter.result()
    measures = Measures(*(getattr(found, f.name)[order] for f in fields(Measures)))
    return Written(first.camera, first.valid, names, measures, unread)


def _name_of(frames: Sequence[Frame], row: int) -> str:
    """What a sequence calls a frame that it cannot read."""
    names: Sequence[str] | None = getattr(frames, "names", None)
    return f"frame {row}" if names is None else names[row]


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
    result: np.ndarray = ~(grown(~frame.valid, config.mask_erosion_px) | grown(highlight, config.highlight_margin_px))
    return result


def features_and_matches(
    work: Path,
    camera: CameraModel,
    names: list[str],
    config: SfmConfig,
    progress: Progress,
    kept: KeptDatabase | None = None,
) -> Matching:
    """Fills work/database.db from work/images and work/masks; what there was to match, frames by place in names. What
    `kept` holds is not made again."""
    pc, database, kept = pycolmap(), work / "database.db", kept or KeptDatabase()
    with quiet(pc):
        pc.set_random_seed(config.seed)
        kept.restore(database)
        _extract(pc, work, kept, camera, names, config, progress)
        with pc.Database.open(database) as opened:
            ids = [opened.read_image_with_name(name).image_id for name in names]
            features = np.array([opened.num_keypoints_for_image(i) for i in ids])
            pairs = _pairs(opened, ids, config)
        _match(pc, work, kept, [(names[i], names[j]) for i, j in pairs], config, progress)
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


def far_matches(work: Path, names: list[str], most: int) -> list[tuple[str, str, np.ndarray, np.ndarray]]:
    """Verified matches of frames `names` that are far apart: each of `most` of them, evenly chosen, with the last one
    that it matches well. The two names, and where the matched features are, (n, 2) each."""
    pc = pycolmap()
    with quiet(pc), pc.Database.open(work / "database.db") as opened:
        by_id = {opened.read_image_with_name(name).image_id: name for name in names}
        last: dict[str, tuple[str, np.ndarray]] = {}
        for pair_id, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            one, other = (by_id.get(i, "") for i in pc.pair_id_to_image_pair(pair_id))
            rows = np.asarray(geometry.inlier_matches, int).reshape(-1, 2)
            if one > other:
                one, other, rows = other, one, rows[:, ::-1]
            if one and other and len(rows) >= GOOD_MATCH and (one not in last or last[one][0] < other):
                last[one] = other, rows
        firsts = sorted(last)
        ids = {name: image_id for image_id, name in by_id.items()}
        found = []
        for i in np.unique(np.linspace(0, len(firsts) - 1, min(most, len(firsts))).round().astype(int)):
            one, (other, rows) = firsts[i], last[firsts[i]]
            a, b = (np.asarray(opened.read_keypoints(ids[name]))[:, :2].astype(float) for name in (one, other))
            found.append((one, other, a[rows[:, 0]], b[rows[:, 1]]))
    return found


def _pairs(database: Any, ids: list[int], config: SfmConfig) -> list[tuple[int, int]]:
    exhaustive = config.matching == "exhaustive"
    if exhaustive or (config.matching == "auto" and len(ids) <= config.exhaustive_up_to):
        return list(combinations(range(len(ids)), 2))
    descriptors = (
        [np.asarray(database.read_descriptors(i).data) for i in ids] if config.alike else [np.zeros(0)] * len(ids)
    )
    return frame_pairs(descriptors, config.overlap, config.alike, config.seed)


def _extract(
    pc: Any,
    work: Path,
    kept: KeptDatabase,
    camera: CameraModel,
    names: list[str],
    config: SfmConfig,
    progress: Progress,
) -> None:
    reader = pc.ImageReaderOptions()
    reader.camera_model, reader.mask_path = camera.name, work / "masks"
    reader.camera_params = ",".join(repr(float(p)) for p in camera.params)
    options = pc.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, config.num_threads
    options.sift.max_num_features, options.sift.peak_threshold = config.max_features, config.peak_threshold
    piece = 4 if config.num_threads == 1 else 64  # small, for progress and so that an interrupt is heard
    if kept.features:
        reader.existing_camera_id = 1
    for start in range(kept.features, len(names), piece):
        progress("features", start, len(names))
        pc.extract_features(
            work / "database.db",
            work / "images",
            image_names=names[start : start + piece],
            camera_mode=pc.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pc.Device.cpu,
        )
        reader.existing_camera_id = 1  # the one made by the first piece
        kept.keep(work / "database.db", features=min(start + piece, len(names)))
    kept.keep(work / "database.db", now=True)
    progress("features", len(names), len(names))


def _match(
    pc: Any, work: Path, kept: KeptDatabase, pairs: list[tuple[str, str]], config: SfmConfig, progress: Progress
) -> None:
    """Matches and verifies the pairs of images, a piece at a time, for progress and so that an interrupt is heard."""
    matching, verification = pc.FeatureMatchingOptions(), pc.TwoViewGeometryOptions()
    matching.use_gpu, matching.num_threads = False, config.num_threads
    verification.ransac.random_seed, verification.detect_watermark = config.seed, False
    pairing, piece = pc.ImportedPairingOptions(), 100
    pairing.match_list_path = work / "pairs.txt"
    for start in range(kept.matches, len(pairs), piece):
        progress("matches", start, len(pairs))
        (work / "pairs.txt").write_text(
            "".join(f"{a} {b}\n" for a, b in pairs[start : start + piece]), encoding="utf-8"
        )
        pc.match_image_pairs(
            work / "database.db",
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pc.Device.cpu,
        )
        kept.keep(work / "database.db", matches=min(start + piece, len(pairs)))
    kept.keep(work / "database.db", now=True)
    progress("matches", len(pairs), len(pairs))


@contextmanager
def quiet(pc: Any) -> Iterator[None]:
    """COLMAP's log kept to what ends the process: a failure is reported by us, in one message."""
    before = pc.logging.minloglevel
    pc.logging.minloglevel = 3
    try:
        yield
    finally:
        pc.logging.minloglevel = before
