"""Maps of stella_vslam and OpenVSLAM: one file, msgpack (.msg) or the same fields as .json.

    cameras    {name: {model_type, cols, rows, fps, fx, fy, cx, cy, k1, ...}}
    keyframes  {id: {ts [s], src_frm_id (gone in 0.6), cam, rot_cw [x y z w], trans_cw, lm_ids,
                     keypts [{pt: [u, v]}], undists [[u, v]]}}
    landmarks  {id: {pos_w}}

Poses are camera-from-map, pixels OpenCV's (the first one's centre at (0, 0)), a landmark id of -1 is none. `keypts` are
where the lens put them, `undists` and the later `undist_keypts` where a pinhole camera with the same K would.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from lightdepth.calibration import read_camera
from lightdepth.camera import (
    Brown,
    CameraModel,
    FullBrown,
    KannalaBrandt,
    Pinhole,
    camera_from_params,
    camera_of,
    opencv_camera,
)
from lightdepth.counting import full_stop
from lightdepth.errors import InputError
from lightdepth.files.reading import check_bytes, reading
from lightdepth.files.rotations import pose_from_quaternion, quaternion_from_pose
from lightdepth.files.schema import read_json
from lightdepth.files.tum import read_tum
from lightdepth.maps.colmap import assembled
from lightdepth.maps.convention import EXPORTER, MapConvention, Reader
from lightdepth.sparse_map import Keyframe, Submap, at_its_place
from lightdepth.which_frame import Clock, frame_number

_MOST_BYTES = 1 << 30
_LONGEST = 2**16
"""Numbers of keypoints of a keyframe: msgpack makes room for a list when it is announced, at each of 512 depths."""
Begun = tuple[float, str] | None
_LENSES = {  # model_type -> the fields of its distortion; Perspective has a k3 besides, which older versions leave out
    "Perspective": ("k1", "k2", "p1", "p2"),
    "Fisheye": ("k1", "k2", "k3", "k4"),
    "RadialDivision": ("distortion",),
}


def read_stella(path: Path, reader: Reader = Reader(), map_id: int = 0, begun: Begun = None) -> Submap:
    """The map in a .msg or .json file. `begun` is the first stamp of its clock that is known elsewhere, and where.
    Raises InputError naming file and field."""
    path = Path(path)
    content = _content(path)
    cameras = _Cameras(path, content.get("cameras"), reader.convention(path.parent, map_id, EXPORTER))
    found = {f"{path}: keyframes.{key}": entry for key, entry in _section(content, "keyframes", path).items()}
    entries = {where: _record(entry, where) for where, entry in found.items()}
    names = _names(entries, cameras, path, begun)
    named = zip(entries.items(), names, strict=True)
    keyframes = [_keyframe(entry, where, name, cameras) for (where, entry), name in named]
    ids, points = [], []
    for key, entry in _section(content, "landmarks", path).items():
        where = f"{path}: landmarks.{key}"
        ids.append(_integer(key, where))
        points.append(_numbers(_record(entry, where), "pos_w", 3, where))
    if not points:
        raise InputError(path, "landmarks: no points in it", "an empty map cannot be densified, leave it out")
    submap = assembled(path, map_id, keyframes, np.array(ids, np.int64), np.array(points).reshape(-1, 3))
    clock = cameras.clock(entries)
    return replace(
        submap, localised=_localised(path, _first(content), clock, begun), guessed_clock=_guesses(entries, clock)
    )


def _localised(path: Path, first: float | None, clock: Clock, begun: Begun) -> tuple[int, ...] | None:
    """Numbers of the frames in the trajectory beside a map, which may be of another run: where its first keyframe's
    time is not in it, nothing is known."""
    trajectory = path.parent / "frame_trajectory.txt"
    if not trajectory.is_file() or first is None or len(list(path.parent.glob("*.msg"))) > 1:
        return None
    try:
        times = read_tum(trajectory)[0]
        if np.abs(times - first).min(initial=np.inf) > 1e-3:
            return None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the clock was told with the keyframes
            return tuple(map(frame_number, clock.names(times, trajectory, begun)))
    except InputError:
        return None


def _content(path: Path) -> Mapping[str, Any]:
    if path.suffix.lower() == ".json":
        content = read_json(path)
    else:
        with reading(path, "msgpack, or copied incompletely", "copy it again"):
            check_bytes(path.stat().st_size, _MOST_BYTES, path, "map")
            content = msgpack.unpackb(path.read_bytes(), strict_map_key=False, max_array_len=_LONGEST)
    if not isinstance(content, dict):
        raise InputError(path, f"found {type(content).__name__}", "expected a map with cameras, keyframes, landmarks")
    return content


def _section(content: Mapping[str, Any], name: str, path: Path) -> Mapping[Any, Any]:
    if name not in content:
        raise InputError(path, f"{name} missing", "expected a stella_vslam map with cameras, keyframes, landmarks")
    return _record(content[name], f"{path}: {name}")


def _record(value: Any, where: str) -> Mapping[Any, Any]:
    if not isinstance(value, dict):
        raise InputError(where, f"found {type(value).__name__}", "expected fields by name")
    return value


def _field(entry: Mapping[Any, Any], name: str, where: str) -> Any:
    if name not in entry:
        raise InputError(f"{where}.{name}", "missing", "expected the fields that stella_vslam writes")
    return entry[name]


def _integer(value: Any, where: str) -> int:
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(where, f"found {value!r}", "expected an integer") from None
    if abs(number) >= 2**63:
        raise InputError(where, f"found {number}", "expected an integer below 2^63")
    return number


def _numbers(entry: Mapping[Any, Any], name: str, count: int, where: str) -> np.ndarray:
    """(count,) finite numbers."""
    value = _field(entry, name, where)
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise InputError(f"{where}.{name}", f"found {str(value)[:60]}", f"expected {count} finite numbers")
    return numbers


# ---- keyframes


def _keyframe(entry: Mapping[Any, Any], where: str, frame: str, cameras: _Cameras) -> Keyframe:
    convention = cameras.convention
    x, y, z, w = _numbers(entry, "rot_cw", 4, where)
    pose = pose_from_quaternion(np.array([w, x, y, z]), _numbers(entry, "trans_cw", 3, where), f"{where}.rot_cw")
    if "keypts" not in entry:
        convention = replace(convention, keypoints="undistorted")
    pixels, name = _keypoints(entry, where)
    landmarks = _field(entry, "lm_ids", where)
    if not isinstance(landmarks, list) or len(landmarks) != len(pixels):
        found = len(landmarks) if isinstance(landmarks, list) else type(landmarks).__name__
        raise InputError(f"{where}.lm_ids", f"found {found}", f"expected one for each of the {len(pixels)} {name}")
    ids = np.array([_integer(i, f"{where}.lm_ids") for i in landmarks], np.int64)
    held = ids >= 0
    if not np.isfinite(pixels[held]).all():
        raise InputError(f"{where}.{name}", "NaN or infinite keypoints", "expected pixels")
    camera = cameras.named(str(_field(entry, "cam", where)))
    return convention.keyframe(frame, camera, pose, pixels[held], ids[held])


def _names(entries: Mapping[str, Mapping[Any, Any]], cameras: _Cameras, path: Path, begun: Begun) -> list[str]:
    """Each keyframe's frame: by src_frm_id, which stella_vslam no longer writes, else by its time."""
    if _counted(entries, cameras.convention.clock):
        return [f"{_integer(e['src_frm_id'], f'{where}.src_frm_id'):06d}.png" for where, e in entries.items()]
    times = np.array([_time(entry, where) for where, entry in entries.items()])
    return cameras.clock(entries).names(times, path, begun)


