"""lightdepth: depth of endoscope images from the decline of their light, and what is read from disk for it.

The public names are those of `__all__`; docs/api.md shows each at work.
"""

from typing import TYPE_CHECKING

from lightdepth.lazy import public
from lightdepth.moved import install as install_moved

if TYPE_CHECKING:
    from lightdepth.camera import CameraModel as CameraModel
    from lightdepth.checkpoint import from_pretrained as from_pretrained
    from lightdepth.checkpoint import load_model as load_model
    from lightdepth.datasets import FrameSequence as FrameSequence
    from lightdepth.datasets import open_sequence as open_sequence
    from lightdepth.errors import InputError as InputError
    from lightdepth.frame import Frame as Frame
    from lightdepth.maps import read_map as read_map
    from lightdepth.models import DepthModel as DepthModel
    from lightdepth.models import predict as predict
    from lightdepth.photometry import PhotometricCalibration as PhotometricCalibration
    from lightdepth.prediction import DepthPrediction as DepthPrediction
    from lightdepth.prediction import read_prediction as read_prediction
    from lightdepth.sparse_map import SparseMap as SparseMap

__version__ = "0.1.0"

_HOMES = {
    "CameraModel": "lightdepth.camera",
    "DepthModel": "lightdepth.models",
    "DepthPrediction": "lightdepth.prediction",
    "Frame": "lightdepth.frame",
    "FrameSequence": "lightdepth.datasets",
    "InputError": "lightdepth.errors",
    "PhotometricCalibration": "lightdepth.photometry",
    "SparseMap": "lightdepth.sparse_map",
    "from_pretrained": "lightdepth.checkpoint",
    "load_model": "lightdepth.checkpoint",
    "open_sequence": "lightdepth.datasets",
    "predict": "lightdepth.models",
    "read_map": "lightdepth.maps",
    "read_prediction": "lightdepth.prediction",
}
__all__ = list(_HOMES)
__getattr__, __dir__ = public(__name__, _HOMES)
install_moved()
