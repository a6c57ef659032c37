"""lightdepth: depth of endoscope images from the decline of their light, and what is read from disk for it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "open_sequence": "lightdepth.datasets",
    "read_map": "lightdepth.maps",
    "load_model": "lightdepth.checkpoint",
    "predict": "lightdepth.models",
    "Frame": "lightdepth.frame",
    "DepthPrediction": "lightdepth.prediction",
    "SparseMap": "lightdepth.sparse_map",
    "PhotometricCalibration": "lightdepth.photometry",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    # Lazy: the command line imports this package to answer --help.
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'lightdepth' has no attribute {name!r}")
