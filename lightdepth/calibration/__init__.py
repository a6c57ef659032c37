"""Calibration files -> cameras and lights, in our conventions, whatever program wrote them. One module per format."""

from lightdepth.calibration.json_files import camera_from_fields
from lightdepth.calibration.reading import read_camera, read_light, write_camera, write_light

__all__ = [
    "camera_from_fields",
    "read_camera",
    "read_light",
    "write_camera",
    "write_light",
]
