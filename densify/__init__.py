"""densify: depth and a sparse map in, dense maps out."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "densify": "densify.pipeline",
    "DensifyConfig": "densify.config",
    "DenseMap": "densify.dense_map",
    "Alignment": "densify.alignment",
    "TsdfVolume": "densify.fusion.volume",
    "Densifier": "densify.live.densifier",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    # Lazy: the command line imports this package to answer --help.
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'densify' has no attribute {name!r}")