def _counted(entries: Mapping[str, Mapping[Any, Any]], clock: Clock) -> bool:
    """Whether keyframes meet frames by src_frm_id, a count from 0: not where frames are numbered by their times."""
    by_time = clock.frames is not None and clock.frames.numbered_by_time
    return not by_time and all("src_frm_id" in entry for entry in entries.values())


def _guesses(entries: Mapping[str, Mapping[Any, Any]], clock: Clock) -> bool:
    """Whether the keyframes' times are of a clock whose beginning had to be guessed."""
    if _counted(entries, clock):
        return False
    return clock.guesses(np.array([_time(entry, where) for where, entry in entries.items()]))


def _time(entry: Mapping[Any, Any], where: str) -> float:
    return float(_numbers({"ts": [_field(entry, "ts", where)]}, "ts", 1, where)[0])


def declared_rate(path: Path) -> float | None:
    """Frames per second of a map's only camera; None where it does not tell one."""
    section = _content(path).get("cameras")
    entries = section.values() if isinstance(section, dict) else ()
    rates = {entry.get("fps") for entry in entries if isinstance(entry, dict)}
    known = [rate for rate in rates if isinstance(rate, int | float) and rate > 0]
    return float(known[0]) if len(known) == 1 else None


def first_stamp(path: Path) -> float | None:
    """The first time of a map's keyframes; None where it tells none."""
    return _first(_content(path))


