"""Surfaces as mesh files: PLY with all that is known of a vertex, GLB and OBJ with colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.exporting.exported import Exportable


def write_ply(
    path: Path,
    vertices: np.ndarray,
    triangles: np.ndarray,
    normals: np.ndarray,
    colors: np.ndarray,
    scalars: dict[str, np.ndarray],
) -> None:
    """A binary PLY: vertices (n, 3), triangles (m, 3), normals (n, 3), colors (n, 3) uint8, and scalars (n,) by name,
    which CloudCompare lists as scalar fields; MeshLab takes `quality` and `confidence` for its vertex quality."""
    rows = np.zeros(
        len(vertices),
        [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
        + [(name, "u1") for name in ("red", "green", "blue", "alpha")]
        + [(name, "<f4") for name in scalars],
    )
    for names, values in ((("x", "y", "z"), vertices), (("nx", "ny", "nz"), normals)):
        for k, name in enumerate(names):
            rows[name] = values[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, k]
    rows["alpha"] = 255
    for name, values in scalars.items():
        rows[name] = values
    faces = np.zeros(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    assert rows.dtype.names is not None
    kinds = {"f": "float", "u": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {kinds[rows.dtype[name].kind]} {name}" for name in rows.dtype.names]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes() + faces.tobytes())


def confidence_colors(confidence: np.ndarray) -> np.ndarray:
    """(n,) in [0, 1] as colours (n, 3) uint8, from dark blue (0) over green to yellow (1): matplotlib's viridis."""
    from matplotlib import colormaps

    colors: np.ndarray = np.rint(255 * colormaps["viridis"](np.clip(confidence, 0, 1))[:, :3]).astype(np.uint8)
    return colors


def write_surfaces(exported: Exportable, folder: Path) -> list[str]:
    """mesh.ply with normals, colour, confidence and views; and mesh_confidence.ply, coloured by confidence, where the
    run knows it. Returns the names."""
    dense = exported.dense
    scalars: dict[str, np.ndarray] = {}
    if dense.confidence is not None:
        scalars = {"confidence": dense.confidence, "quality": dense.confidence}
    if dense.expected_error is not None:
        scalars["expected_error"] = dense.expected_error
    if dense.views is not None:
        scalars["views"] = dense.views
    surface = (dense.vertices, dense.triangles, exported.normals)
    write_ply(folder / "mesh.ply", *surface, exported.colors, scalars)
    if dense.confidence is None:
        return ["mesh.ply"]
    write_ply(folder / "mesh_confidence.ply", *surface, confidence_colors(dense.confidence), scalars)
    return ["mesh.ply", "mesh_confidence.ply"]


def write_mesh(exported: Exportable, path: Path) -> None:
    """A GLB or OBJ, by the ending, with colours and normals."""
    import trimesh

    rgba = np.concatenate([exported.colors, np.full((len(exported.colors), 1), 255, np.uint8)], 1)
    dense = exported.dense
    mesh = trimesh.Trimesh(
        dense.vertices, dense.triangles, vertex_colors=rgba, vertex_normals=exported.normals, process=False
    )
    mesh.export(path, include_normals=True)
