"""Values of our own kinds (frozen dataclasses) as arrays in an .npz, and back, without loss and without pickle.

What a value is comes from the type that the reader asks for, never from the file. Values that both sides hold
already (`given`, by their type) are not written.
"""

from __future__ import annotations

import json
import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from lightdepth.camera import CameraModel, Provenance, camera_from_params

T = TypeVar("T")
_TREE = "tree"


def write_packed(path: Path, value: object, given: Mapping[type, object] | None = None) -> None:
    """A value of dataclasses, arrays, cameras, mappings, sequences and plain values, in an .npz."""
    arrays: dict[str, np.ndarray] = {}
    tree = _packed(value, arrays, given or {})
    np.savez(path, **{_TREE: np.array(json.dumps(tree))}, **arrays)  # type: ignore[arg-type]  # its own options


def read_packed(path: Path, kind: type[T], given: Mapping[type, object] | None = None) -> T:
    """A value of that kind, as it was written."""
    with np.load(path, allow_pickle=False) as found:
        arrays = dict(found)
    value: T = _unpacked(kind, json.loads(str(arrays.pop(_TREE))), arrays, given or {})
    return value


def _packed(value: Any, arrays: dict[str, np.ndarray], given: Mapping[type, object]) -> Any:
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if any(value is each for each in given.values()):
        return {"given": True}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        arrays[f"array_{len(arrays)}"] = value
        return f"array_{len(arrays) - 1}"
    if isinstance(value, CameraModel):
        known = _packed(value.provenance, arrays, given)
        return [known, value.name, value.width, value.height, *value.params]
    if is_dataclass(value):
        return [_packed(getattr(value, f.name), arrays, given) for f in fields(value)]
    if isinstance(value, Mapping):
        return [[_packed(k, arrays, given), _packed(v, arrays, given)] for k, v in value.items()]
    assert isinstance(value, Sequence), f"{type(value)} cannot be kept"
    return [_packed(each, arrays, given) for each in value]


def _unpacked(kind: Any, tree: Any, arrays: Mapping[str, np.ndarray], given: Mapping[type, object]) -> Any:
    if tree is None:
        return None
    origin, of = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        (kind,) = (each for each in of if each is not type(None))
        return _unpacked(kind, tree, arrays, given)
    if isinstance(tree, dict):
        return given[kind]
    if kind is np.ndarray:
        return arrays[tree]
    if kind is CameraModel:
        known, model, width, height, *params = tree
        camera = camera_from_params(model, width, height, params, "the camera")
        return replace(camera, provenance=_unpacked(Provenance, known, arrays, given))
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        values = zip(fields(kind), tree, strict=True)
        return kind(**{f.name: _unpacked(hints[f.name], each, arrays, given) for f, each in values})  # type: ignore[operator]  # a class, not a value of one
    if origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        return {_unpacked(of[0], k, arrays, given): _unpacked(of[1], v, arrays, given) for k, v in tree}
    if origin is tuple and of[-1] is not ...:
        return tuple(_unpacked(k, each, arrays, given) for k, each in zip(of, tree, strict=True))
    if origin is not None and isinstance(origin, type) and issubclass(origin, Sequence):
        found = [_unpacked(of[0], each, arrays, given) for each in tree]
        return tuple(found) if origin is tuple else found
    return tree
