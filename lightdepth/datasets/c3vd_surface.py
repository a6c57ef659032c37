"""What C3VD knows of a frame besides depth and pose, and of the whole wall, as its files hold it (FORMATS).

| file | code |
|---|---|
| `NNNN_normals.tiff` | 16 bits, R G B = x y z, v = floor(65535 (n + 1) / 2); 0 where no wall was hit |
| `NNNN_flow.tiff` | 16 bits, R G = dx dy to the frame before, v = floor(65535 (d + 20) / 40); 0 where unknown |
| `NNNN_occlusion.png` | 8 bits, 255 where the pixel hides another face |
| `coverage_mesh.obj` | the wall in the world of the poses, mm; texture index 1 of faces that were seen, else 2 |
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.files.images import write_image

COVERAGE_MESH = "coverage_mesh.obj"
FLOW_PX = 20.0
"""Largest flow that a file holds, pixels."""


@dataclass(frozen=True)
class SeenSurface:
    """One frame's truth of the wall: unit normals (H, W, 3) in camera axes (x right, y down, z into the scene) that
    face the camera, 0 where there is none; where a pixel hides another face, (H, W) bool; flow (H, W, 2) [px] to the
    frame before, NaN where that does not see the place, None for the first frame."""

    normals: np.ndarray
    hides: np.ndarray
    flow: np.ndarray | None


def write_seen_surface(seen: SeenSurface, folder: Path, stem: str) -> None:
    """The files of one frame, beside its depth."""
    known = np.abs(seen.normals).sum(-1, keepdims=True) > 0
    normals = np.where(known, np.floor(65535 * np.clip((seen.normals + 1) / 2, 0, 1)), 0)
    write_image(folder / f"{stem}_normals.tiff", _bgr16(normals))
    write_image(folder / f"{stem}_occlusion.png", np.where(seen.hides, 255, 0).astype(np.uint8))
    if seen.flow is not None:
        code = np.floor(65535 * np.clip((seen.flow + FLOW_PX) / (2 * FLOW_PX), 0, 1))
        flow = np.where(np.isfinite(seen.flow).all(-1, keepdims=True), code, 0)
        write_image(folder / f"{stem}_flow.tiff", _bgr16(np.concatenate([flow, np.zeros_like(flow[..., :1])], -1)))


def write_coverage_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray, seen: np.ndarray) -> None:
    """The wall, vertices (n, 3) and faces (m, 3), and which of its faces (m,) bool were seen."""
    marks = np.where(seen, 1, 2)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices.tolist()]
    lines += ["vt 0 0\n", "vt 1 1\n"]
    lines += [f"f {a}/{t} {b}/{t} {c}/{t}\n" for (a, b, c), t in zip((faces + 1).tolist(), marks.tolist(), strict=True)]
    path.write_text("".join(lines), encoding="utf-8")


def _bgr16(rgb: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(rgb[..., ::-1].astype(np.uint16))
