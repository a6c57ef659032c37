"""The multi-map tree of EndoCartoScope and CLiMB, as CudaSIFT-SLAM's line of ORB-SLAM3 exports it.

    <folder>/3D_maps/<map id>/cameras.txt  images.txt  points3D.txt          keyframes and points of one map
    <folder>/camera_trajectory/cam_traj_map_<map id, three digits>.txt       every localised frame of that map

The maps' files are COLMAP text with the exporter's habits: ids from 0, no tracks, keypoints *and* principal point in
OpenCV pixels (the first pixel's centre at (0, 0)), image names that are frame numbers, distorted keypoints. images.txt
is camera-from-map; the trajectory is map-from-camera, comma separated, quaternion w first. Each map has its own frame
of reference and scale. What is submitted to CLiMB may have points3D.txt alone in a map's folder, and a trajectory of
nine columns with every localised frame: keyframes are chosen among them.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightdepth.calibration import read_camera
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.colmap_cameras import read_cameras_text
from lightdepth.files.reading import reading
from lightdepth.files.rotations import pose_from_quaternion, quaternion_from_pose
from lightdepth.files.text import is_comment, parse_numbers, text_lines
from lightdepth.maps.checks import checked, guessed
from lightdepth.maps.colmap import assembled, read_colors_text, read_points_text, read_submap
from lightdepth.maps.convention import CameraMissing, MapConvention
from lightdepth.sparse_map import SparseMap, Submap, at_its_place
from lightdepth.which_frame import frame_number

MAPS = "3D_maps"
TRAJECTORIES = "camera_trajectory"
TRAJECTORY_FILE = re.compile(r"cam_traj_map_(\d+)\.txt")
_TRAJECTORY_HEADER = (
    "# timestamp, name_image, tx, ty, tz, qw, qx, qy, qz, frame_state(0:frame; 1:is_kf; 2:was_kf), "
    "track_state (0:normal; 1:reloc; 2:loop; 3:merge), dataset_id, merged_frame_id"
)


@dataclass(frozen=True)
class TrajectoryPose:
    """One localised frame: time [s], name, cam_from_map (4, 4), and whether the SLAM kept it as a keyframe."""

    time: float
    name: str
    cam_from_map: np.ndarray
    is_keyframe: bool
    frame_state: int | None = None
    """0 frame, 1 keyframe, 2 keyframe once; None where the file does not say"""


_STEP, _TURN = 0.1, 8.0  # of the distance to what is near, and degrees: a view from there is another one


def trajectory_path(tree: Path, map_id: int) -> Path:
    """Where the trajectory of a map lies; `tree` is the folder that holds 3D_maps."""
    return Path(tree) / TRAJECTORIES / f"cam_traj_map_{map_id:03d}.txt"


def read_trajectory(path: Path) -> list[TrajectoryPose]:
    """A cam_traj_map file -> poses in the file's order. Frames that were not localised (pose not finite) are left out.

    The exporter's header names a column dataset_id that its rows lack: nothing is read beyond the frame state.
    """
    with reading(path, "a trajectory"):
        return _poses_of(Path(path))


def _poses_of(path: Path) -> list[TrajectoryPose]:
    expected = "timestamp,name_image,tx,ty,tz,qw,qx,qy,qz[,frame_state,...]"
    poses = []
    for number, line in enumerate(text_lines(path), 1):
        if is_comment(line):
            continue
        where, tokens = f"{path}, line {number}", [t.strip() for t in line.split(",")]
        if len(tokens) < 9:
            raise InputError(where, f"{len(tokens)} columns between commas", f"expected {expected}")
        numbers = parse_numbers([tokens[0], *tokens[2:9]], where, expected)
        if not np.isfinite(numbers).all():
            continue
        map_from_cam = pose_from_quaternion(numbers[4:8], numbers[1:4], f"{where}: frame {tokens[1]}")
        state = int(tokens[9]) if len(tokens) > 9 and tokens[9].isdigit() else None
        is_keyframe = state in (None, 1)
        poses.append(TrajectoryPose(float(numbers[0]), tokens[1], np.linalg.inv(map_from_cam), is_keyframe, state))
    return poses


def read_exported_submap(
    folder: Path, map_id: int, convention: MapConvention, own: CameraModel | None = None
) -> Submap:
    """One map of the tree. Without images.txt, keyframes come from the trajectory and what they saw from projection.
    `own` is the frames' camera, which serves where the tree has none."""
    trajectory = trajectory_path(folder.parent.parent, map_id)
    if any((folder / f"images{suffix}").is_file() for suffix in (".txt", ".bin")) or not trajectory.is_file():
        submap = read_submap(folder, map_id, convention)
        return replace(submap, localised=_localised(trajectory, convention))
    if not (folder / "points3D.txt").is_file():
        raise InputError(folder, "points3D.txt missing", "with a trajectory alone a map needs points3D.txt")
    camera = _camera(folder, convention, own)
    ids, points = read_points_text(folder / "points3D.txt")
    poses = read_trajectory(trajectory)
    numbers = [frame_number(p.name) for p in poses]
    if _counts_from_one(numbers, convention):
        warnings.warn(
            f"{trajectory}: CLiMB counts frames from 1, the frames here count from 0: keyframe n is taken for frame "
            f"n - 1. Where that is wrong, rename the frames",
            stacklevel=2,
        )
        convention = replace(convention, frame_offset=-1)
    of_all = all(p.frame_state is None for p in poses)
    chosen = [poses[i] for i in spread(poses, points)] if of_all else [p for p in poses if p.is_keyframe]
    if not chosen:
        raise InputError(trajectory, "no keyframe in it (column frame_state 1)", "expected at least one")
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    keyframes = [convention.keyframe(p.name, camera, p.cam_from_map, *none) for p in chosen]
    submap = assembled(folder, map_id, keyframes, ids, points, check=guessed if of_all else checked)
    colors = read_colors_text(folder / "points3D.txt")
    return replace(submap, localised=tuple(n + convention.frame_offset for n in numbers), colors=colors)


