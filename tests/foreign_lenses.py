"""Lenses of other programs: some of COLMAP's, and some drawn at random with the files that people keep them in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lightdepth.native import pycolmap

_F = (400.0, 410.0, 322.0, 238.0)


@dataclass(frozen=True)
class ColmapLens:
    """A camera of COLMAP's of 640x480, and the model of ours that it is exactly, "" where there is none."""

    model: str
    params: Sequence[float]
    exact: str = ""


COLMAP_LENSES = {
    "simple fisheye": ColmapLens("SIMPLE_FISHEYE", (400.0, 322.0, 238.0), "OPENCV_FISHEYE"),
    "fisheye": ColmapLens("FISHEYE", _F, "OPENCV_FISHEYE"),
    "full opencv, zeros": ColmapLens("FULL_OPENCV", (*_F, -0.2, 0.05, 0.001, 0.002, 0, 0, 0, 0), "OPENCV"),
    "full opencv, all zeros": ColmapLens("FULL_OPENCV", (*_F, *[0.0] * 8), "PINHOLE"),
    "full opencv, k3": ColmapLens("FULL_OPENCV", (*_F, -0.2, 0.05, 0.001, 0.002, -0.01, 0, 0, 0), "FULL_OPENCV"),
    "full opencv": ColmapLens("FULL_OPENCV", (*_F, 0.3, 0.1, 0.001, 0.0005, 0.02, 0.5, 0.2, 0.01), "FULL_OPENCV"),
    "thin prism, zeros": ColmapLens(
        "THIN_PRISM_FISHEYE", (*_F, 0.02, 0.003, 0, 0, 0.001, 0.0002, 0, 0), "OPENCV_FISHEYE"
    ),
    "aria, zeros": ColmapLens(
        "RAD_TAN_THIN_PRISM_FISHEYE", (*_F, 0.02, 0.003, 0.001, 0.0002, *[0.0] * 8), "OPENCV_FISHEYE"
    ),
    "eucm, alpha 0": ColmapLens("EUCM", (*_F, 0.0, 1.0), "PINHOLE"),
    "division": ColmapLens("DIVISION", (*_F, -0.2)),
    "simple division": ColmapLens("SIMPLE_DIVISION", (400.0, 322.0, 238.0, -0.3)),
    "eucm": ColmapLens("EUCM", (*_F, 0.6, 1.1)),
    "fov": ColmapLens("FOV", (*_F, 0.9)),
    "thin prism": ColmapLens("THIN_PRISM_FISHEYE", (*_F, 0.02, 0.003, 2e-4, 1e-4, 0.001, 0.0002, 1e-4, 1e-4)),
    "aria": ColmapLens(
        "RAD_TAN_THIN_PRISM_FISHEYE",
        (*_F, 0.02, 0.003, 0.001, 0.0002, 1e-4, -2e-4, 3e-4, -1e-4, 2e-4, 1e-4, -3e-4, 5e-5),
    ),
}


def pycolmap_pixels(lens: ColmapLens, rays: np.ndarray) -> np.ndarray:
    camera = pycolmap().Camera(model=lens.model, width=640, height=480, params=list(lens.params))
    return np.asarray(camera.img_from_cam(rays), float)


@dataclass(frozen=True)
class Drawn:
    """A lens that cv2 projects through: K (3, 3), first pixel at (0, 0), and its coefficients."""

    width: int
    height: int
    matrix: list[list[float]]
    terms: list[float]
    fisheye: bool

    @property
    def focal(self) -> list[float]:
        (fx, _, cx), (_, fy, cy), _ = self.matrix
        return [fx, fy, cx, cy]


def drawn(rng: np.random.Generator) -> Drawn:
    """An image size, K, and 4 fisheye terms or 0, 4, 5 or 8 of OpenCV's, that do not fold inside the image."""
    width, height = int(rng.integers(80, 1920)), int(rng.integers(60, 1200))
    focal = max(width, height) * rng.uniform(0.6, 1.4)
    matrix = [
        [focal, 0.0, width * rng.uniform(0.45, 0.55)],
        [0.0, focal * rng.uniform(0.97, 1.03), height * rng.uniform(0.45, 0.55)],
        [0.0, 0.0, 1.0],
    ]
    if rng.random() < 0.4:
        terms = (rng.uniform(-1, 1, 4) * (0.05, 0.01, 0.002, 0.0005)).tolist()
        return Drawn(width, height, matrix, terms, True)
    count = int(rng.choice([4, 5, 8]))
    terms = (rng.uniform(-1, 1, 8) * (0.08, 0.02, 1e-3, 1e-3, 0.004, 0.05, 0.01, 0.002))[:count]
    return Drawn(width, height, matrix, (terms * (rng.random() > 0.15)).tolist(), False)


