"""The synthetic colon: shape, texture, light and camera path -> frames and a SLAM export with exact truth."""

from lightdepth.tube.exchange import ExchangeConfig
from lightdepth.tube.film import FilmConfig
from lightdepth.tube.path import Lens, PathConfig, any_field, camera_path, lens, octagon
from lightdepth.tube.scene import Tube, TubeConfig, cavity, realistic
from lightdepth.tube.sensor import SensorConfig
from lightdepth.tube.sequence import TubeSequence, render_sequence, tube_frames
from lightdepth.tube.shape import ShapeConfig
from lightdepth.tube.texture import TextureConfig
from lightdepth.tube.wide import wide_colon, wide_hollow

__all__ = [
    "ExchangeConfig",
    "FilmConfig",
    "Lens",
    "PathConfig",
    "SensorConfig",
    "ShapeConfig",
    "TextureConfig",
    "Tube",
    "TubeConfig",
    "TubeSequence",
    "any_field",
    "camera_path",
    "cavity",
    "lens",
    "octagon",
    "realistic",
    "render_sequence",
    "tube_frames",
    "wide_colon",
    "wide_hollow",
]
