"""vicalib's rig XML, as EndoMapper ships it: the geometry of the lens, and the photometry of light and response.

Geometry: `camera/camera_model` with `type`, `width`, `height`, `params` = [ a; b; ... ]. The types known:
`calibu_fu_fv_u0_v0` (pinhole), `..._k1_k2` (poly2: r (1 + k1 r² + k2 r⁴), Brown without tangential terms),
`..._k1_k2_k3` (poly3, with k3 r⁶), `..._kb4` (Kannala-Brandt) and EndoMapper's `ocamcalib_cx_cy_a0_a2_a3_a4_e_f_g`
(Scaramuzza with a1 = 0 and the stretch [[e, f], [g, 1]], as its photometric calibration has it). vicalib fits ellipses
to images by integer pixel: the first one's centre is at (0, 0). (EndoMapper's own COLMAP runs, in COLMAP's convention,
refined the same lens to a centre 0.6 and 0.7 pixels beyond.)

Photometry: `gamma`; under `light/light_model` mu, P (metres, camera axes), D, sigma. Sigma and a vignetting are not
part of our model: said in a warning. Elements beyond these are passed over. Entities and DTDs are refused.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightdepth.calibration.plain_text import cannot_hold
from lightdepth.calibration.xml_text import xml_root
from lightdepth.camera import (
    Brown,
    CameraModel,
    FullBrown,
    KannalaBrandt,
    Pinhole,
    Scaramuzza,
    camera_from_params,
    camera_of,
    opencv_camera,
)
from lightdepth.counting import counted
from lightdepth.errors import InputError
from lightdepth.files.text import to_numbers
from lightdepth.files.writing import write_whole
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_PINHOLE, _POLY2, _KB4 = "calibu_fu_fv_u0_v0", "calibu_fu_fv_u0_v0_k1_k2", "calibu_fu_fv_u0_v0_kb4"
_POLY3, _OCAM = "calibu_fu_fv_u0_v0_k1_k2_k3", "ocamcalib_cx_cy_a0_a2_a3_a4_e_f_g"
_COUNTS = {_PINHOLE: 4, _POLY2: 6, _POLY3: 7, _KB4: 8, _OCAM: 9}
_FARTHEST_LIGHT_M = 0.1  # no light on an endoscope's tip is farther from the lens: beyond, the unit is wrong


def read_vicalib(path: Path) -> CameraModel:
    """The one camera of a geometric calibration."""
    root = xml_root(path)
    model = _only(root, "camera_model", path)
    kind = model.get("type", "")
    if kind == "gamma":
        raise InputError(
            path, "a photometric calibration (type gamma)", f"expected a geometric one. This is {option('light')}'s"
        )
    if kind not in _COUNTS:
        raise InputError(path, f"camera_model type {kind!r} is not known", f"expected one of {', '.join(_COUNTS)}")
    width, height = (_whole(model, tag, path) for tag in ("width", "height"))
    params = _numbers(model, "params", path, _COUNTS[kind])
    if kind == _OCAM:
        params = [*params[:3], 0.0, *params[3:]]
    if kind in (_POLY2, _POLY3):
        k1, k2, *k3 = params[4:]
        numbers = [*params[:4], k1, k2, 0.0, 0.0, *k3]
        return camera_of(lambda: opencv_camera(width, height, numbers), str(path)).with_pixel_center(0.0)
    name = {_PINHOLE: Pinhole.name, _KB4: KannalaBrandt.name, _OCAM: Scaramuzza.name}[kind]
    return camera_from_params(name, width, height, params, str(path)).with_pixel_center(0.0)


def write_vicalib(camera: CameraModel, path: Path) -> None:
    """A geometric calibration that EndoMapper's tools and vicalib's read."""
    params = camera.with_pixel_center(1.0).params  # half a pixel back, to vicalib's
    if isinstance(camera, KannalaBrandt):
        kind = _KB4
    elif isinstance(camera, FullBrown) and not any((camera.p1, camera.p2, camera.k4, camera.k5, camera.k6)):
        kind, params = _POLY3, (*params[:6], camera.k3)
    elif type(camera) is Brown and camera.p1 == camera.p2 == 0:
        kind, params = _POLY2, params[:6]
    elif isinstance(camera, Scaramuzza) and camera.a1 == 0:
        kind, params = _OCAM, (*params[:3], *params[4:])
    elif isinstance(camera, Pinhole):
        kind = _PINHOLE
    else:
        what = f"{camera.name} camera with tangential terms" if isinstance(camera, Brown) else f"{camera.name} camera"
        raise cannot_hold(path, "vicalib's XML", what, "OPENCV_FISHEYE", "PINHOLE")
    write_whole(
        path,
        "<rig>\n    <camera>\n"
        f'        <camera_model name="" index="0" serialno="0" type="{kind}" version="8">\n'
        f"            <width> {camera.width} </width>\n            <height> {camera.height} </height>\n"
        f"            <params> {_row(params)} </params>\n        </camera_model>\n    </camera>\n</rig>\n",
    )


def read_photometric(path: Path) -> PhotometricCalibration:
    """Light and response of EndoMapper's photometric calibration. Metres become millimetres."""
    root = xml_root(path)
    if root.find(".//light_model") is None and root.find(".//params") is not None:
        raise InputError(path, "a geometric calibration", f"expected a photometric one. This is {option('camera')}'s")
    light = _only(root, "light_model", path)
    if light.get("type", "sls") != "sls":
        raise InputError(path, f"light_model type {light.get('type')!r} is not known", "expected sls, one spot light")
    (gamma,) = _numbers(root, "gamma", path, 1)
    (mu,) = _numbers(light, "mu", path, 1)
    position, direction = (_numbers(light, tag, path, 3) for tag in "PD")
    distance = float(np.linalg.norm(position))
    if distance > _FARTHEST_LIGHT_M:
        raise InputError(
            path,
            f"P is {distance:g} from the lens",
            f"expected metres, below {_FARTHEST_LIGHT_M:g}. This looks like millimetres: divide it by 1000",
        )
    if light.find("sigma") is not None:
        (sigma,) = _numbers(light, "sigma", path, 1)
        if sigma != 1:
            warnings.warn(f"{path}: sigma {sigma:g} is ignored: brightness is the gain of each frame", stacklevel=3)
    if root.find(".//vignetting") is not None:
        warnings.warn(f"{path}: the vignetting is ignored: the model of the light has none", stacklevel=3)
    try:
        return PhotometricCalibration(
            gamma=gamma,
            mu=mu,
            position_mm=(1000 * position[0], 1000 * position[1], 1000 * position[2]),
            direction=(direction[0], direction[1], direction[2]),
            source="measured",
        )
    except InputError as error:
        raise error.within(path) from error


