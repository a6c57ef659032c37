"""What a file's poses might mean: the mistakes that people make with them, each with what a message says of it.

Expected everywhere is world_from_cam (4, 4), camera axes x right, y down, z into the scene.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Reading = Callable[[np.ndarray], np.ndarray]
"""From a pose (4, 4) as a file has it to the world_from_cam that it means."""


def as_is(pose: np.ndarray) -> np.ndarray:
    return pose


def transposed(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, :3] = pose[:3, :3].T
    return pose


def opengl(pose: np.ndarray) -> np.ndarray:
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def left_handed(pose: np.ndarray) -> np.ndarray:
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    result: np.ndarray = flip @ pose @ flip
    return result


AS_GIVEN = "as given"
INVERSE = "with the poses inverted: they are camera-from-world (w2c), expected is world-from-camera (c2w)"
_TURNED = "the camera's y and z axes turned: they are OpenGL's (y up, z backwards), expected is y down, z forward"
POSE_READINGS: dict[str, Reading] = {
    AS_GIVEN: as_is,
    INVERSE: np.linalg.inv,
    "with the rotations transposed: they are written column by column": transposed,
    f"with {_TURNED}": opengl,
    f"{INVERSE}, and {_TURNED}": lambda pose: opengl(np.linalg.inv(pose)),
    "with y mirrored: the poses are in left-handed axes, as Unity's": left_handed,
}
"""What poses might mean, by how a message says it."""
