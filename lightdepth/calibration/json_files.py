"""camera.json and light.json: our own calibration files, and JSON with the file named in every error."""

from __future__ import annotations

import json
from dataclasses import asdict
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from lightdepth.calibration.plain_text import write_text
from lightdepth.camera import CameraModel, camera_from_params
from lightdepth.errors import InputError
from lightdepth.photometry import PhotometricCalibration

_Schema = TypeVar("_Schema", bound=BaseModel)


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


class _LightFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gamma: float = 2.2
    mu: float = 2.767
    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    gain: float = 1.0
    reflectance: float = 0.0
    source: Literal["measured", "published", "assumed"] = "assumed"


def read_json(path: Path) -> Any:
    """Parsed JSON, with the file named in every error."""
    try:
        return json.loads(Path(path).read_text())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error


def checked_fields(schema: type[_Schema], data: Any, where: str) -> _Schema:
    """The fields of a file as its schema has them; `where` names the file in the InputError of what does not fit."""
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        *above, last = [str(part) for part in first["loc"] if part != "[key]"] or ["the file"]
        field = ".".join([*above, last])
        known = _known(schema, above)
        expected = f"; expected {', '.join(known)}" if known else ""
        if first["type"] == "missing":
            message = f"{field} missing{expected}"
        elif first["type"] == "extra_forbidden":
            close = get_close_matches(last, known, 1, cutoff=0.75)
            message = f"{field} is not known{f' (is {close[0]} meant?)' if close else ''}{expected}"
        else:
            message = f"{field}: {first['msg'].removeprefix('Value error, ')}"
            found = first["input"]
            if isinstance(found, str | int | float | bool | None) and repr(found) not in message:
                message += f"; found {found!r}"
        raise InputError(f"{where}: {message}") from error


def _known(schema: type[BaseModel], above: list[str]) -> list[str]:
    """The fields below the keys `above`; none where these lead to something else than a schema."""
    for key in above:
        inner = schema.model_fields[key].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        schema = inner
    return list(schema.model_fields)


def read_camera_json(path: Path) -> CameraModel:
    """camera.json -> camera, brought to our pixel convention."""
    return camera_from_fields(read_json(path), str(path))


def camera_from_fields(data: Any, where: str) -> CameraModel:
    """The camera of camera.json's fields, wherever they are written; `where` names the place in errors."""
    found = checked_fields(_CameraFile, data, where)
    camera = camera_from_params(found.model, found.width, found.height, found.params, where)
    return camera.with_pixel_center(found.pixel_center)


def write_camera_json(camera: CameraModel, path: Path) -> None:
    data = {"model": camera.name, "width": camera.width, "height": camera.height, "params": list(camera.params)}
    write_text(path, json.dumps({**data, "pixel_center": 0.5}, indent=1) + "\n")


def light_from_text(text: str) -> PhotometricCalibration:
    """Values written out as `gamma=2.2,mu=0`."""
    where = f"--light {text}"
    pairs = [[side.strip() for side in part.split("=", 1)] for part in text.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise InputError(f"{where}: expected name=number pairs such as gamma=2.2,mu=0; vectors need a light.json")
    return _light(dict(pairs), where)


def read_light_json(path: Path) -> PhotometricCalibration:
    """light.json -> light."""
    return _light(read_json(path), str(path))


def _light(data: Any, where: str) -> PhotometricCalibration:
    values = checked_fields(_LightFile, data, where).model_dump()
    try:
        return PhotometricCalibration(**values)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def write_light_json(light: PhotometricCalibration, path: Path) -> None:
    write_text(path, json.dumps(asdict(light), indent=1) + "\n")
