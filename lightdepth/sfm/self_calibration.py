"""A camera from the motion of its own frames: structure from motion in which the lens is found as well.

Notation: a start is a lens and a field of view, from which focal length (and, for the fisheye, distortion) are refined.

The frames are mapped with each start held fixed, as a wrong focal length maps nearly as well and a free one runs away
while a map is small; then a bundle adjustment refines the lens of the whole map. The map with the least reprojection
error wins, is made anew with the lens found, and refined again. The principal point stays in the middle of the image,
and a pinhole is preferred unless the fisheye is clearly closer: distortion that the data do not hold costs focal
length.

The deviation is a jackknife over groups of points, each left out in turn. Motion straight ahead tells little of a focal
length: then it is large, and said.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.camera import CameraModel, Pinhole, camera_from_params
from lightdepth.camera.provenance import TOLERATED, told
from lightdepth.counting import counted
from lightdepth.errors import InputError
from lightdepth.files.working import working_folder
from lightdepth.frame import Frame
from lightdepth.native import pycolmap
from lightdepth.sfm.config import ADVICE_WITHOUT_CAMERA, Progress, SfmConfig
from lightdepth.sfm.features import features_and_matches, quiet, write_images
from lightdepth.sfm.mapping import mapping_options
from lightdepth.sfm.reconstruction import silent

HARDLY = 0.2
"""Deviation of the focal length, as a share of it, above which a field that was stated is worth more than the motion's,
unless the motion speaks against it."""
_PINHOLE, _FISHEYE = "SIMPLE_PINHOLE", "OPENCV_FISHEYE"
_FIELDS = {_PINHOLE: (55.0, 80.0, 110.0), _FISHEYE: (90.0, 140.0)}  # across the width, degrees
_CLEARLY = 0.95  # of the pinhole's reprojection error, below which the fisheye is taken
_ALIKE = 1.25  # times the best one's reprojection error, up to which an ending is in the same valley
_MAPPED = 0.7  # of the most frames that any start maps, with which a map takes part
_ACROSS = 35.0, 170.0  # degrees across the width, that endoscopes see
_MODELS = 5  # that a start may try
_GROUPS = 5  # of points, for the jackknife
_INFLATION = 2.5  # of the jackknife: errors of points that share frames come together (four clips of synthetic colons)


@dataclass(frozen=True)
class SelfCalibration:
    """A camera that was found, and how well: its deviation as a share of the focal length (one standard deviation)."""

    camera: CameraModel
    deviation: float
    error_px: float
    mapped: int
    frames: int
    points: int
    from_starts: tuple[float, ...]
    """Focal lengths, pixels, that the starts ended at."""
    fov: float | None = None
    """Field across the width, degrees, that was stated."""

    @property
    def told(self) -> bool:
        """Whether the motion tells the focal length within what is tolerated."""
        return told(self.deviation)

    @property
    def leaves_stated_field(self) -> bool:
        """Whether the motion hardly tells the focal length, and does not speak against the field that was stated: that
        lies within two deviations, or a deviation is as large as the focal length."""
        if self.fov is None or self.deviation <= HARDLY:
            return False
        model = _PINHOLE if isinstance(self.camera, Pinhole) else _FISHEYE
        stated = _focal(_params(model, self.camera.width, self.camera.height, self.fov), model)
        return self.deviation >= 1 or abs(stated / self.camera.focal_length - 1) <= 2 * self.deviation

    @property
    def found(self) -> str:
        """The focal length, how surely it is known, and what it means."""
        f, width = self.camera.focal_length, self.camera.width
        half = width / 2 / f
        across = 2 * np.degrees(np.arctan(half) if isinstance(self.camera, Pinhole) else _angle(self.camera))
        return f"focal length {f:.1f} px +- {100 * self.deviation:.1f} % ({across:.0f} degrees across)"

    def __str__(self) -> str:
        found = f"self-calibrated from {self.mapped} of {self.frames} frames: {self.camera.name}, {self.found}"
        if self.told:
            return found
        field = "" if self.fov is not None else ", --fov from the endoscope's data sheet,"
        return (
            f"{found}. The motion does not tell it within {100 * TOLERATED:.0f} %: lengths and shapes may be off as "
            f"much. Give frames with more sideways motion{field} or a calibration"
        )


def _angle(camera: CameraModel) -> float:
    """Half the field across the width, radians."""
    ray = camera.unproject(np.array([float(camera.width), camera.height / 2]))[0]
    return float(np.arctan2(ray[0], ray[2]))


@dataclass(frozen=True)
class _Ending:
    """What a start came to."""

    model: str
    params: list[float]
    error: float
    images: int
    points: int
    reconstruction: Any


def self_calibrated(
    frames: Sequence[Frame], config: SfmConfig | None = None, progress: Progress | None = None, fov: float | None = None
) -> SelfCalibration:
    """The camera of frames, whose own stands in for it (its size and the masks count). `fov`, degrees across the width,
    is where to start; without it several fields are tried. Raises InputError where the frames cannot be mapped."""
    config, progress = config or SfmConfig(), progress or silent
    if fov is not None and not 10 <= fov <= 175:
        raise InputError("--fov", f"{fov:g} degrees", "expected the field across the image's width, from 10 to 175")
    if len(frames) < config.min_model_size:
        found = f"{counted(len(frames), 'frame')}, of {config.min_model_size} that their motion needs"
        raise InputError("--camera auto", found, ADVICE_WITHOUT_CAMERA)
    with working_folder() as work:
        for part in ("images", "masks"):
            (work / part).mkdir()
        written = write_images(frames, work / "images", work / "masks", config, progress)
        width, height = written.camera.width, written.camera.height
        middle = across(width, height, fov or 70.0)
        features_and_matches(work, middle, sorted(written.names), config, progress)
        starts = (
            [(model, fov) for model in _FIELDS] if fov else [(m, f) for m, fields in _FIELDS.items() for f in fields]
        )
        endings = []
        for done, (model, field) in enumerate(starts):
            progress("calibration", done, len(starts) + 1)
            ending = _ended(work, model, _params(model, width, height, field), (width, height), config)
            if ending is not None:
                endings.append(ending)
        best = _best(endings, len(written.names), config)
        again = _ended(work, best.model, best.params, (width, height), config)
        if again is not None and again.images >= best.images and again.error <= _ALIKE * best.error:
            best = again
        alike = [e for e in endings if e.model == best.model and e.images >= _MAPPED * best.images]
        ends = [_focal(e.params, e.model) for e in alike if e.error <= _ALIKE * best.error]
        deviation = min(1.0, _INFLATION * _jackknife(best, config))
        progress("calibration", len(starts) + 1, len(starts) + 1)
    camera = camera_from_params(best.model, width, height, best.params)
    return SelfCalibration(
        camera,
        deviation,
        best.error,
        best.images,
        len(written.names),
        best.points,
        tuple(round(f, 2) for f in ends),
        fov,
    )


def across(width: int, height: int, fov: float) -> Pinhole:
    """A pinhole of a field across the width, degrees."""
    focal = width / 2 / float(np.tan(np.radians(min(fov, 150.0)) / 2))
    return Pinhole(width, height, focal, focal, width / 2, height / 2)


def _params(model: str, width: int, height: int, field: float) -> list[float]:
    if model == _PINHOLE:
        return [across(width, height, field).fx, width / 2, height / 2]
    focal = width / np.radians(field)
    return [focal, focal, width / 2, height / 2, 0.0, 0.0, 0.0, 0.0]


def _focal(params: Sequence[float], model: str) -> float:
    return params[0] if model == _PINHOLE else float(np.sqrt(params[0] * params[1]))


def _best(endings: Sequence[_Ending], frames: int, config: SfmConfig) -> _Ending:
    """The start with the least error of those that mapped most frames; a pinhole, unless a fisheye is clearly
    closer."""
    most = max((e.images for e in endings), default=0)
    if most < max(config.min_model_size, min(6, frames)):
        raise InputError(
            "the frames",
            f"no camera could be found from their motion: at most {most} of {frames} connect",
            ADVICE_WITHOUT_CAMERA,
        )
    whole = [e for e in endings if e.images >= _MAPPED * most]
    best = {m: min((e for e in whole if e.model == m), key=lambda e: e.error, default=None) for m in _FIELDS}
    pinhole, fisheye = best[_PINHOLE], best[_FISHEYE]
    if pinhole is None or (fisheye is not None and fisheye.error < _CLEARLY * pinhole.error):
        assert fisheye is not None
        return fisheye
    return pinhole


def _ended(work: Path, model: str, params: list[float], size: tuple[int, int], config: SfmConfig) -> _Ending | None:
    """The frames mapped with the lens held fixed, then the lens refined; None where nothing can be mapped or the lens
    runs away."""
    pc = pycolmap()
    with quiet(pc), tempfile.TemporaryDirectory(dir=work) as out:
        with pc.Database.open(work / "database.db") as opened:
            (camera,) = opened.read_all_cameras()
            new = pc.Camera(camera_id=camera.camera_id, model=model, width=size[0], height=size[1], params=params)
            new.has_prior_focal_length = True
            opened.update_camera(new)
        options = mapping_options(pc, config)
        options.max_num_models = _MODELS  # a first pair may lead nowhere: the largest map counts
        models = pc.incremental_mapping(work / "database.db", work / "images", Path(out), options)
        if not models:
            return None
        found = max(models.values(), key=lambda m: m.num_reg_images())
        return _refined(pc, found, model, size, config)


def _refined(pc: Any, found: Any, model: str, size: tuple[int, int], config: SfmConfig) -> _Ending | None:
    options = pc.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = True
    options.refine_principal_point = options.print_summary = False
    setup = pc.BundleAdjustmentConfig()
    for image_id in found.reg_image_ids():
        setup.add_image(image_id)
    setup.fix_gauge(pc.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pc.create_default_bundle_adjuster(options, setup, found).solve()
    found.update_point_3d_errors()
    (camera,) = found.cameras.values()
    params = [float(p) for p in camera.params]
    error = float(found.compute_mean_reprojection_error())
    if (
        not np.isfinite([*params, error]).all()
        or min(params[:2]) <= 0
        or error > 4
        or not _plausible(model, params, size)
    ):
        return None
    return _Ending(model, params, error, found.num_reg_images(), found.num_points3D(), found)


def _plausible(model: str, params: list[float], size: tuple[int, int]) -> bool:
    """Whether a lens sees its whole image, as far as the middle of each side, and across the width as endoscopes do."""
    camera = camera_from_params(model, *size, params)
    width, height = size
    sides = np.array([[0, height / 2], [width, height / 2], [width / 2, 0], [width / 2, height]])
    rays, seen = camera.unproject(sides)
    across_width = float(np.degrees(np.arccos(np.clip(rays[0] @ rays[1], -1, 1))))
    even = model == _PINHOLE or abs(params[0] / params[1] - 1) < 0.1
    return bool(seen.all()) and even and _ACROSS[0] <= across_width <= _ACROSS[1]


def _jackknife(ending: _Ending, config: SfmConfig) -> float:
    """The focal length's deviation, as a share of it, from the maps that lack one group of points each."""
    pc, whole = pycolmap(), ending.reconstruction
    size = next((c.width, c.height) for c in whole.cameras.values())
    ids = np.array(sorted(whole.points3D.keys()))
    group = np.random.default_rng(config.seed).permutation(len(ids)) % _GROUPS
    focals = []
    for left_out in range(_GROUPS):
        part = pc.Reconstruction(whole)
        for point in ids[group == left_out]:
            part.delete_point3D(int(point))
        with quiet(pc):
            found = _refined(pc, part, ending.model, size, config)
        if found is None:
            return 1.0
        focals.append(_focal(found.params, ending.model))
    return float(np.sqrt((_GROUPS - 1) * np.var(focals))) / _focal(ending.params, ending.model)
