"""Calibrations as other programs keep them, in YAML or JSON: told by their keys, read into our lenses.

| program | its keys | its pixels begin at |
|---|---|---|
| Kalibr (camchain.yaml) | cam0: camera_model, intrinsics, distortion_model, distortion_coeffs, resolution | 0 |
| ORB-SLAM2, ORB-SLAM3 (settings) | Camera.fx or Camera1.fx, Camera.type, Camera.k1 | 0 |
| stella_vslam, OpenVSLAM (config) | Camera: model, fx, cols, rows | 0 |
| nerfstudio, instant-ngp (transforms.json) | fl_x or camera_angle_x, camera_model, w, h, k1 | 0.5, as COLMAP's |

`fields` hold everything in the file by its key in small letters. `size` (width, height) is that of the images, for
files that hold none.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lightdepth.camera import CameraModel, camera_from_params, camera_of, opencv_camera
from lightdepth.camera.foreign import (
    Bend,
    ForeignLens,
    double_sphere_bend,
    fov_bend,
    omni_bend,
    radial_bend,
)
from lightdepth.counting import with_article
from lightdepth.errors import InputError
from lightdepth.files.text import to_numbers

Fields = Mapping[str, Any]
Size = tuple[int, int] | None

FISHEYE_WORDS = ("fisheye", "equidistant", "equi", "opencvfisheye", "kannalabrandt", "kannalabrandt8", "kannalabrandt4")
"""Names of the lens with k1 k2 k3 k4 over the angle, in small letters alone."""


def letters(value: object) -> str:
    """A name without case, spaces and signs: `Kannala-Brandt` and kannala_brandt are the same."""
    return re.sub(r"[^a-z0-9]", "", str(value or "").lower())


def other_program(fields: Fields, where: str, size: Size) -> CameraModel | None:
    """The camera of a file of one of these programs, None where it is of none. Raises InputError, naming the program,
    where it has to be another file."""
    chain = [key for key in fields if re.fullmatch(r"cam\d+", key) and isinstance(fields[key], dict)]
    if chain and any("intrinsics" in map(str.lower, fields[key]) for key in chain):
        return _kalibr(fields, chain, where)
    flat = _flattened(fields)
    for prefix in ("camera1.", "camera."):
        if f"{prefix}fx" in flat:
            return _slam_settings(flat, prefix, where, size)
    if any(key in fields for key in ("fl_x", "camera_angle_x")) or _first_frame(fields).get("fl_x") is not None:
        return _nerfstudio(fields, where, size)
    return None


def _numbers(value: Any, where: str, counts: Sequence[int], expected: str) -> list[float]:
    rows = value if isinstance(value, list) else [value]
    flat = [v for row in rows for v in (row if isinstance(row, list) else [row])]
    found = to_numbers([str(v) for v in flat if v is not None], where, expected)
    if len(found) not in counts:
        raise InputError(where, f"{len(found)} numbers", f"expected {expected}")
    return found


def _number(fields: Fields, key: str, where: str, missing: float | None = None) -> float:
    if fields.get(key) is None:
        if missing is None:
            raise InputError(where, f"{key} missing", f"expected the number {key}")
        return missing
    return _numbers(fields[key], f"{where}: {key}", [1], "a number")[0]


def _pixels(value: float, where: str) -> int:
    if value != int(value):
        raise InputError(where, f"found {value:g}", "expected whole pixels")
    return int(value)


# ---- Kalibr


def _kalibr(fields: Fields, chain: Sequence[str], where: str) -> CameraModel:
    if len(chain) > 1:
        raise InputError(
            where,
            f"Kalibr's camchain of {len(chain)} cameras ({', '.join(chain)})",
            "expected one: copy the section of the camera that took these images to a file of its own",
        )
    key = chain[0]
    cam = {str(name).lower(): value for name, value in fields[key].items()}
    where = f"{where}: {key}"
    model, bent = letters(cam.get("camera_model", "pinhole")), letters(cam.get("distortion_model", "none"))
    counts = {"pinhole": 4, "omni": 5, "eucm": 6, "ds": 6}
    if model not in counts:
        raise InputError(f"{where}.camera_model", f"found {model!r}", f"expected one of {', '.join(counts)}")
    numbers = _numbers(
        cam.get("intrinsics", []), f"{where}.intrinsics", [counts[model]], f"the {counts[model]} of {model}"
    )
    size = _numbers(cam.get("resolution", []), f"{where}.resolution", [2], "width and height")
    width, height = (_pixels(v, f"{where}.resolution") for v in size)
    terms = _numbers(cam.get("distortion_coeffs") or [], f"{where}.distortion_coeffs", [0, 1, 4], "those of its model")
    own, focal = numbers[:-4], numbers[-4:]
    if model == "pinhole" and bent in FISHEYE_WORDS:
        return camera_from_params("OPENCV_FISHEYE", width, height, [*focal, *terms], where).with_pixel_center(0.0)
    if bent == "fov" and model == "pinhole":
        bend: Bend = fov_bend(*terms)
    elif bent not in ("radtan", "none", ""):
        raise InputError(f"{where}.distortion_model", f"found {bent!r}", "expected radtan, equidistant, fov or none")
    elif model == "pinhole":
        return camera_of(
            lambda: opencv_camera(width, height, [*focal, *(terms or [0.0] * 4)]), where
        ).with_pixel_center(0.0)
    elif model == "omni":
        bend = omni_bend(own[0], terms or [0.0] * 4)
    elif any(terms):
        raise InputError(where, f"{model} with {bent}", f"expected no distortion behind {with_article(model)} lens")
    elif model == "eucm":
        return camera_from_params("EUCM", width, height, [*focal, *own], where).with_pixel_center(0.0)
    else:
        bend = double_sphere_bend(*own)
    lens = ForeignLens(f"Kalibr's {model}-{bent}", width, height, (*focal,), bend)
    return camera_of(lambda: lens, where).with_pixel_center(0.0)


# ---- ORB-SLAM and stella_vslam


def _flattened(fields: Fields) -> dict[str, Any]:
    """`Camera: {fx: 1}` as `camera.fx: 1`, as OpenCV's YAML has it."""
    flat = dict(fields)
    for key, value in fields.items():
        if isinstance(value, dict) and key in ("camera", "camera1"):
            flat |= {f"{key}.{str(name).lower()}": v for name, v in value.items()}
    return flat


