"""What a frame of a synthetic colon sees of the wall: points at corners of its image, and points of others."""

from __future__ import annotations

import cv2
import numpy as np

from lightdepth.errors import InputError
from lightdepth.frame import Frame


def true_pose(frame: Frame) -> np.ndarray:
    """world_from_cam (4, 4), mm."""
    if frame.true_world_from_cam is None or frame.true_distance is None:
        raise InputError(
            frame.name, "no true distance or no true pose", "a SLAM can only be simulated on frames with both"
        )
    return frame.true_world_from_cam


def points_at_corners(frame: Frame, count: int) -> np.ndarray:
    """World points (n, 3), `count` at most, at corners of the image, where the wall is known; the clearest first."""
    pose, truth = true_pose(frame), frame.true_distance
    assert truth is not None
    usable = cv2.erode((frame.valid & (truth > 0)).astype(np.uint8), np.ones((7, 7), np.uint8))
    grey = cv2.cvtColor((frame.image * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(grey, count, 0.001, 3, mask=usable)
    if corners is None:
        return np.zeros((0, 3))
    pixels = corners.reshape(-1, 2) + 0.5
    column, row = pixels.astype(int).T
    rays, valid = frame.camera.unproject(np.stack([column, row], -1) + 0.5)
    points = rays * truth[row, column, None]
    result: np.ndarray = (points @ pose[:3, :3].T + pose[:3, 3])[valid]
    return result


def projected(frame: Frame, world: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of world points (n, 3)."""
    pose = true_pose(frame)
    result: np.ndarray = frame.camera.project((world - pose[:3, 3]) @ pose[:3, :3])[0]
    return result


def sees(frame: Frame, world: np.ndarray) -> np.ndarray:
    """(n,) bool: in the image, inside the mask, and not behind the wall."""
    pose, truth = true_pose(frame), frame.true_distance
    assert truth is not None
    in_cam = (world - pose[:3, 3]) @ pose[:3, :3]
    pixels, valid = frame.camera.project(in_cam)
    column = np.clip(pixels[:, 0].astype(int), 0, frame.camera.width - 1)
    row = np.clip(pixels[:, 1].astype(int), 0, frame.camera.height - 1)
    at_wall = np.abs(truth[row, column] / np.linalg.norm(in_cam, axis=1).clip(min=1e-9) - 1) < 0.03
    result: np.ndarray = valid & frame.valid[row, column] & at_wall
    return result