Content = dict[str, object] | None
_Writer = Callable[[Drawn], Content]


def _kd(lens: Drawn) -> Content:
    kind = {"camera_model": "fisheye"} if lens.fisheye else {"camera_model": "pinhole"}
    return {**kind, "K": lens.matrix, "D": lens.terms, "resolution": [lens.width, lens.height]}


def _kd_json(lens: Drawn) -> Content:
    model = "equidistant" if lens.fisheye else "plumb_bob"
    return {
        "mtx": lens.matrix,
        "dist": [lens.terms],
        "distortion_model": model,
        "image_shape": [lens.height, lens.width],
    }


def _ros(lens: Drawn) -> Content:
    model = "equidistant" if lens.fisheye else ("rational_polynomial" if len(lens.terms) == 8 else "plumb_bob")
    flat = [v for row in lens.matrix for v in row]
    matrix = {"rows": 3, "cols": 3, "data": flat}
    terms = {"rows": 1, "cols": len(lens.terms), "data": lens.terms}
    size = {"image_width": lens.width, "image_height": lens.height}
    return {
        **size,
        "camera_name": "left",
        "camera_matrix": matrix,
        "distortion_model": model,
        "distortion_coefficients": terms,
        "projection_matrix": {"rows": 3, "cols": 4, "data": [0.0] * 12},
    }


def _without_size(lens: Drawn) -> Content:
    content = _kd(lens)
    assert content is not None
    del content["resolution"]
    return content


def _kalibr(lens: Drawn) -> Content:
    if len(lens.terms) != 4:
        return None
    model = "equidistant" if lens.fisheye else "radtan"
    cam = {"camera_model": "pinhole", "intrinsics": lens.focal, "distortion_model": model}
    return {"cam0": {**cam, "distortion_coeffs": lens.terms, "resolution": [lens.width, lens.height], "rostopic": "/a"}}


def _terms_by_name(lens: Drawn) -> dict[str, float]:
    names = ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return dict(zip(names, lens.terms, strict=False))


def _orb(prefix: str) -> _Writer:
    def content(lens: Drawn) -> Content:
        if len(lens.terms) > 5:
            return None
        numbers = dict(zip(("fx", "fy", "cx", "cy"), lens.focal, strict=True)) | _terms_by_name(lens)
        kind = "KannalaBrandt8" if lens.fisheye else "PinHole"
        size = {"Camera.width": lens.width, "Camera.height": lens.height, "Camera.fps": 30, "ORBextractor.nFeatures": 9}
        return {"Camera.type": kind, **{f"{prefix}.{k}": v for k, v in numbers.items()}, **size}

    return content


def _stella(lens: Drawn) -> Content:
    if len(lens.terms) > 5:
        return None
    numbers = dict(zip(("fx", "fy", "cx", "cy"), lens.focal, strict=True)) | _terms_by_name(lens)
    model = "fisheye" if lens.fisheye else "perspective"
    return {
        "Camera": {
            "name": "a",
            "setup": "monocular",
            "model": model,
            "cols": lens.width,
            "rows": lens.height,
            **numbers,
        }
    }


def _nerfstudio(lens: Drawn) -> Content:
    if len(lens.terms) > 5:
        return None
    fx, fy, cx, cy = lens.focal
    model = "OPENCV_FISHEYE" if lens.fisheye else "OPENCV"
    # nerfstudio's pixels are COLMAP's: the first one's centre is at (0.5, 0.5)
    numbers = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": lens.width, "h": lens.height}
    return {"camera_model": model, **numbers, **_terms_by_name(lens), "frames": [{"file_path": "images/0001.png"}]}


def _ours(lens: Drawn) -> Content:
    model = "OPENCV_FISHEYE" if lens.fisheye else "FULL_OPENCV"
    numbers = [*lens.focal, *lens.terms, *[0.0] * (0 if lens.fisheye else 8 - len(lens.terms))]
    return {"model": model, "width": lens.width, "height": lens.height, "params": numbers, "pixel_center": 0.0}


FORMATS: dict[str, _Writer] = {
    "kd.yaml": _kd,
    "kd.json": _kd_json,
    "ros.yaml": _ros,
    "without_size.yaml": _without_size,
    "camchain.yaml": _kalibr,
    "orb2.yaml": _orb("Camera"),
    "orb3.yaml": _orb("Camera1"),
    "stella.yaml": _stella,
    "transforms.json": _nerfstudio,
    "camera.json": _ours,
}
"""What people keep a lens in, by file name; None where the program has no such lens."""
