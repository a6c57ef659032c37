"""What contradicts itself in a sequence, said when it is opened: a few frames are looked at, no more.

Each check asks a question whose wrong answer ruins what follows without an error of its own: is this the calibration
of these images, is the mask the right way round, do poses and truth fit together, were two fields woven into one image?
Nothing is changed. What cannot be meant raises InputError; what is only unlikely is a warning.

Poses and truth are tested on each other: a point of one frame, at its true distance, has in another frame the distance
that is known there. The readings tried beside the file's own (`READINGS`) are the mistakes that people make: the
opposite direction, other axes, another unit, depth for distance. Another reading is named where it explains the data
and the file's own does not.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from lightdepth.camera import Brown, CameraModel, Pinhole
from lightdepth.datasets.sequence import FrameSequence, border_mask
from lightdepth.datasets.shown import check_shown
from lightdepth.errors import InputError
from lightdepth.frame import Frame, readable
from lightdepth.photometry import PhotometricCalibration
from lightdepth.pose_readings import AS_GIVEN, INVERSE, POSE_READINGS, as_is
from lightdepth.sparse_map import check_rigid

_SAMPLES = 600  # pixels of a frame whose points are looked for in another
_FITS, _BETTER = 0.05, 0.3  # a reading explains the data: median error below the first, and this share of the file's
CONTRADICTION = 0.02
"""Median difference of the distances of one point seen from two frames, from which poses and truth contradict."""
_PLAUSIBLE_MM = 1.0, 1000.0  # median distance of the wall from an endoscope
_LEAST_KNOWN = 100  # pixels of known distance from which their values say something
_GOOD = 0.005  # below this median error nothing else is tried
_LEAST_SEEN = 0.1  # share of the points that have to fall on known distance
_COMBED = 1.3  # comb ratio from which an image looks interlaced; real progressive endoscopy: 1.01 to 1.22

_LEAST_SIDE = 8
"""Pixels of a frame's side, below which neighbours and blocks of pixels mean nothing."""


def check_sequence(sequence: FrameSequence) -> FrameSequence:
    """The sequence as it is, after a look at the frames it offers for that (`sampled`).

    Raises InputError where poses and truth contradict each other and another reading fits; warns of what is unlikely.
    A frame that cannot be read is left out: it is refused when it is asked for.
    """
    frames, no_truth = _looked_at(sequence, sequence.sampled)
    for message in no_truth:
        warnings.warn(f"{sequence.source}: {message}; what needs no truth goes on without it", stacklevel=3)
    if not frames:
        return sequence
    width, height = frames[0].camera.width, frames[0].camera.height
    if min(width, height) < _LEAST_SIDE:
        raise InputError(
            sequence.source, f"frames of {width}x{height}", f"expected at least {_LEAST_SIDE}x{_LEAST_SIDE}"
        )
    known = frames[0].camera.provenance
    if known is not None and known.doubt:
        warnings.warn(known.doubt, stacklevel=3)
    for message in (
        *_camera_doubts(frames[0].camera),
        *_light_doubts(frames[0].light),
        *_mask_doubts(frames),
        *_truth_doubts(frames),
        *_unit_doubts(frames),
        *_level_doubts(frames),
        *([] if sequence.combs_said else _comb_doubts(frames)),
    ):
        warnings.warn(f"{sequence.source}: {message}", stacklevel=3)
    check_shown(sequence, frames)
    for frame in frames:
        if frame.true_world_from_cam is not None:
            check_rigid(frame.true_world_from_cam, f"{sequence.source}: {frame.name}")
    fit = _fit_of(sequence, frames)
    if fit is not None and fit.best == AS_GIVEN and fit.error_as_given > CONTRADICTION:
        warnings.warn(f"{sequence.source}: {_contradiction(fit)}", stacklevel=3)
    if fit is not None and fit.best != AS_GIVEN:
        raise InputError(
            sequence.source,
            "poses and true distances contradict each other: distances seen from two frames differ by "
            f"{fit.error_as_given:.1%} (median)",
            f"they agree to {fit.error:.1%} {fit.best}",
        )
    return sequence


def unusable_truth(sequence: FrameSequence) -> list[str]:
    """Why nothing can be judged by the truth of a sequence: it contradicts its poses, or is not in millimetres."""
    frames, no_truth = _looked_at(sequence, sequence.sampled)
    fit = _fit_of(sequence, frames) if frames else None
    return [
        *no_truth,
        *_unit_doubts(frames),
        *([_contradiction(fit)] if fit is not None and fit.error_as_given > CONTRADICTION else []),
    ]


