"""A TUM trajectory of keyframes with a point cloud, as users of ORB-SLAM3 have them.

    <folder>/KeyFrameTrajectory.txt, or one *.tum or *.txt     `t tx ty tz qx qy qz qw`, map-from-camera
    <folder>/points3D.txt, or one *.ply, or one file of `x y z` lines
    <folder>/camera.json or cameras.txt                        one camera
    <folder>/densify_map.json                                  `fps`, unless t is a frame number already or the frames
                                                               are stamped themselves; `time_offset`, where t is of
                                                               another clock

Nothing here says which keyframe observed which point. It is guessed: every point in view that no nearer one hides.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lightdepth.calibration import read_camera
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.colmap_cameras import read_cameras_text
from lightdepth.files.meshes import read_cloud
from lightdepth.files.text import is_comment, parse_numbers, text_lines
from lightdepth.files.tum import read_tum
from lightdepth.maps.checks import guessed
from lightdepth.maps.colmap import assembled, read_points_text
from lightdepth.maps.convention import EXPORTER, CameraMissing, MapConvention, Reader
from lightdepth.sparse_map import Submap

TUM = replace(EXPORTER, pose_convention="c2w")
WITHOUT_POINTS = "a trajectory without points"
POINTS_NEEDED = (
    "a dense map needs the map's points and which keyframe saw them: give a COLMAP model or the multi-map tree "
    "(3D_maps/<id>/), or put points3D.txt, a PLY or a file of `x y z` lines, and camera.json, beside the trajectory. "
    "Or leave the map out and let `sparse` make one"
)
_KEYFRAMES = "KeyFrameTrajectory.txt"
_OTHERS = ("cameras.txt", "images.txt", "points3D.txt", "intrinsics.txt")  # numbers in columns too, but not ours


def holds_trajectory(folder: Path) -> bool:
    """Whether a TUM trajectory lies in the folder, and no images file of a model that would say more."""
    return bool(_trajectories(folder)) and not any(
        (folder / f"images{suffix}").is_file() for suffix in (".txt", ".bin")
    )


def holds_points(folder: Path) -> bool:
    return bool(_clouds(folder))


def read_tum_map(folder: Path, reader: Reader) -> Submap:
    """The folder's keyframes, named by frame number, and points; what they observed is guessed, with a warning.

    Raises InputError, naming the file and what to add or correct.
    """
    found = _trajectories(folder)
    of_keyframes = [p for p in found if "keyframe" in p.name.lower()]
    trajectory = _only(of_keyframes or found, folder, "trajectories", f"name the one of the keyframes {_KEYFRAMES}")
    clouds = _clouds(folder)
    if not clouds:
        raise InputError(trajectory, WITHOUT_POINTS, POINTS_NEEDED)
    cloud = _only(clouds, folder, "point clouds", "leave one")
    convention = reader.convention(folder, 0, TUM)
    camera = _camera(folder, convention, reader)
    times, poses = read_tum(trajectory)
    names = convention.clock.names(times, trajectory, begun(folder))
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    keyframes = [convention.keyframe(name, camera, pose, *none) for name, pose in zip(names, poses, strict=True)]
    submap = assembled(folder, 0, keyframes, *_read_cloud(cloud), check=guessed)
    return replace(submap, guessed_clock=convention.clock.guesses(times))


def _only(paths: list[Path], folder: Path, what: str, cure: str) -> Path:
    if len(paths) > 1:
        raise InputError(folder, f"several {what} ({', '.join(p.name for p in paths)})", cure)
    return paths[0]


def _trajectories(folder: Path) -> list[Path]:
    return [folder / _KEYFRAMES] if (folder / _KEYFRAMES).is_file() else _all_trajectories(folder)


def _all_trajectories(folder: Path) -> list[Path]:
    return [p for p in _texts(folder, (".tum", ".txt")) if _columns(p) == 8]


def _clouds(folder: Path) -> list[Path]:
    if (folder / "points3D.txt").is_file():
        return [folder / "points3D.txt"]
    lines = [p for p in _texts(folder, (".xyz", ".txt")) if _columns(p) == 3]
    return sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() == ".ply") + lines


def _texts(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in suffixes and p.name not in _OTHERS)


def first_entry(path: Path) -> str:
    """The first line that is not a comment; empty where there is none or the file is not text."""
    try:
        with path.open(encoding="utf-8-sig") as lines:
            return next((line for line in lines if not is_comment(line)), "")
    except (OSError, UnicodeDecodeError):
        return ""


def _columns(path: Path) -> int:
    """How many numbers the first line holds; 0 when something in it is not a number."""
    try:
        return len([float(word) for word in first_entry(path).split()])
    except ValueError:
        return 0


def is_trajectory(path: Path) -> bool:
    """Whether the first line looks like TUM's `t tx ty tz qx qy qz qw`."""
    return path.name not in _OTHERS and _columns(path) == 8


def begun(folder: Path) -> tuple[float, str] | None:
    """The first stamp of any trajectory in a folder, and the name of its file: that of all frames begins before that
    of the keyframes, where a SLAM writes both. None where there is none."""
    stamps = [(float(first_entry(path).split()[0]), path.name) for path in _all_trajectories(folder)]
    return min(stamps, default=None)


def _camera(folder: Path, convention: MapConvention, reader: Reader) -> CameraModel:
    """The folder's camera, its pixels as the map has them: camera.json says what its own are, cameras.txt does not."""
    if (folder / "camera.json").is_file():
        return convention.from_ours(read_camera(folder / "camera.json"))
    path = folder / "cameras.txt"
    if not path.is_file():
        if reader.camera is not None:
            return convention.from_ours(reader.camera)
        raise CameraMissing(
            folder, "no camera", "a trajectory with points needs camera.json or cameras.txt beside them"
        )
    cameras = list(read_cameras_text(path).values())
    if len(cameras) != 1:
        raise InputError(path, f"{len(cameras)} cameras", "a trajectory does not say whose it is, expected exactly one")
    return cameras[0]


def _read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Point ids (n,) and points (n, 3); ids count from 0 where the file has none."""
    if path.suffix.lower() == ".ply":
        points = read_cloud(path)
    elif _columns(path) == 3:
        points = _read_xyz(path)
    else:
        return read_points_text(path)
    return np.arange(len(points), dtype=np.int64), points


def _read_xyz(path: Path) -> np.ndarray:
    points = []
    for number, line in enumerate(text_lines(path), 1):
        if is_comment(line):
            continue
        where, words = f"{path}, line {number}", line.split()
        if len(words) != 3:
            raise InputError(where, f"{len(words)} columns", "expected x y z")
        points.append(parse_numbers(words, where, "x y z"))
    return np.array(points).reshape(-1, 3)
