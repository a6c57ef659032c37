"""camera.json and light.json: our own calibration files, and JSON with the file named in every error."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict

from lightdepth.camera import CameraModel, camera_from_params
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.files.writing import write_whole
from lightdepth.photometry import PhotometricCalibration


def _pixel_center(value: float) -> float:
    if value not in (0.0, 0.5):
        raise ValueError("the centre of the first pixel is at 0.0 (OpenCV, SLAM exports) or 0.5 (COLMAP)")
    return value


class _CameraFile(BaseModel):
    model_config = ConfigDict(extra="forbid", protected_namespaces=())
    model: str
    width: int
    height: int
    params: list[float]
    pixel_center: Annotated[float, AfterValidator(_pixel_center)] = 0.5
    # How it was come by, where it was not calibrated: for whoever opens the file
    source: Literal["measured", "published", "given", "assumed", "self-calibrated"] | None = None
    focal_deviation: float | None = None
    note: str | None = None


class _LightFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gamma: float = 2.2
    mu: float = 2.767
    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    gain: float = 1.0
    reflectance: float = 0.0
    source: Literal["measured", "published", "given", "assumed"] = "given"


def camera_from_fields(data: Any, where: str) -> CameraModel:
    """The camera of camera.json's fields, wherever they are written; `where` names the place in errors."""
    found = checked_fields(_CameraFile, data, where)
    camera = camera_from_params(found.model, found.width, found.height, found.params, where)
    return camera.with_pixel_center(found.pixel_center)


def write_camera_json(camera: CameraModel, path: Path) -> None:
    write_whole(path, json.dumps(_fields_of(camera), indent=1) + "\n")


def write_found_camera(camera: CameraModel, path: Path, source: str, deviation: float | None, note: str) -> None:
    """camera.json of a camera that nobody calibrated: where it is from, the focal length's standard deviation as a
    share of it, where known, and a sentence."""
    told = {} if deviation is None else {"focal_deviation": round(deviation, 5)}
    write_whole(path, json.dumps({**_fields_of(camera), "source": source, **told, "note": note}, indent=1) + "\n")


def _fields_of(camera: CameraModel) -> dict[str, object]:
    data = {"model": camera.name, "width": camera.width, "height": camera.height, "params": list(camera.params)}
    return {**data, "pixel_center": 0.5}


def light_from_text(text: str) -> PhotometricCalibration:
    """Values written out as `gamma=2.2,mu=0`."""
    where = f"--light {text}"
    pairs = [[side.strip() for side in part.split("=", 1)] for part in text.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise InputError(
            where,
            "not pairs of a name and a number",
            "expected name=number pairs such as gamma=2.2,mu=0; vectors need a light.json",
        )
    return _light(dict(pairs), where)


def read_light_json(path: Path) -> PhotometricCalibration:
    """light.json -> light."""
    return _light(read_json(path), str(path))


def _light(data: Any, where: str) -> PhotometricCalibration:
    values = checked_fields(_LightFile, data, where).model_dump()
    try:
        return PhotometricCalibration(**values)
    except InputError as error:
        raise error.within(where) from error


def write_light_json(light: PhotometricCalibration, path: Path) -> None:
    write_whole(path, json.dumps(asdict(light), indent=1) + "\n")