def _first(content: Mapping[str, Any]) -> float | None:
    entries = content.get("keyframes")
    values = entries.values() if isinstance(entries, dict) else ()
    times = [entry.get("ts") for entry in values if isinstance(entry, dict)]
    return min((float(t) for t in times if isinstance(t, int | float)), default=None)


def _keypoints(entry: Mapping[Any, Any], where: str) -> tuple[np.ndarray, str]:
    """Pixels (n, 2), and the field they came from."""
    name = next((n for n in ("keypts", "undists", "undist_keypts") if n in entry), None)
    if name is None:
        raise InputError(where, "no keypts and no undists", "expected one of them, a pixel for each of lm_ids")
    try:
        points = [p["pt"] if isinstance(p, dict) else p for p in entry[name]]
        return np.array(points, np.float64).reshape(len(points), 2), name
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{where}.{name}", "not pixels", "expected [u, v], or {pt: [u, v]}, for each keypoint"
        ) from None


# ---- cameras


class _Cameras:
    """The cameras of a file by name: its own where it describes them wholly, else camera.json beside it."""

    def __init__(self, path: Path, section: Any, convention: MapConvention) -> None:
        self.path, self.section, self.convention = path, section, convention
        self._known: dict[str, CameraModel] = {}

    def named(self, name: str) -> CameraModel:
        if name not in self._known:
            self._known[name] = self._read(name)
        return self._known[name]

    def clock(self, entries: Mapping[str, Mapping[Any, Any]]) -> Clock:
        """How times are counted: as was declared, else at the rate of the camera's own section, by which the program
        made the times of a video."""
        clock = self.convention.clock
        names = {str(entry.get("cam")) for entry in entries.values()}
        section = self.section if isinstance(self.section, dict) else {}
        rates = {section[name].get("fps") for name in names if isinstance(section.get(name), dict)}
        known = [rate for rate in rates if isinstance(rate, int | float) and rate > 0]
        return replace(clock, fps=float(known[0])) if clock.fps is None and len(known) == 1 else clock

    def _read(self, name: str) -> CameraModel:
        try:
            where = f"{self.path}: cameras.{name}"
            section = _record({} if self.section is None else self.section, f"{self.path}: cameras")
            return _camera(_record(_field(section, name, f"{self.path}: cameras"), where), where)
        except InputError as error:
            beside = self.path.parent / "camera.json"
            if not beside.is_file():
                raise InputError(
                    error.where, error.found, f"{full_stop(error.cure)} Correct it, or put camera.json beside the map"
                ) from error
            return self.convention.from_ours(read_camera(beside))


