"""ocamcalib's calib_results.txt: Scaramuzza's omnidirectional camera, as the toolbox exports it.

Five lines of numbers between comments: the polynomial (how many coefficients, then ss0, ss1, ...), its inverse (rho
over atan(z / hypot(x, y)); not read: ours is computed), the centre as row and column, the affine c d e, the size as
height and width.

Notation: x down the rows, y along the columns, z away from the scene; a pixel is (row, column) = [[c, d], [e, 1]]
(x, y) + centre, and its ray (x, y, ss0 + ss1 rho + ...), so ss0 < 0. The exporter subtracts MATLAB's 1 from the centre:
the first pixel's centre is at (0, 0).

Ours has x right, y down, z into the scene: with the sensor's unit scaled by c, as the last entry of our stretch is 1,
a_i = -ss_i c^(1 - i) and the stretch is [[1/c, e/c], [d/c, 1]]. This is exact, both ways.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightdepth.calibration.plain_text import cannot_hold
from lightdepth.camera import CameraModel, Scaramuzza, camera_from_params
from lightdepth.errors import InputError
from lightdepth.files.text import read_text, rows, to_numbers
from lightdepth.files.writing import write_whole

_INVERSE_ERROR_PX = 0.01  # the toolbox's own
_LINES = "calib_results.txt with five lines: polynomial, inverse polynomial, centre, affine c d e, height and width"


def is_ocamcalib(lines: list[list[str]]) -> bool:
    """Whether the first line is a count and as many numbers, and lines of centre, stretch and size follow."""
    lengths = [len(words) for words in lines]
    counted = bool(lines) and lines[0][0].isdigit() and int(lines[0][0]) == lengths[0] - 1
    return lengths[2:] == [2, 3, 2] or (counted and len(lines) > 1)


def read_ocamcalib(path: Path) -> CameraModel:
    """The camera of a calib_results.txt."""
    lines = rows(read_text(path, f"expected {_LINES}"))
    if len(lines) != 5:
        raise InputError(path, f"{len(lines)} lines of numbers", f"expected {_LINES}")
    names = ("polynomial", "inverse polynomial", "centre", "affine", "size")
    values = {n: to_numbers(w, f"{path}: {n}", "numbers") for n, w in zip(names, lines, strict=True)}
    count, *poly = values["polynomial"]
    if count != len(poly):
        raise InputError(path, f"polynomial: {len(poly)} coefficients after the count {count:g}", "expected as many")
    for name, right in (("centre", "row and column"), ("affine", "c, d and e"), ("size", "height and width")):
        if len(values[name]) != len(right.replace(" and", ",").split(", ")):
            raise InputError(f"{path}: {name}", f"{len(values[name])} numbers", f"expected {right}")
    if any(poly[5:]):
        raise InputError(path, f"polynomial of degree {len(poly) - 1}", "expected 4 at most (ocamcalib's default)")
    poly = (poly + [0.0] * 5)[:5]
    if poly[0] >= 0:
        raise InputError(path, f"polynomial starts with {poly[0]:g}", "expected a negative number, as ocamcalib has it")
    c, d, e = values["affine"]
    if abs(c - 1) > 0.5:
        raise InputError(path, f"affine c = {c:g}", "expected about 1, the ratio of the pixel's sides")
    row, column = values["centre"]
    height, width = values["size"]
    if height != int(height) or width != int(width):
        raise InputError(path, f"size {height:g} {width:g}", "expected height and width in whole pixels")
    ours = [-a * c ** (1 - i) for i, a in enumerate(poly)]
    params = [column, row, *ours, 1 / c, e / c, d / c]
    return camera_from_params("SCARAMUZZA", int(width), int(height), params, str(path)).with_pixel_center(0.0)


def write_ocamcalib(camera: CameraModel, path: Path) -> None:
    """A calib_results.txt, its inverse polynomial within 0.01 pixels over the camera's field (where degree 14 can)."""
    if not isinstance(camera, Scaramuzza):
        raise cannot_hold(path, "ocamcalib", f"{camera.name} camera", "SCARAMUZZA")
    if not 2 / 3 <= camera.c <= 2:  # as the reader wants it
        raise InputError(path, f"c = {camera.c:g}", "ocamcalib's is about 1: resize the camera evenly both ways")
    theirs = camera.with_pixel_center(1.0)
    c, d, e = 1 / camera.c, camera.e / camera.c, camera.d / camera.c
    polynomial = [-a * c ** (i - 1) for i, a in enumerate(theirs.params[2:7])]
    inverse = _inverse(camera)
    lines: dict[str, list[float]] = {
        "polynomial coefficients, ss0 first": [5, *polynomial],
        "inverse polynomial coefficients": [len(inverse), *inverse],
        "centre: row and column, from 0": [theirs.cy, theirs.cx],
        "affine parameters c, d, e": [c, d, e],
        "image size: height and width": [camera.height, camera.width],
    }
    write_whole(
        path, "\n".join(f"#{what}\n\n{' '.join(repr(v) for v in numbers)}\n" for what, numbers in lines.items())
    )


def _inverse(camera: Scaramuzza) -> list[float]:
    """rho in ocamcalib's units as a polynomial of ocamcalib's angle, which is theta - 90 degrees."""
    theta = np.linspace(0, 0.999 * camera.max_theta(), 1000)
    pixels = camera.project(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1))[0]
    rho = camera.c * np.linalg.norm(camera._sensor(pixels), axis=-1)
    for degree in range(5, 15):
        fit = np.polynomial.Polynomial.fit(theta - np.pi / 2, rho, degree).convert()
        if np.abs(fit(theta - np.pi / 2) - rho).max() < _INVERSE_ERROR_PX:
            break
    return fit.coef.tolist()
