"""Frames of an endoscope whose calibration nobody has: opened with a camera found from their own motion.

`--camera auto` finds it, `--fov DEGREES` is where to start, and what is assumed where the frames do not connect or
their motion hardly tells it. Some frames of a stretch are mapped by pycolmap (sfm.self_calibration); the camera is
written to camera.json in the run folder with its deviation, and said.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from lightdepth.calibration import write_camera
from lightdepth.calibration.json_files import camera_from_fields, fields_of
from lightdepth.camera import CameraModel, Provenance
from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.no_camera import NoCamera
from lightdepth.datasets.reading import size_of_frames
from lightdepth.errors import InputError
from lightdepth.files.working import working_folder
from lightdepth.frame import readable
from lightdepth.reporting.progress import Stages
from lightdepth.reporting.run import Run
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.self_calibration import SelfCalibration, across, self_calibrated

FRAMES = 24
"""Frames that are mapped to find a camera."""
_SECONDS_APART = 0.2  # an endoscope moves some millimetres in that time
_PLACES = 0.5, 0.25, 0.75  # of the sequence, where a stretch is looked for
_PART = "camera"  # of a run that is resumed


def open_frames(
    source: SequenceSource, run: Run, map_camera: CameraModel | None = None, config: SfmConfig | None = None
) -> FrameSequence:
    """The frames, under a camera that is found first where the source asks for that; written to the run's camera.json.
    `config` is how they are mapped for it.

    Raises InputError where no camera can be found and no field of view was given to assume.
    """
    if not source.asks_for_camera:
        try:
            return source.open(map_camera)
        except NoCamera as error:
            raise error.of_verb_that_finds_one() from error
    if map_camera is not None:
        check_camera_asked(source)
    return with_camera(source, run, config).open()


def check_camera_asked(source: SequenceSource) -> None:
    """Raises InputError where a camera is to be found for frames that have a map."""
    if source.asks_for_camera:
        raise InputError(
            "--camera auto" if source.fov is None else "--fov",
            "with a map, which has a camera already",
            "leave it out, or leave the map out, which is then made with the camera that is found",
        )


def with_camera(source: SequenceSource, run: Run, config: SfmConfig | None = None) -> SequenceSource:
    """The source with its camera in the run's camera.json, found first where it asks for that."""
    if not source.asks_for_camera:
        return source
    if run.plan is None and run.done(_PART):
        known = run.kept_of(_PART)
        run.record |= known["told"]
        camera = camera_from_fields(known["camera"], "the camera that was found")
    else:
        camera = found_camera(source, run, config)
        told = {name: run.record[name] for name in ("self_calibration",) if name in run.record}
        run.finish_part(_PART, [], {"camera": fields_of(camera), "told": told})
    write_camera(camera, run.folder / "camera.json")
    return replace(source, camera=run.folder / "camera.json", fov=None)


def found_camera(source: SequenceSource, run: Run, config: SfmConfig | None = None) -> CameraModel:
    """The camera of the source's frames, which says how sure it is; the one of its field of view where they do not
    connect, or where their motion hardly tells it. Said in the run."""
    width, height = size_of_frames(source.data, source.format)
    with working_folder() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the frames are opened again, under the camera that is found
        stand_in = folder / "camera.json"
        write_camera(across(width, height, source.fov or 70.0), stand_in)
        frames = replace(source, camera=stand_in, fov=None).open().without_truth()
        run.begins(
            f"{counted(len(frames), 'frame')}, {width}x{height}, whose camera is found first",
            lambda: _search(len(frames)),
        )
        try:
            found = _found(frames, source.fov, run, config)
        except InputError as error:
            if source.fov is None:
                raise
            return _assumed(run, (width, height), source.fov, error.found)
    run.record["self_calibration"] = {
        "focal_length_px": round(found.camera.focal_length, 3),
        "deviation": round(found.deviation, 5),
        "told_by_the_motion": found.told,
        "frames": found.mapped,
        "focal_lengths_from_starts_px": list(found.from_starts),
    }
    if source.fov is not None and found.leaves_stated_field:
        why = f"the motion of {found.mapped} of {found.frames} frames does not tell it ({found.found})"
        return _assumed(run, (width, height), source.fov, why)
    (run.log if found.told else run.warn)(str(found))
    return replace(found.camera, provenance=Provenance("self-calibrated", round(found.deviation, 5), str(found)))


def _search(count: int) -> list[Step]:
    return [Step(f"finding the camera by the motion of {counted(min(count, FRAMES), 'frame')}, then all else")]


def _assumed(run: Run, size: tuple[int, int], fov: float, why: str) -> CameraModel:
    """The pinhole of a field that was stated, degrees across the width, and why nothing better is known."""
    note = f"the camera is assumed: a pinhole {fov:g} degrees across, as --fov says, not calibrated: {why}"
    note = f"{note}; lengths and shapes may be wrong"
    run.warn(note)
    return replace(across(*size, fov), provenance=Provenance("assumed", None, note))


def _found(frames: FrameSequence, fov: float | None, run: Run, config: SfmConfig | None) -> SelfCalibration:
    """By the first stretch whose motion tells the focal length, else by the one that tells most."""
    seen: list[SelfCalibration] = []
    failed: InputError | None = None
    tried: list[list[int]] = []
    times = [*(frame.time for frame in islice(readable(frames, range(len(frames))), 2)), None, None][:2]
    for place in _PLACES:
        rows = stretch(len(frames), times, place)
        if rows in tried:
            continue
        tried.append(rows)
        run.log(f"camera: {len(rows)} frames from {frames.names[rows[0]]} to {frames.names[rows[-1]]} are mapped")
        try:
            with Stages("camera") as told_of:
                seen.append(self_calibrated(frames.at(rows), config, told_of, fov))
        except InputError as error:
            failed = failed or error
            continue
        if seen[-1].told:
            return seen[-1]
    if not seen:
        assert failed is not None
        raise failed
    return min(seen, key=lambda each: each.deviation)


def stretch(count: int, times: Sequence[float | None], place: float) -> list[int]:
    """Rows of up to `FRAMES` frames about a place of a sequence, a share of it, so far apart that the camera moves."""
    first, second = times
    step = 1 / 30 if first is None or second is None or second <= first else second - first
    apart = int(np.clip(round(_SECONDS_APART / step), 1, max(1, count // FRAMES)))
    taken = min(FRAMES, (count - 1) // apart + 1)
    start = int(np.clip(round(place * count - apart * taken / 2), 0, count - 1 - apart * (taken - 1)))
    return [start + apart * i for i in range(taken)]