def _looked_at(sequence: FrameSequence, rows: Iterable[int]) -> tuple[list[Frame], list[str]]:
    """The frames that can be read, some without their truth, and why that cannot be read of the first."""
    frames, no_truth = [], []
    blind = sequence.without_truth()
    for i in rows:
        try:
            frames.append(sequence[i])
        except InputError as error:
            with suppress(InputError):
                frames.append(blind[i])
                no_truth.append(f"the truth of {sequence.names[i]} cannot be read ({error})")
    return frames, no_truth[:1]


# ---- camera, light, mask, image


def _camera_doubts(camera: CameraModel) -> list[str]:
    x, y = camera.project(np.array([0.0, 0.0, 1.0]))[0].tolist()
    found = []
    if max(abs(x / camera.width - 0.5), abs(y / camera.height - 0.5)) > 0.25:
        found.append(
            f"the principal point ({x:.0f}, {y:.0f}) is far from the middle of {camera.width}x{camera.height}: "
            "is this the calibration of another image size, or of a crop?"
        )
    flat = isinstance(camera, Pinhole | Brown)
    half = max(camera.width, camera.height) / 2 / camera.focal_length
    field = float(np.degrees(2 * (np.arctan(half) if flat else half)))
    if not 20 <= field <= (160 if flat else 200):
        found.append(
            f"the camera's field of view would be {field:.0f} degrees (focal length {camera.focal_length:.4g} pixels, "
            f"{camera.width}x{camera.height}): is the focal length in mm, or of another image size?"
        )
    return found


def _light_doubts(light: PhotometricCalibration) -> list[str]:
    found = []
    if not 1 <= light.gamma <= 3:
        found.append(f"the light's gamma is {light.gamma:g}; a camera's is between 1 and 3: was 1/gamma written?")
    away = float(np.linalg.norm(light.position_mm))
    if away > 100:
        found.append(
            f"the light is {away:.0f} mm from the lens, farther than an endoscope's tip is wide: "
            "is its position in micrometres, or were millimetres taken for metres?"
        )
    return found


def _mask_doubts(frames: Sequence[Frame]) -> list[str]:
    mask = frames[0].mask
    if mask is None:
        return []
    images = [frame.image for frame in frames if frame.image.shape == frames[0].image.shape]
    share, found = float(mask.mean()), []
    if share < 0.05:
        found.append(f"the mask leaves {share:.1%} of the image: is it the mask of these images?")
    elif share > 0.999 and (black := 1 - float(border_mask(images).mean())) > 0.1:
        found.append(f"{black:.0%} of the image is a black border, and the mask leaves it in: is it the mask meant?")
    elif share < 0.999:
        value = np.mean([image.max(-1) for image in images], axis=0)
        inside, outside = float(value[mask].mean()), float(value[~mask].mean())
        if outside > 2 * inside and outside > 0.1:
            found.append(
                f"the mask keeps the dark part of the image (brightness {inside:.2f}, {outside:.2f} outside): "
                "is it inverted?"
            )
    return found


def _truth_doubts(frames: Sequence[Frame]) -> list[str]:
    truths = [frame.true_distance for frame in frames if frame.true_distance is not None]
    known = [truth[np.isfinite(truth) & (truth > 0)] for truth in truths]
    if not truths:
        return []
    names = ", ".join(frame.name for frame in frames if frame.true_distance is not None)
    if not any(len(values) for values in known):
        return [f"the true distance is unknown (0) everywhere in {names}"]
    if all(len(values) == 0 or np.ptp(values) == 0 for values in known):
        return [f"the true distance is the same number everywhere in {names}: is it a depth map?"]
    return []


def _known_distances(frames: Sequence[Frame]) -> np.ndarray:
    """All true distances (n,) of the frames that are known."""
    truths = [frame.true_distance for frame in frames if frame.true_distance is not None]
    return np.concatenate([np.zeros(0), *(truth[np.isfinite(truth) & (truth > 0)] for truth in truths)])


