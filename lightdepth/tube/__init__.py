"""The synthetic colon: shape, texture, light and camera path -> frames and a SLAM export with exact truth."""

from lightdepth.tube.path import camera_path, lens, octagon
from lightdepth.tube.scene import SensorConfig, ShapeConfig, TextureConfig, Tube, TubeConfig
from lightdepth.tube.sequence import TubeSequence, render_sequence, tube_frames

__all__ = [
    "SensorConfig",
    "ShapeConfig",
    "TextureConfig",
    "Tube",
    "TubeConfig",
    "TubeSequence",
    "camera_path",
    "lens",
    "octagon",
    "render_sequence",
    "tube_frames",
]
