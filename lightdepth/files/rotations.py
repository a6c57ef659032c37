"""Poses as unit quaternions and translations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.errors import InputError


def pose_from_quaternion(quaternion: np.ndarray, translation: np.ndarray, where: str) -> np.ndarray:
    """(4, 4) from a quaternion (w, x, y, z) and a translation (3,)."""
    if not (np.isfinite(quaternion).all() and np.isfinite(translation).all()):
        raise InputError(where, "the pose has NaN or infinite numbers", "leave out what was not localised")
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-2:
        raise InputError(where, f"quaternion of norm {norm:.4g}", "expected 1 (order w x y z)")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    pose[:3, 3] = translation
    return pose


def quaternion_from_pose(pose: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z), w >= 0, of a pose's rotation."""
    result: np.ndarray = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return result
