"""A dense map as COLMAP has one: a model of the frames, and a workspace of its multi-view stereo.

    sparse/0/           cameras, images, points3D as text: the map's points with their tracks, the surface's without
    dense/              all as an undistorted pinhole camera has it, which is what COLMAP's stereo knows
      sparse/           the same model, keypoints moved with the pixels; all half a pixel up and left, see below
      images/           the frames, where they are given
      stereo/depth_maps, normal_maps/NAME.geometric.bin, patch-match.cfg, fusion.cfg

The array files are COLMAP's: `width&height&channels&`, then float32, a channel after the other, rows from the top.
Depth is along the axis, at the pixels' centres, 0 where the surface is not seen; normals are in camera axes. COLMAP's
stereo and fusion take the pixel of index (0, 0) to be at (0, 0), where its models have (0.5, 0.5): with the model's own
principal point the fused points are half a pixel beside the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from densify.exporting.exported import Exportable
from densify.exporting.images import known_cameras, pinhole_of, seen_by, write_image
from densify.run_frames import frame_of
from lightdepth.datasets import FrameSequence
from lightdepth.files.reading import reading
from lightdepth.maps.colmap import write_text_model
from lightdepth.sparse_map import Keyframe, Submap

CAMERAS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE")
"""Our camera models that COLMAP has by the same name."""


def write_array(path: Path, values: np.ndarray) -> None:
    """(H, W) or (H, W, C) float32 as COLMAP's depth and normal maps are."""
    planes = np.atleast_3d(values).transpose(2, 0, 1)
    channels, height, width = planes.shape
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + np.ascontiguousarray(planes, "<f4").tobytes())


def read_array(path: Path) -> np.ndarray:
    """(H, W) or (H, W, C) float32 of a depth or normal map."""
    with reading(path, "a map of COLMAP's", "expected depth or normals in a .bin"):
        width, height, channels, data = path.read_bytes().split(b"&", 3)
        planes = np.frombuffer(data, "<f4").reshape(int(channels), int(height), int(width))
    return planes[0] if len(planes) == 1 else planes.transpose(1, 2, 0)


def write_colmap(
    exported: Exportable,
    folder: Path,
    frames: FrameSequence | None,
    points: int,
    on_keyframe: Callable[[], None] = lambda: None,
) -> list[str]:
    """The model and the workspace; `points` is how many of the surface's vertices stand in it at most. Returns what is
    to be said of the lenses. `on_keyframe` is called as each keyframe is done."""
    cameras, said = known_cameras((k.camera for k in exported.submap.keyframes), CAMERAS, "OPENCV_FISHEYE")
    rows = exported.thinned(points)
    named = [replace(k, camera=cameras[k.camera], name=f"{stem(k)}.png") for k in exported.submap.keyframes]
    model = _with_surface(replace(exported.submap, keyframes=tuple(named)), exported, rows)
    colors = np.concatenate([np.full((len(exported.submap.points), 3), 128, np.uint8), exported.colors[rows]])
    write_text_model(model, folder / "sparse" / "0", colors=colors)
    undistorted = tuple(_undistorted(k) for k in named)
    by_index = tuple(replace(k, camera=k.camera.with_pixel_center(1.0), pixels=k.pixels - 0.5) for k in undistorted)
    write_text_model(replace(model, keyframes=by_index), folder / "dense" / "sparse", colors=colors)
    stereo = folder / "dense" / "stereo"
    for kind in ("depth_maps", "normal_maps", "consistency_graphs"):
        (stereo / kind).mkdir(parents=True)
    for own, keyframe in zip(exported.submap.keyframes, undistorted, strict=True):
        depth, normals = exported.seen_from(keyframe, keyframe.camera)
        write_array(stereo / "depth_maps" / f"{keyframe.name}.geometric.bin", depth)
        write_array(stereo / "normal_maps" / f"{keyframe.name}.geometric.bin", normals)
        frame = frame_of(frames, own.number)
        if frame is not None:
            write_image(folder / "images" / keyframe.name, frame.image)
            picture = seen_by(frame.image, own.camera, keyframe.camera)
            write_image(folder / "dense" / "images" / keyframe.name, picture)
        on_keyframe()
    names = [k.name for k in undistorted]
    (stereo / "fusion.cfg").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    (stereo / "patch-match.cfg").write_text("".join(f"{name}\n__auto__, 20\n" for name in names), encoding="utf-8")
    return said


def stem(keyframe: Keyframe) -> str:
    """A keyframe's name without folders and ending: what its files are called."""
    return Path(keyframe.name.replace("\\", "/")).stem


def _with_surface(submap: Submap, exported: Exportable, rows: np.ndarray) -> Submap:
    """The submap with vertices of the surface among its points, which nobody observed."""
    first = int(submap.point_ids.max()) + 1
    ids = np.concatenate([submap.point_ids, np.arange(first, first + len(rows))])
    return replace(submap, point_ids=ids, points=np.concatenate([submap.points, exported.dense.vertices[rows]]))


def _undistorted(keyframe: Keyframe) -> Keyframe:
    """The keyframe as a pinhole camera in its place has it; observations outside its picture are left out."""
    camera = pinhole_of(keyframe.camera)
    if camera == keyframe.camera or not len(keyframe.pixels):
        return replace(keyframe, camera=camera)
    rays, valid = keyframe.camera.unproject(keyframe.pixels)
    pixels, seen = camera.project(rays)
    kept = valid & seen
    return replace(keyframe, camera=camera, pixels=pixels[kept], point_ids=keyframe.point_ids[kept])
