"""Pictures of errors: their cumulative curves, and surfaces coloured by them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from densify.evaluation.records import EDGES_MM, DepthJudged, ErrorMesh, Evaluation, MapsJudged
from lightdepth.files.meshes import load_mesh, vertex_columns
from lightdepth.reporting.figures import PLAIN, MeshView, chart, chart_png, outside_axes, png, side_by_side
from lightdepth.reporting.scene import Layer, Surface, bytes_of

MODELS = {"sparse": "Sparse map", "sparse_inliers": "Sparse inliers", "dense": "Dense"}
"""The names of the point clouds, for people."""
FARTHEST_COLOR_MM = 5.0
"""The error from which on a surface is red."""


def curve_picture(evaluation: Evaluation[DepthJudged | MapsJudged]) -> bytes:
    """Share of model points (or pixels) within each error, over the error's logarithm."""
    depth = isinstance(evaluation.judged, DepthJudged)
    figure, axes = chart((6.4, 3.6))
    for name, share in evaluation.curves.items():
        axes.plot(EDGES_MM, 100 * share, label=name if depth else MODELS[name], linewidth=1.8)
    axes.set_xscale("log")
    axes.set_xlim(EDGES_MM[0], EDGES_MM[-1])
    axes.set_ylim(0, 100)
    axes.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    axes.set_xlabel("error of depth [mm]" if depth else "distance to the closest true point [mm]")
    axes.set_ylabel("pixels [%]" if depth else "model points [%]")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="upper left", title="alignment" if depth else None)
    return chart_png(figure)


def error_colors(distance: np.ndarray) -> np.ndarray:
    """(n, 3) in [0, 1]: from blue (0) over green and yellow to red (5 mm and more)."""
    level = np.rint(255 * (0.08 + 0.87 * np.clip(distance / FARTHEST_COLOR_MM, 0, 1))).astype(np.uint8)
    return cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0, ::-1] / 255


def error_layer(distance: np.ndarray) -> Layer:
    """The colours of a surface whose vertices are at `distance` (n,) [mm] from the truth."""
    far = FARTHEST_COLOR_MM
    marks = ((0.0, "off by 0 mm"), (0.5, f"{far / 2:g} mm"), (1.0, f"{far:g} mm and more"))
    return Layer("Error", bytes_of(distance / far), bytes_of(error_colors(far * np.linspace(0, 1, 256))), marks)


def error_surface(mesh: ErrorMesh) -> Surface:
    """The surface in the true world, by its error first and by its shape alone."""
    shape = Layer("Shape alone", None, bytes_of(np.array([PLAIN])))
    axes = outside_axes(mesh.vertices) if len(mesh.vertices) else np.eye(3)
    return Surface(mesh.name, mesh.vertices, mesh.triangles, (error_layer(mesh.distance), shape), axes=axes)


def write_error_mesh(mesh: ErrorMesh, path: Path) -> None:
    """A PLY in the true world [mm], coloured, with each vertex's distance as `error_mm`."""
    import trimesh

    colors = np.rint(255 * error_colors(mesh.distance)).astype(np.uint8)
    made = trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=colors, process=False)
    made.vertex_attributes["error_mm"] = mesh.distance.astype(np.float32)
    made.export(path)


def read_error(path: Path) -> np.ndarray | None:
    """The distances (n,) [mm] that `write_error_mesh` wrote; None where the file is not there, or has none."""
    return vertex_columns(load_mesh(path), ["error_mm"])["error_mm"] if path.is_file() else None


def error_picture(mesh: ErrorMesh) -> bytes:
    """The coloured surface from outside, and what the colours mean."""
    picture = MeshView.of(mesh.vertices, mesh.triangles).picture(error_colors(mesh.distance))
    height, top, bottom = picture.shape[0], 70, 40
    scale = np.full((height, 150, 3), 255, np.uint8)
    steps = np.linspace(FARTHEST_COLOR_MM, 0, height - top - bottom)
    scale[top : height - bottom, 20:44] = np.rint(255 * error_colors(steps))[:, None]
    write = partial(cv2.putText, scale, fontFace=cv2.FONT_HERSHEY_SIMPLEX, color=(60, 60, 60), lineType=cv2.LINE_AA)
    for line, words in enumerate(("distance to the", "closest true point")):
        write(text=words, org=(6, 24 + 18 * line), fontScale=0.42)
    for mm in range(int(FARTHEST_COLOR_MM) + 1):
        row = round(height - bottom - mm / FARTHEST_COLOR_MM * (height - top - bottom))
        write(text=f"{mm:g} mm" + " and more" * (mm == FARTHEST_COLOR_MM), org=(50, row + 5), fontScale=0.42)
    return png(side_by_side([picture, scale]))
