"""Meshes and point clouds on disk. Only the file itself is read: no textures and buffers that it names elsewhere."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.images import read_bytes
from lightdepth.files.reading import check_bytes, reading

MESH_SUFFIXES = ("ply", "obj", "stl", "glb", "off")
_MOST_BYTES = 1 << 30


def load_mesh(
    path: Path,
    what: str = "a mesh that can be read",
    cure: str = "expected a PLY, OBJ, STL or GLB",
    triangles_alone: bool = False,
) -> Any:
    """What trimesh makes of a file's bytes: a mesh, a cloud or a scene. Raises InputError where it is none."""
    import trimesh

    kind = path.suffix.lower().lstrip(".")
    if kind not in MESH_SUFFIXES:
        raise InputError(path, f"a file that ends in {path.suffix or 'nothing'}", cure)
    if path.is_file():
        check_bytes(path.stat().st_size, _MOST_BYTES, path, "mesh")
    data = read_bytes(path, "mesh")
    with reading(path, what, cure):
        options: dict[str, Any] = {"force": "mesh", "skip_materials": True} if triangles_alone else {}
        return trimesh.load(io.BytesIO(data), file_type=kind, process=False, **options)


def vertex_columns(mesh: Any, names: Iterable[str]) -> dict[str, np.ndarray | None]:
    """Columns (n,) of a PLY's vertices that trimesh has no name for, by name; None where the file has none."""
    # It keeps them in the raw file: a structured array, or a dict of columns.
    raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    there = raw.dtype.names if isinstance(raw, np.ndarray) else tuple(raw)
    return {name: np.asarray(raw[name]).ravel() if name in there else None for name in names}


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of a PLY, OBJ, STL or GLB. Raises InputError when it is none."""
    mesh = load_mesh(path, triangles_alone=True)
    with reading(path, "a mesh that can be read", "expected a PLY, OBJ, STL or GLB"):
        vertices = np.asarray(mesh.vertices, float).reshape(-1, 3)
        triangles = np.asarray(mesh.faces, int).reshape(-1, 3)
    if not len(triangles):
        raise InputError(path, "no triangles in it", "expected a surface, not points alone")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(path, f"a triangle of vertices that are not there, of {len(vertices)}", "copy it again")
    if not np.isfinite(vertices[triangles]).all():
        raise InputError(path, "vertices with NaN or infinite numbers", "expected finite x y z")
    return vertices, triangles


def read_cloud(path: Path) -> np.ndarray:
    """Points (n, 3) of a PLY. Raises InputError where there is none."""
    cure = "expected a PLY with vertices x y z"
    cloud = load_mesh(path, "a PLY that can be read", cure)
    with reading(path, "a PLY", cure):
        vertices = getattr(cloud, "vertices", None)
        points = np.array([] if vertices is None else vertices, np.float64).reshape(-1, 3)
    if not len(points):
        raise InputError(path, "no points in it", cure)
    return points