def write_photometric(light: PhotometricCalibration, path: Path) -> None:
    """EndoMapper's photometric calibration. It has no place for gain, reflectance, source and lamps."""
    metres = [v / 1000 for v in light.position_mm]
    write_whole(
        path,
        '<rig>\n    <camera>\n        <camera_model index="0" name="" serialno="0" type="gamma" version="1.0">\n'
        f"            <gamma> {_row([light.gamma])} </gamma>\n        </camera_model>\n    </camera>\n"
        '    <light>\n        <light_model type="sls" version="1.0">\n            <sigma> 1.0 </sigma>\n'
        f"            <mu> {light.mu!r} </mu>\n            <P> {_row(metres)} </P>\n"
        f"            <D> {_row(light.direction)} </D>\n        </light_model>\n    </light>\n</rig>\n",
    )


def _row(numbers: tuple[float, ...] | list[float]) -> str:
    return f"[ {'; '.join(repr(float(v)) for v in numbers)} ]"


def _only(root: Element, tag: str, path: Path) -> Element:
    found = list(root.iter(tag))
    if len(found) != 1:
        raise InputError(path, f"{len(found) or 'no'} elements {tag}", "expected one, in <rig>")
    return found[0]


def _numbers(parent: Element, tag: str, path: Path, count: int) -> list[float]:
    """The numbers of the element, written [ a; b; ... ] or bare."""
    found = parent.find(f".//{tag}")
    where, expected = f"{path}: {tag}", counted(count, "number")
    if found is None:
        raise InputError(where, "missing", f"expected {expected}")
    words = (found.text or "").translate(str.maketrans("[];,", "    ")).split()
    numbers = to_numbers(words, where, expected)
    if len(numbers) != count:
        raise InputError(where, f"{len(numbers)} numbers", f"expected {expected}")
    return numbers


def _whole(parent: Element, tag: str, path: Path) -> int:
    (value,) = _numbers(parent, tag, path, 1)
    if value != int(value):
        raise InputError(path, f"{tag} {value:g}", "expected whole pixels")
    return int(value)