def _camera(folder: Path, convention: MapConvention, own: CameraModel | None) -> CameraModel:
    """The map's one camera: of its folder or of one above it up to the tree's, else the frames'."""
    for place in (folder, folder.parent, folder.parent.parent):
        if (place / "cameras.txt").is_file():
            cameras = read_cameras_text(place / "cameras.txt")
            if len(cameras) != 1:
                raise InputError(
                    f"{place / 'cameras.txt'}",
                    f"{len(cameras)} cameras",
                    "without images.txt there must be exactly one",
                )
            return next(iter(cameras.values()))
        if (place / "camera.json").is_file():
            return convention.from_ours(read_camera(place / "camera.json"))
    if own is not None:
        return convention.from_ours(own)
    raise CameraMissing(folder, "no camera", f"put cameras.txt or camera.json there or beside {MAPS}")


def _counts_from_one(numbers: Sequence[int], convention: MapConvention) -> bool:
    """Whether the trajectory counts as CLiMB does and the frames do not."""
    frames = convention.frames
    return bool(frames is not None and 0 in frames.numbers and 0 not in numbers and not convention.frame_offset)


def _localised(trajectory: Path, convention: MapConvention) -> tuple[int, ...] | None:
    """Numbers of the frames in a map's trajectory, where it has one that can be read."""
    try:
        poses = read_trajectory(trajectory) if trajectory.is_file() else []
        return tuple(frame_number(p.name) + convention.frame_offset for p in poses) or None
    except InputError:
        return None


