"""TUM trajectories: time, position and quaternion of the camera in the world, a line each; KITTI's poses are read too:
12 numbers a line, the upper rows of the matrix camera to world, the first line frame 0's."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.errors import InputError
from lightdepth.files.reading import LARGEST_NUMBER, reading


def write_tum(path: Path, times: Iterable[float], world_from_cam: Iterable[np.ndarray]) -> None:
    """`t tx ty tz qx qy qz qw`, camera to world."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = []
    for time, pose in zip(times, world_from_cam, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(" ".join([f"{time:.6f}", *(f"{v:.9f}" for v in (*pose[:3, 3], *quaternion))]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and poses world_from_cam (n, 4, 4) of a TUM trajectory, or of KITTI's poses, whose times are the
    numbers of the frames."""
    with reading(path, "a TUM trajectory", "expected lines of 8 numbers: t tx ty tz qx qy qz qw"):
        rows: np.ndarray = np.loadtxt(path, ndmin=2, encoding="utf-8-sig")
    if rows.shape[1] not in (8, 12):
        raise InputError(path, f"{rows.shape[1]} columns", "expected 8: t tx ty tz qx qy qz qw, or 12 (KITTI's poses)")
    if not np.isfinite(rows).all():
        line = int((~np.isfinite(rows)).any(1).argmax()) + 1
        raise InputError(path, f"line {line} has NaN or infinite numbers", "expected a pose for each frame")
    if (beyond := np.abs(rows) > LARGEST_NUMBER * 1e10).any() or np.abs(rows[:, 1:]).max(initial=0) > LARGEST_NUMBER:
        line = int((beyond | (np.abs(rows) > LARGEST_NUMBER)).any(1).argmax()) + 1
        raise InputError(path, f"line {line} has numbers beyond {LARGEST_NUMBER:g}", "expected a pose for each frame")
    if rows.shape[1] == 12:
        return _kitti(rows, path)
    length = np.linalg.norm(rows[:, 4:], axis=1)
    if (length < 1e-6).any():
        raise InputError(
            path, f"line {int((length < 1e-6).argmax()) + 1}: the quaternion qx qy qz qw is zero", "expected length 1"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


def _kitti(rows: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    turns = poses[:, :3, :3]
    wrong = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) > 1e-3
    if wrong.any() or (np.linalg.det(turns) < 0).any():
        line = int((wrong | (np.linalg.det(turns) < 0)).argmax()) + 1
        raise InputError(path, f"line {line}: its 12 numbers hold no rotation", "expected r r r t, three times")
    return np.arange(len(rows), dtype=float), poses
