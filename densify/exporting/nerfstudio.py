"""A dense map as nerfstudio reads one: transforms.json, with pictures, depth, masks and points beside it.

Cameras are camera-to-world with OpenGL's axes (x right, y up, z backwards); intrinsics have the first pixel's centre at
(0.5, 0.5), as ours. Depth is float32 .npy along the axis, in thousandths of the map's unit: nerfstudio multiplies depth
files by `depth_unit_scale_factor`, which is 1e-3 unless it is told otherwise. Pixels that show no surface are 0.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from densify.dense_map import write_cloud
from densify.exporting.colmap import stem
from densify.exporting.exported import Exportable
from densify.exporting.images import known_cameras, write_image
from densify.run_frames import frame_of
from lightdepth.camera import CameraModel
from lightdepth.datasets import FrameSequence

CAMERAS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE")
"""Our camera models that nerfstudio has by the same name; it takes a pinhole as an OPENCV without distortion."""
DEPTH_UNIT = 1e-3
_INTRINSICS = {"fx": "fl_x", "fy": "fl_y"}  # the others are called as ours are
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def intrinsics(camera: CameraModel) -> dict[str, object]:
    """A camera of CAMERAS in transforms.json's words."""
    values = zip(camera.parameters(), camera.params, strict=True)
    numbers = {_INTRINSICS.get(name, name): value for name, value in values}
    model = "OPENCV" if camera.name == "PINHOLE" else camera.name
    return {"camera_model": model, "w": camera.width, "h": camera.height, **numbers}


def write_nerfstudio(
    exported: Exportable,
    folder: Path,
    frames: FrameSequence | None,
    points: int,
    on_keyframe: Callable[[], None] = lambda: None,
) -> list[str]:
    """transforms.json and what it names; `points` is how many of the surface's vertices are in points.ply at most.
    Returns what is to be said of the lenses. `on_keyframe` is called as each keyframe is done."""
    cameras, said = known_cameras((k.camera for k in exported.submap.keyframes), CAMERAS, "OPENCV_FISHEYE")
    (folder / "depths").mkdir()
    entries = []
    for keyframe in exported.submap.keyframes:
        name, camera = stem(keyframe), cameras[keyframe.camera]
        depth = exported.seen_from(keyframe, camera)[0]
        np.save(folder / "depths" / f"{name}.npy", depth / np.float32(DEPTH_UNIT))
        entry: dict[str, object] = {"file_path": f"images/{name}.png", "depth_file_path": f"depths/{name}.npy"}
        frame = frame_of(frames, keyframe.number)
        if frame is not None:
            write_image(folder / "images" / f"{name}.png", frame.image)
            if not frame.valid.all():
                write_image(folder / "masks" / f"{name}.png", np.repeat(frame.valid[..., None], 3, 2).astype(float))
                entry["mask_path"] = f"masks/{name}.png"
        entry["transform_matrix"] = (np.linalg.inv(keyframe.cam_from_map) @ _OPENGL).tolist()
        entries.append(entry if len(cameras) == 1 else {**intrinsics(camera), **entry})
        on_keyframe()
    shared = intrinsics(next(iter(cameras.values()))) if len(cameras) == 1 else {}
    rows = exported.thinned(points)
    write_cloud(folder / "points.ply", exported.dense.vertices[rows], exported.colors[rows])
    content = {
        **shared,
        "ply_file_path": "points.ply",
        "depth_unit_scale_factor": DEPTH_UNIT,
        "unit": exported.unit,
        "frames": entries,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return said