def _slam_settings(flat: Fields, prefix: str, where: str, size: Size) -> CameraModel:
    kind = next((letters(flat[k]) for k in ("camera.type", "camera.model") if flat.get(k)), "pinhole")
    camera = {key.removeprefix(prefix): value for key, value in flat.items() if key.startswith(prefix)}
    where = f"{where}: {prefix.rstrip('.').capitalize()}"
    focal = [_number(camera, name, where) for name in ("fx", "fy", "cx", "cy")]
    sides = [flat.get(f"camera.{a}", flat.get(f"camera.{b}")) for a, b in (("width", "cols"), ("height", "rows"))]
    if None not in sides:
        width, height = (_pixels(_numbers(v, where, [1], "whole pixels")[0], where) for v in sides)
    else:
        width, height = needed_size(size, where, "Camera.width and Camera.height")

    def terms(*names: str) -> list[float]:
        return [_number(camera, name, where, 0.0) for name in names]

    if kind in FISHEYE_WORDS:
        numbers = [*focal, *terms("k1", "k2", "k3", "k4")]
        return camera_from_params("OPENCV_FISHEYE", width, height, numbers, where).with_pixel_center(0.0)
    if kind == "radialdivision":
        numbers = [*focal, *terms("distortion")]
        return camera_from_params("DIVISION", width, height, numbers, where).with_pixel_center(0.0)
    if kind not in ("pinhole", "perspective", "rectified"):
        raise InputError(where, f"the lens {kind!r} is not known", "expected PinHole or KannalaBrandt8")
    numbers = [*focal, *terms("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    return camera_of(lambda: opencv_camera(width, height, numbers), where).with_pixel_center(0.0)


def needed_size(size: Size, where: str, what: str) -> tuple[int, int]:
    """The size of the images, for a file that holds none."""
    if size is None:
        raise InputError(
            where,
            f"holds no image size ({what} missing)",
            "add them, or convert it: `lightdepth convert-camera FILE --size '[WIDTH, HEIGHT]' -o camera.json`",
        )
    return size


# ---- nerfstudio


def _first_frame(fields: Fields) -> dict[str, Any]:
    frames = fields.get("frames")
    return frames[0] if isinstance(frames, list) and frames and isinstance(frames[0], dict) else {}


_NERF = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2")


def _nerfstudio(fields: Fields, where: str, size: Size) -> CameraModel:
    """nerfstudio's cameras are COLMAP's; OPENCV has radial terms k1 to k4, all of one polynomial."""
    frames = [f for f in fields.get("frames") or [] if isinstance(f, dict)]
    several = [{k: f.get(k, fields.get(k)) for k in _NERF} for f in frames if "fl_x" in f or "w" in f]
    if any(own != several[0] for own in several):
        raise InputError(
            where, "a transforms.json whose frames have different cameras", "give the frames of one camera at a time"
        )
    own = {**fields, **({k: v for k, v in several[0].items() if v is not None} if several else {})}
    if own.get("w") is not None and own.get("h") is not None:
        width, height = (_pixels(_number(own, side, where), f"{where}: {side}") for side in "wh")
    else:
        width, height = needed_size(size, where, "w and h")
    if own.get("fl_x") is not None:
        fx = _number(own, "fl_x", where)
    else:
        fx = width / 2 / float(np.tan(_number(own, "camera_angle_x", where) / 2))
    focal = [
        fx,
        _number(own, "fl_y", where, fx),
        *(_number(own, c, where, s / 2) for c, s in (("cx", width), ("cy", height))),
    ]
    model = letters(own.get("camera_model") or ("OPENCV_FISHEYE" if own.get("is_fisheye") else "OPENCV"))
    k1, k2, k3, k4, p1, p2 = (_number(own, k, where, 0.0) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model in FISHEYE_WORDS:
        return camera_from_params("OPENCV_FISHEYE", width, height, [*focal, k1, k2, k3, k4], where)
    if model not in ("opencv", "pinhole", "simplepinhole", "perspective", "simpleradial", "radial", "fullopencv"):
        raise InputError(
            f"{where}: camera_model", f"found {own.get('camera_model')!r}", "expected OPENCV or OPENCV_FISHEYE"
        )
    if k4:
        lens = ForeignLens("nerfstudio's OPENCV", width, height, (*focal,), radial_bend(k1, k2, k3, k4, p1=p1, p2=p2))
        return camera_of(lambda: lens, where)
    return camera_of(lambda: opencv_camera(width, height, [*focal, k1, k2, p1, p2, k3]), where)
