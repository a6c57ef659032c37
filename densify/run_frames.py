"""The frames that a run was made of, where they still are."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

from densify.dense_map import map_folders, run_record
from lightdepth.calibration import read_camera
from lightdepth.datasets import FORMATS, FrameSequence, open_sequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame


def run_frames(
    source: Path, given: Path | None = None, record: Mapping[str, object] | None = None
) -> tuple[FrameSequence | None, str]:
    """The frames that were given, or those that a run names, under its own camera and mask; and where they are not
    found, a sentence that says so, else an empty one. `record` is in the place of a run.json that is not there yet.
    Raises InputError where they cannot be read."""
    arguments = (run_record(source) if record is None else record).get("arguments")
    named = arguments if isinstance(arguments, Mapping) else {}
    folder = map_folders(source)[0].parent
    beside = folder / "data" if (folder / "data").is_dir() else None  # where `demo` has them
    path = given or (Path(str(named["data"])) if named.get("data") else beside)
    if path is None or not _is_there(path):
        return None, f"the run's frames are not found{f' ({path})' if path else ''}"
    own = {key: Path(str(named[key])) for key in ("camera", "mask") if named.get(key)}
    own = {key: file for key, file in own.items() if file.exists()}
    known = next((name for name in FORMATS if name == named.get("format")), None)
    camera = None if "camera" in own else read_camera(map_folders(source)[0] / "camera.json")
    return open_sequence(path, known, own.get("camera"), None, own.get("mask"), camera), ""


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have, or a folder that may not be looked into
        return False


def frame_of(frames: FrameSequence | None, number: int) -> Frame | None:
    """The frame with this number; None where there is none, or it cannot be read, which is warned of."""
    try:
        return None if frames is None else frames.by_number(number)
    except InputError as error:
        warnings.warn(f"without its picture: {error}", stacklevel=2)
        return None