def _unit_doubts(frames: Sequence[Frame]) -> list[str]:
    known = _known_distances(frames)
    if len(known) < _LEAST_KNOWN or np.ptp(known) == 0:
        return []
    middle = float(np.median(known))
    if not _PLAUSIBLE_MM[0] <= middle <= _PLAUSIBLE_MM[1]:
        return [
            f"the true distance would be {middle:.3g} mm (median): it may be in metres, or a code; millimetres are "
            "expected"
        ]
    if known.max() <= 255 and (known == np.rint(known)).all():
        return [
            f"the true distance holds whole numbers from {known.min():.0f} to {known.max():.0f} alone, as codes of 8 "
            "bits do; millimetres, and parts of them, are expected"
        ]
    return []


def _level_doubts(frames: Sequence[Frame]) -> list[str]:
    known = _known_distances(frames)
    levels = np.unique(known)
    if len(known) < _LEAST_KNOWN or not 2 < len(levels) <= 256 or _unit_doubts(frames):
        return []
    return [
        f"the true distance has only {len(levels)} different values, {np.median(np.diff(levels)):.2g} mm apart, as if "
        "coded in 8 bits: smaller errors cannot be told"
    ]


def _comb_doubts(frames: Sequence[Frame]) -> list[str]:
    if any(frame.true_distance is not None for frame in frames):
        return []  # C3VD's video is interlaced, and its truth registered to it: there is nothing to be done
    ratio = float(np.median([comb_ratio(frame.image) for frame in frames]))
    if ratio <= _COMBED:
        return []
    return [
        f"the images look interlaced (neighbouring rows differ {ratio:.2f} times as much as rows of one field): "
        "deinterlace the video: lightdepth import --deinterlace keeps one field, and the camera stays right"
    ]


