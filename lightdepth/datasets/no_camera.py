"""Frames without a calibration, and what the verb that met them can do about it."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from lightdepth.errors import InputError
from lightdepth.option_names import option

_FILE = 'FILE ({"model": "PINHOLE", "width": W, "height": H, "params": [fx, fy, cx, cy]})'
BOARD_NEEDS = (
    f"give --camera {_FILE}, or another program's (convert-camera lists them): a board's places are told by a "
    "calibrated camera alone. The same board calibrates it, in OpenCV, MATLAB or Kalibr"
)
"""What to do where photographs of a board come without a camera."""
_MAP = "or, where a verb takes --map, a map that has one"


class NoCamera(InputError):
    """Frames have no calibration. Its cure is for whoever calls the reader; verbs say what they take instead."""

    @classmethod
    def at(cls, path: Path, found: str) -> Self:
        return cls(path, found, f"give {option('camera')} {_FILE}, {_MAP}")

    def of_verb_that_finds_one(self) -> NoCamera:
        """For verbs that take --camera auto."""
        auto = "--camera auto to find it from the motion (--fov 70 where to start)"
        return NoCamera(self.where, self.found, f"give {option('camera')} {_FILE}, {auto}, {_MAP}")

    def of_board(self) -> NoCamera:
        """For photographs of a board, which shows nothing that tells the camera."""
        return NoCamera(self.where, self.found, BOARD_NEEDS)

    def of_other_verb(self, data: Path | str, maps: bool = True) -> NoCamera:
        """For verbs that do not; `maps` whether they take one."""
        first = f"make a sequence with one first: lightdepth import {data} --camera auto -o DATA"
        ways = f"{first}, {_MAP}" if maps else f"or {first}"
        return NoCamera(self.where, self.found, f"give {option('camera')} {_FILE}, {ways}")
