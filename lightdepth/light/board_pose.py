"""Where a board stands before the camera, and the brightness of its white paper there.

The pose is found on rays, by a planar PnP, and refined in the pixels of the program's own camera, so that every lens is
as good as a pinhole. Notation: X (3,) a place in camera axes [mm], n the board's normal, towards the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from lightdepth.camera import CameraModel
from lightdepth.frame import Frame
from lightdepth.light.board import LEAST_CORNERS, Board, Sighting
from lightdepth.light.views import SATURATED

V_RANGE = (0.06, 0.92)  # darker is noise, brighter is where tone curves bend
_MARGIN = 2.0  # pixels between what is taken for white and the next edge: the blur of lens and pixels
_CELLS = 3  # a square is that many cells across, in each of which white is averaged
_LEAST_PIXELS = 5


@dataclass(frozen=True)
class Pose:
    """cam_from_board (4, 4) [mm], and the root mean square error of the corners in pixels."""

    cam_from_board: np.ndarray
    error: float

    @property
    def normal(self) -> np.ndarray:
        """(3,), towards the camera."""
        axis, shift = self.cam_from_board[:3, 2], self.cam_from_board[:3, 3]
        towards: np.ndarray = -axis if axis @ shift > 0 else axis
        return towards

    @property
    def distance(self) -> float:
        """Of the board's plane from the camera, mm."""
        return float(abs(self.cam_from_board[:3, 2] @ self.cam_from_board[:3, 3]))

    @property
    def tilt(self) -> float:
        """Degrees between the board's normal and the camera's axis."""
        return float(np.degrees(np.arccos(np.clip(-self.normal[2], -1, 1))))


@dataclass(frozen=True)
class White:
    """White paper of one frame, a cell a row: X (n, 3), log of the code value (n,), its deviation by noise (n,)."""

    name: str
    pose: Pose
    places: np.ndarray
    log_v: np.ndarray
    noise: np.ndarray
    clipped: float
    """share of the white pixels that are saturated"""

    def __len__(self) -> int:
        return len(self.log_v)

    def thinned(self, most: int) -> White:
        """At most so many cells, spread evenly over them."""
        if len(self) <= most:
            return self
        kept = np.linspace(0, len(self) - 1, most).round().astype(int)
        return replace(self, places=self.places[kept], log_v=self.log_v[kept], noise=self.noise[kept])


def board_pose(camera: CameraModel, sighting: Sighting) -> Pose | None:
    """The pose under which the corners err least; None where fewer than eight lie in the camera's field."""
    rays, valid = camera.unproject(sighting.pixels)
    use = valid & (rays[:, 2] > 0.05)
    if use.sum() < LEAST_CORNERS:
        return None
    board = np.concatenate([sighting.places[use], np.zeros((use.sum(), 1))], 1)
    plane, pixels = rays[use, :2] / rays[use, 2:], sighting.pixels[use]
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(board, plane, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # corners on one line
        return None

    def errors(pose: np.ndarray) -> np.ndarray:
        found: np.ndarray = camera.project(board @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])[0] - pixels
        return found.ravel()

    refined = [
        least_squares(errors, np.concatenate([turn.ravel(), shift.ravel()]), loss="soft_l1", f_scale=0.5, max_nfev=50)
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    best = min(refined, key=lambda one: float(one.cost))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(best.x[:3])[0], best.x[3:]
    return Pose(pose, float(np.sqrt(2 * np.mean(np.square(errors(best.x))))))


def white_paper(frame: Frame, pose: Pose, board: Board) -> White:
    """Cells of white paper that are neither saturated nor dark."""
    rays, valid = frame.camera.rays()
    turn, shift = pose.cam_from_board[:3, :3], pose.cam_from_board[:3, 3]
    falling, reach = rays @ turn[:, 2], float(turn[:, 2] @ shift)
    hit = valid & (frame.valid) & (falling * np.sign(reach) > 0.05)
    distance = np.where(hit, reach / np.where(hit, falling, 1), 0.0)
    print_xy = (rays * distance[..., None] - shift) @ turn[:, :2]
    steps = [np.linalg.norm(np.gradient(print_xy, axis=axis), axis=-1) for axis in (0, 1)]
    rows, columns = np.nonzero(hit)
    on_print, step = print_xy[rows, columns], np.maximum(*steps)[rows, columns]
    white = board.white_within(on_print) > _MARGIN * step
    rows, columns, on_print = rows[white], columns[white], on_print[white]
    image = frame.image[rows, columns]
    saturated = image.max(-1, initial=0) >= SATURATED
    clipped = float(saturated.mean()) if len(image) else 0.0
    channel = int(np.median(image, axis=0).argmax()) if len(image) else 0  # one, as tone curves are of each by itself
    v = image[:, channel].astype(float)
    cell = np.floor(on_print * (_CELLS / board.square_mm)).astype(int)
    cells, of = np.unique(cell, axis=0, return_inverse=True)
    of, n = of.ravel(), len(cells)
    count = np.maximum(np.bincount(of, minlength=n), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        found: np.ndarray = np.bincount(of, values, n) / count
        return found

    level, spread = mean(v), np.sqrt(np.maximum(mean(v**2) - mean(v) ** 2, (1 / 255) ** 2 / 12))
    clean = (count >= _LEAST_PIXELS) & (mean(saturated.astype(float)) == 0)
    clean &= (level >= V_RANGE[0]) & (level <= V_RANGE[1])
    at = np.stack([mean(axis) for axis in on_print.T], -1)[clean] if n else np.zeros((0, 2))
    level, spread, count = level[clean], spread[clean], count[clean]
    places = at @ turn[:, :2].T + shift
    return White(frame.name, pose, places, np.log(level), spread / level / np.sqrt(count), clipped)