def comb_ratio(image: np.ndarray) -> float:
    """How far neighbouring rows of an image (H, W, 3) differ, over how far rows two apart do: comb teeth make it > 1.

    Over the ratio of the columns, which sharpening and noise raise alike. About 1 for progressive video, whatever
    moves; interlaced video exceeds it where something moved between the two fields (a real frame of C3VD: 1.43). The
    border of the image, an eighth on each side, is left out.
    """
    height, width = image.shape[:2]
    grey = image.mean(-1)[height // 8 : height - height // 8, width // 8 : width - width // 8]

    def ratio(lines: np.ndarray) -> float:
        if len(lines) < 4:
            return 1.0
        near, far = np.abs(lines[1:] - lines[:-1]).mean(), np.abs(lines[2:] - lines[:-2]).mean()
        return float(near / far) if far > 1e-4 else 1.0

    return ratio(grey) / max(ratio(grey.T), 1e-3)


# ---- poses and truth


@dataclass(frozen=True)
class Reading:
    """One way to take a file's poses and distances.

    pose: of a pose (4, 4), the one meant; distance: of distances (n,) and their rays' z (n,), the distances meant.
    """

    pose: Callable[[np.ndarray], np.ndarray]
    distance: Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Fit:
    """How well poses and truth fit: median relative error of distance as given, and by the best of `READINGS`."""

    error_as_given: float
    best: str
    error: float


def _same(distance: np.ndarray, ray_z: np.ndarray) -> np.ndarray:
    return distance


def _scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(pose: np.ndarray) -> np.ndarray:
        pose = pose.copy()
        pose[:3, 3] *= factor
        return pose

    return change


_UNITS = {
    1000.0: "multiplied by 1000: they are in metres, the distances in millimetres",
    100.0: "multiplied by 100",
    10.0: "multiplied by 10: they are in centimetres, the distances in millimetres",
    0.1: "divided by 10: they are in millimetres, the distances in centimetres",
    0.01: "divided by 100",
    0.001: "divided by 1000: they are in millimetres, the distances in metres",
}
READINGS: dict[str, Reading] = {
    **{name: Reading(meant, _same) for name, meant in POSE_READINGS.items()},
    "with the truth taken as depth along the axis and divided by the ray's z; expected is distance along the ray": (
        Reading(as_is, lambda depth, ray_z: depth / ray_z)
    ),
    "with the truth multiplied by the ray's z: depth was taken for distance once too often": (
        Reading(as_is, lambda distance, ray_z: distance * ray_z)
    ),
    **{f"with the translations {text}": Reading(_scaled(factor), _same) for factor, text in _UNITS.items()},
    **{
        f"{INVERSE}, and the translations {text}": Reading(
            lambda pose, factor=factor: np.linalg.inv(_scaled(factor)(pose)),  # type: ignore[misc]  # bound in the loop
            _same,
        )
        for factor, text in _UNITS.items()
    },
}
"""What poses and distances might mean, by how a message says it."""


def _fit_of(sequence: FrameSequence, frames: Sequence[Frame]) -> Fit | None:
    """How well the poses and truth of the frames fit; where these see no common wall, with those that follow them."""
    both = [f for f in frames if f.true_world_from_cam is not None and len(_known_distances([f]))]
    fit = fitting_reading(frames)
    if fit is not None or len(both) < 2:
        return fit
    following = {i + 1 for i in sequence.sampled if i + 1 < len(sequence)} - set(sequence.sampled)
    neighbours = [*frames, *readable(sequence, sorted(following))]
    fit = fitting_reading(neighbours)
    numbers = sorted(f.number for f in neighbours if f.true_world_from_cam is not None)
    if fit is None and 1 in np.diff(numbers):
        return Fit(float("inf"), AS_GIVEN, float("inf"))
    return fit


def _contradiction(fit: Fit) -> str:
    if not np.isfinite(fit.error_as_given):
        return (
            "poses and true distances contradict each other: by its poses no frame sees the wall that the next one "
            "sees, and no reading of them that is known explains it"
        )
    return (
        "poses and true distances contradict each other: distances seen from two frames differ by "
        f"{fit.error_as_given:.1%} (median; at most {CONTRADICTION:.0%} is expected), and no reading of them that is "
        "known explains it: the calibration may be of other images, or the wall moves"
    )


def fitting_reading(frames: Sequence[Frame]) -> Fit | None:
    """Which of `READINGS` the frames' poses and true distances obey: the given one unless another is clearly better.

    None where there is nothing to test: fewer than two frames with both, no motion, or no reading under which the
    frames see the same surface.
    """
    frames = [f for f in frames if f.true_world_from_cam is not None and f.true_distance is not None]
    errors = {AS_GIVEN: _error(frames, READINGS[AS_GIVEN])}
    if len(frames) < 2 or errors[AS_GIVEN] < _GOOD:
        return None if len(frames) < 2 else Fit(errors[AS_GIVEN], AS_GIVEN, errors[AS_GIVEN])
    errors = {name: _error(frames, reading) for name, reading in READINGS.items()}
    best = min(errors, key=lambda name: errors[name])
    if not np.isfinite(errors[best]):
        return None
    if errors[best] > min(_FITS, _BETTER * errors[AS_GIVEN]):
        best = AS_GIVEN
    return Fit(errors[AS_GIVEN], best, errors[best])


def _error(frames: Sequence[Frame], reading: Reading) -> float:
    """Median over the pairs of frames that see the same surface, of their median relative errors; else infinity."""
    pairs = [(a, b) for i, a in enumerate(frames) for b in frames[i + 1 :]]
    errors = [e for a, b in pairs if (e := _pair_error(a, b, reading)) is not None and np.isfinite(e)]
    return float(np.median(errors)) if errors else float("inf")


@np.errstate(all="ignore")  # a reading may divide by a ray's z, and a lens may have none there
def _pair_error(a: Frame, b: Frame, reading: Reading) -> float | None:
    """Median relative difference between where points of `a` should be from `b` and what is known there."""
    assert a.true_distance is not None and b.true_distance is not None
    assert a.true_world_from_cam is not None and b.true_world_from_cam is not None
    rows, columns = np.nonzero((a.true_distance > 0) & np.isfinite(a.true_distance) & a.valid)
    if not len(rows):
        return None
    step = max(1, len(rows) // _SAMPLES)
    rows, columns = rows[step // 2 :: step], columns[step // 2 :: step]
    rays = a.camera.rays()[0][rows, columns]
    distance = reading.distance(a.true_distance[rows, columns].astype(np.float64), rays[:, 2])
    b_from_a = np.linalg.inv(reading.pose(b.true_world_from_cam)) @ reading.pose(a.true_world_from_cam)
    points = rays * distance[:, None] @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    pixels, seen = b.camera.project(points)
    seen &= np.isfinite(pixels).all(1) & np.isfinite(points).all(1)
    u, v = np.where(seen[:, None], pixels, 0).clip(0, (b.camera.width - 1, b.camera.height - 1)).astype(int).T
    known = reading.distance(b.true_distance[v, u].astype(np.float64), b.camera.rays()[0][v, u, 2])
    seen &= b.valid[v, u] & np.isfinite(known) & (known > 0)
    if seen.sum() < max(20, _LEAST_SEEN * len(rows)):
        return None
    expected = np.linalg.norm(points, axis=1)
    return float(np.median(np.abs(expected[seen] / known[seen] - 1)))
