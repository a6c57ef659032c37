"""A run folder of a tube whose lengths are known, with frames whose folder is called like a patient."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from densify.alignment import Alignment
from densify.dense_map import DenseMap
from lightdepth.camera import Pinhole
from lightdepth.files.named_inputs import write_inputs
from lightdepth.sparse_map import Keyframe, Submap

RADIUS, LENGTH, CANARY = 8.0, 40.0, "muellerheinz"
CAMERA = Pinhole(64, 48, 40.0, 40.0, 32.0, 24.0)
AT = (4.0, 10.0, 16.0, 22.0)
"""Where along the tube its keyframes were taken; each has a grey of its own."""


def tube(around: int = 90, along: int = 80, radius: float = RADIUS) -> tuple[np.ndarray, np.ndarray]:
    """An open tube around the z axis, its fronts inside."""
    angle, z = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(0, LENGTH, along + 1), indexing="xy")
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).reshape(-1, 3)
    row, column = (i.ravel() for i in np.mgrid[:along, :around])
    corner, beside = row * around + column, row * around + (column + 1) % around
    first = np.stack([corner, corner + around, beside], 1)
    return vertices, np.concatenate([first, np.stack([beside, corner + around, beside + around], 1)])


def dense_tube(number: int = 0, radius: float = RADIUS) -> DenseMap:
    vertices, triangles = tube(radius=radius)
    poses = [np.eye(4) for _ in AT]
    for pose, z in zip(poses, AT, strict=True):
        pose[2, 3] = -z
    none = np.zeros((0, 2)), np.zeros(0, int)
    keyframes = tuple(Keyframe(f"{i:06d}.png", CAMERA, pose, *none) for i, pose in enumerate(poses))
    points = np.array([[radius, 0, 5.0], [0, radius, 9.0], [1, 1, 20.0]])
    good, bad = np.array([1, 2]), np.array([3])
    alignments = tuple(
        Alignment(k.name, 1.0, 0.1, inlier_ids=good, outlier_ids=bad)
        if i < 3
        else Alignment(k.name, reason="too few points")
        for i, k in enumerate(keyframes)
    )
    colors = np.stack([vertices[:, 2] / LENGTH, np.full(len(vertices), 0.4), np.full(len(vertices), 0.3)], 1)
    seen = np.full(len(vertices), 3.0), np.full(len(vertices), 4)
    submap = Submap(number, keyframes, np.array([1, 2, 3]), points)
    return DenseMap(submap, vertices, triangles, colors, alignments, 0.5, "mm", *seen)


def write_frames(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for i in range(len(AT)):
        cv2.imwrite(str(folder / f"{i:06d}.png"), np.full((48, 64, 3), 40 + 50 * i, np.uint8))
    return folder


def write_run(folder: Path, frames: Path | None = None, maps: int = 1) -> Path:
    """A finished run in mm."""
    folder.mkdir()
    for number in range(maps):
        dense_tube(number, RADIUS + number).write(folder / f"map_{number:03d}")
    arguments = {"data": "data-0a1b2c3d"} if frames is not None else {}
    (folder / "run.json").write_text(json.dumps({"verb": "densify", "unit": "mm", "arguments": arguments}))
    if frames is not None:
        write_inputs(folder, {"data-0a1b2c3d": str(frames)})
    return folder
