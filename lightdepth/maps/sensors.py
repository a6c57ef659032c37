"""One camera of a map that has several: a rig's sensors, or folders of images in one model.

Frames of two sensors have the same numbers. One folder, or one sensor, is taken: the one that was named, else the one
whose name is that of the folder of frames.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from lightdepth.errors import InputError
from lightdepth.maps.convention import MapConvention
from lightdepth.which_frame import WhichFrame


class _Image(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def camera_id(self) -> int: ...


_I = TypeVar("_I", bound=_Image)


def of_one_sensor(images: Sequence[_I], convention: MapConvention, where: Path | str) -> Sequence[_I]:
    """The images that are of the folder or sensor asked for; all, where their numbers are unique and nothing was asked.

    Raises InputError, naming folders and sensors, where two images have one number and nothing tells them apart."""
    folders, sensors = _counts(images)
    if convention.folder is not None:
        wanted = convention.folder.strip("/").replace("\\", "/")
        known = {f for f in folders if f == wanted} or {f for f in folders if f.rsplit("/", 1)[-1] == wanted}
        if len(known) != 1:
            raise InputError("--map-folder", f"{wanted!r}", f"expected one of the map's folders: {_listed(folders)}")
        images = [i for i in images if _folder(i) in known]
    if convention.sensor is not None:
        if convention.sensor not in sensors:
            raise InputError("--map-sensor", f"{convention.sensor}", f"expected one of {_listed(sensors)}")
        images = [i for i in images if i.camera_id == convention.sensor]
        if not images:
            raise InputError("--map-sensor", f"{convention.sensor}", f"it has no image in folder {convention.folder!r}")
    twice = _twice(images)
    if twice is None:
        return images
    folders, sensors = _counts(images)
    beside = convention.frames.folder if convention.frames is not None else ""
    parts = Path(beside).parts[::-1]
    alike = [f for name in parts[:2] for f in folders if f and f.rsplit("/", 1)[-1] == name][:1]
    if alike and _twice(mine := [i for i in images if _folder(i) == alike[0]]) is None:
        return mine
    options = []
    if len(folders) > 1:
        options.append(f"--map-folder, one of {_listed(folders)}")
    if len(sensors) > 1:
        options.append(f"--map-sensor, one of {_listed(sensors)}")
    cure = f"give {', or '.join(options)}" if options else "a keyframe's number must be unique"
    raise InputError(where, f"frame {twice[0]} is in it twice, {twice[1]} and {twice[2]}", cure)


def _folder(image: _Image) -> str:
    return WhichFrame.named(image.name).folder


def _counts(images: Sequence[_Image]) -> tuple[Counter[str], Counter[int]]:
    return Counter(map(_folder, images)), Counter(i.camera_id for i in images)


def _twice(images: Sequence[_Image]) -> tuple[int, str, str] | None:
    """The first number that two images have, and their names."""
    names: dict[int, list[str]] = defaultdict(list)
    for image in images:
        names[WhichFrame.named(image.name).number].append(image.name)
    found = sorted(number for number, of in names.items() if len(of) > 1)
    return (found[0], *sorted(names[found[0]])[:2]) if found else None  # type: ignore[return-value]  # two at the least


def _listed(counts: Counter[str] | Counter[int]) -> str:
    return ", ".join(f"{name if name != '' else '.'} ({count} images)" for name, count in sorted(counts.items()))