def spread(poses: Sequence[TrajectoryPose], points: np.ndarray) -> list[int]:
    """Rows of the poses that stand for all, as a SLAM's keyframes do: each so far from the one before that the
    view is another one."""
    chosen: list[int] = []
    near = 0.0
    for row, pose in enumerate(poses):
        if chosen:
            last = poses[chosen[-1]].cam_from_map
            step = pose.cam_from_map @ np.linalg.inv(last)
            turned = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
            if np.linalg.norm(step[:3, 3]) < _STEP * near and turned < _TURN:
                continue
        inside = points @ pose.cam_from_map[:3, :3].T + pose.cam_from_map[:3, 3]
        distance = np.linalg.norm(inside[inside[:, 2] > 0], axis=1)
        near = float(np.quantile(distance, 0.25)) if len(distance) else 0.0
        chosen.append(row)
    return chosen


def write_multimap(
    sparse_map: SparseMap,
    folder: Path,
    trajectories: Mapping[int, Mapping[str, np.ndarray]] | None = None,
    times: Mapping[str, float] | None = None,
    fps: float = 30.0,
) -> None:
    """The tree as the exporter writes it; `folder` is made.

    trajectories: for each map id the cam_from_map (4, 4) of every localised frame by name; left out, only keyframes.
    times [s] by frame name; left out, frame number / fps. Names become six-digit frame numbers, as the exporter's are.
    """
    for submap in map(at_its_place, sparse_map.submaps):
        map_folder = Path(folder) / MAPS / str(submap.id)
        map_folder.mkdir(parents=True, exist_ok=True)
        _write_map(submap, map_folder)
        path = trajectory_path(Path(folder), submap.id)
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_trajectory(submap, path, (trajectories or {}).get(submap.id, {}), times or {}, fps)


def _write_map(submap: Submap, folder: Path) -> None:
    cameras = list(dict.fromkeys(k.camera for k in submap.keyframes))
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        f"# Number of cameras: {len(cameras)}",
    ]
    for camera_id, camera in enumerate(cameras):
        params = camera.with_pixel_center(1.0).params  # moves the origin by -0.5: ours to OpenCV's
        numbers = " ".join(_decimals(p, 6) for p in params)
        lines.append(f"{camera_id} {camera.name} {camera.width} {camera.height} {numbers}")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")

    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for image_id, keyframe in enumerate(submap.keyframes):
        pose = (*quaternion_from_pose(keyframe.cam_from_map), *keyframe.cam_from_map[:3, 3])
        numbers = " ".join(f"{v:.15f}" for v in pose)
        lines.append(f"{image_id} {numbers} {cameras.index(keyframe.camera)} {keyframe.number:06d}.png")
        lines.append(
            " ".join(
                f"{_decimals(u - 0.5, 4)} {_decimals(v - 0.5, 4)} {point_id}"
                for (u, v), point_id in zip(keyframe.pixels.tolist(), keyframe.point_ids.tolist(), strict=True)
            )
        )
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")

    lines = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    for point_id, (x, y, z) in zip(submap.point_ids.tolist(), submap.points.tolist(), strict=True):
        lines.append(f"{point_id} {x:.15f} {y:.15f} {z:.15f} 0 0 0 0 ")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")


def _write_trajectory(
    submap: Submap, path: Path, frames: Mapping[str, np.ndarray], times: Mapping[str, float], fps: float
) -> None:
    keyframes = {k.number: (k.name, k.cam_from_map) for k in submap.keyframes}
    poses = keyframes | {frame_number(name): (name, pose) for name, pose in frames.items()}
    lines = [_TRAJECTORY_HEADER]
    for number, (name, cam_from_map) in sorted(poses.items()):
        map_from_cam = np.linalg.inv(cam_from_map)
        pose = ",".join(f"{v:.9f}" for v in (*map_from_cam[:3, 3], *quaternion_from_pose(map_from_cam)))
        time = times.get(name, number / fps)
        lines.append(f"{time:.6f},{number:06d}.png,{pose},{int(number in keyframes)},0,-1")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")


def _decimals(value: float, least: int) -> str:
    """The number with as few decimals as the exporter writes where that is exact, else with 12."""
    short = f"{value:.{least}f}"
    return short if abs(float(short) - value) < 1e-11 else f"{value:.12f}"
