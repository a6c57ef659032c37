"""camera.json and light.json: our own calibration files, and JSON with the file named in every error."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from lightdepth.camera import CameraModel, Provenance, camera_from_params
from lightdepth.camera.provenance import CameraSource
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.files.writing import write_whole
from lightdepth.option_names import option
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
    # How it was come by: see Provenance
    source: CameraSource | None = None
    focal_deviation: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    note: str | None = None


class _LampsFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    positions_mm: tuple[tuple[float, float, float], ...]
    shares: tuple[float, ...]
    deviation_mm: tuple[float, float, float]
    lens_mu: float = 0.0


class _LightFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gamma: float = 2.2
    mu: float = 2.767
    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    gain: float = 1.0
    reflectance: float = 0.0
    source: Literal["measured", "fitted", "published", "given", "assumed"] = "given"
    lamps: _LampsFile | None = None  # of a light whose position was measured; earlier versions wrote none


def camera_from_fields(data: Any, where: str) -> CameraModel:
    """The camera of camera.json's fields, wherever they are written; `where` names the place in errors."""
    found = checked_fields(_CameraFile, data, where)
    camera = camera_from_params(found.model, found.width, found.height, found.params, where)
    camera = camera.with_pixel_center(found.pixel_center)
    if found.source is None:
        return camera
    return replace(camera, provenance=Provenance(found.source, found.focal_deviation, found.note))


def write_camera_json(camera: CameraModel, path: Path) -> None:
    write_whole(path, json.dumps(fields_of(camera), indent=1) + "\n")


def fields_of(camera: CameraModel) -> dict[str, object]:
    """camera.json's fields, from which `camera_from_fields` makes the camera again."""
    data = {"model": camera.name, "width": camera.width, "height": camera.height, "params": list(camera.params)}
    known = {} if camera.provenance is None else asdict(camera.provenance)
    return {**data, "pixel_center": 0.5} | {name: value for name, value in known.items() if value is not None}


def light_from_text(text: str) -> PhotometricCalibration:
    """Values written out as `gamma=2.2,mu=0`."""
    where = f"{option('light')} {text}"
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
    """light.json. Without lamps it is a file that every version reads."""
    fields = {name: value for name, value in asdict(light).items() if value is not None}
    write_whole(path, json.dumps(fields, indent=1) + "\n")