def _camera(entry: Mapping[Any, Any], where: str) -> CameraModel:
    """In the file's own pixels; a lens that none of ours is exactly becomes the nearest, which is said. Raises
    InputError for one that is not known, and for a field that is missing."""
    model = str(_field(entry, "model_type", where))
    if model not in _LENSES:
        raise InputError(f"{where}.model_type", f"found {model!r}", f"expected {' or '.join(_LENSES)}")

    def number(field: str) -> float:
        return float(_numbers({field: [_field(entry, field, where)]}, field, 1, where)[0])

    width, height = int(number("cols")), int(number("rows"))
    numbers = [number(field) for field in ("fx", "fy", "cx", "cy", *_LENSES[model])]
    if model == "Fisheye":
        return camera_of(lambda: KannalaBrandt(width, height, *numbers), where)
    if model == "RadialDivision":
        return camera_from_params("DIVISION", width, height, numbers, where)
    if "k3" in entry:
        numbers.append(number("k3"))
    return camera_of(lambda: opencv_camera(width, height, numbers), where)


# ---- writing


def write_stella(submap: Submap, path: Path) -> None:
    """A submap as stella_vslam has it, .msg or .json by the suffix; without descriptors, so not to be tracked in.

    Keyframes are numbered in their order, src_frm_id is their frame number. Raises InputError for a Scaramuzza lens.
    """
    path, submap = Path(path), at_its_place(submap)
    path.parent.mkdir(parents=True, exist_ok=True)
    cameras = list(dict.fromkeys(k.camera for k in submap.keyframes))
    content = {
        "cameras": {f"camera {n}": _camera_fields(camera) for n, camera in enumerate(cameras)},
        "keyframes": {
            str(n): _keyframe_fields(k, f"camera {cameras.index(k.camera)}") for n, k in enumerate(submap.keyframes)
        },
        "landmarks": {
            str(i): {"pos_w": xyz} for i, xyz in zip(submap.point_ids.tolist(), submap.points.tolist(), strict=True)
        },
    }
    if path.suffix.lower() == ".json":
        path.write_text(json.dumps(content), encoding="utf-8")
    else:
        path.write_bytes(msgpack.packb(content))


def _keyframe_fields(keyframe: Keyframe, camera: str) -> dict[str, Any]:
    w, x, y, z = quaternion_from_pose(keyframe.cam_from_map).tolist()
    return {
        "src_frm_id": keyframe.number,
        "cam": camera,
        "rot_cw": [x, y, z, w],
        "trans_cw": keyframe.cam_from_map[:3, 3].tolist(),
        "n_keypts": len(keyframe.pixels),
        "keypts": [{"pt": pixel} for pixel in (keyframe.pixels - 0.5).tolist()],
        "lm_ids": keyframe.point_ids.tolist(),
    }


def _camera_fields(camera: CameraModel) -> dict[str, Any]:
    models: dict[type, str] = {
        Pinhole: "Perspective",
        Brown: "Perspective",
        FullBrown: "Perspective",
        KannalaBrandt: "Fisheye",
    }
    if type(camera) not in models or (isinstance(camera, FullBrown) and any((camera.k4, camera.k5, camera.k6))):
        raise InputError(f"{camera.name} camera", "stella_vslam has no such lens", f"expected {' or '.join(_LENSES)}")
    model = models[type(camera)]
    params = camera.with_pixel_center(1.0).params  # moves the origin by -0.5: ours to OpenCV's
    terms = dict.fromkeys(_LENSES[model], 0.0) | dict(zip(_LENSES[model], params[4:], strict=False))
    focal = dict(zip(("fx", "fy", "cx", "cy"), params[:4], strict=True))
    third = {"k3": camera.k3 if isinstance(camera, FullBrown) else 0.0} if model == "Perspective" else {}
    return {"model_type": model, "cols": camera.width, "rows": camera.height, **focal, **terms, **third}
