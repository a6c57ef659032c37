"""How the endoscope moves through a synthetic colon, and which part of the image its optics light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from torch import Tensor

from lightdepth.camera import CameraModel, KannalaBrandt, Pinhole
from lightdepth.datasets.c3vd import C3VD
from lightdepth.errors import InputError
from lightdepth.ranges import SHARE, Range, checked, ends_of
from lightdepth.tube.shape import CLOSING, TubeShape

Lens = Literal["pinhole", "telescope", "fisheye", "c3vd"]


_FIRST = 8.0, 9.0
"""Where a path begins at the earliest, and at the latest in a tube that is no longer than it, mm."""


@dataclass(frozen=True)
@checked
class PathConfig:
    """How the endoscope moves; pairs are the ends of a uniform range."""

    sway: Annotated[float, SHARE] = 0.13
    """Standard deviation of how far the path strays from the colon's centreline, in each of two directions, as a share
    of the radius; it is cut off at 2.3 times that. A larger one brings the camera nearer to the wall."""
    turned: Annotated[tuple[float, float], ends_of(Range(0, math.pi))] = (0.0, 0.0)
    """Ends of the range of the angle, radians, by which each view is turned away from straight ahead, each in a
    direction of its own; (0, 0) looks ahead. A larger one looks at walls more from the front, and makes neighbouring
    frames less alike."""


def lens(kind: str, width: int, height: int) -> CameraModel:
    """A typical lens: "pinhole" (90 degrees across), "telescope" (70: rigid optics), "fisheye" (136) or "c3vd"."""
    centre = (width / 2, height / 2)
    if kind == "pinhole":
        return Pinhole(width, height, width / 2, width / 2, *centre)
    if kind == "telescope":
        return Pinhole(width, height, 0.714 * width, 0.714 * width, *centre)
    if kind == "fisheye":
        f = 0.52 * width
        return KannalaBrandt(width, height, f, f, *centre, -0.13, -0.005, 0.0015, -0.0001)
    if kind == "c3vd":
        return C3VD.resized(width, height)
    raise InputError("lens", f"{kind!r} is not known", "expected pinhole, telescope, fisheye or c3vd")


def octagon(camera: CameraModel, cut: float = 0.2) -> np.ndarray:
    """(H, W) bool: the image without its corners, cut at `cut` of the height; endoscopes mask them."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    from_corner = np.minimum(u, camera.width - u) + np.minimum(v, camera.height - v)
    result: np.ndarray = from_corner > cut * camera.height
    return result


def any_field(camera: CameraModel, rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool: a field of view as some endoscope's mask has it, an octagon or a circle, not quite centred."""
    if rng.random() < 0.5:
        return octagon(camera, rng.uniform(0.05, 0.35))
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (np.array([camera.width, camera.height]) / 2) * rng.uniform(0.94, 1.06, 2)
    result: np.ndarray = np.hypot(u - x, v - y) < rng.uniform(0.4, 0.65) * camera.height
    return result


def camera_path(
    shape: TubeShape,
    count: int,
    travel: float,
    rng: np.random.Generator,
    start: float | None = None,
    config: PathConfig = PathConfig(),
) -> np.ndarray:
    """Poses world_from_cam (count, 4, 4) [mm]: `travel` mm along the tube, with sway and looking about. Raises
    InputError where the tube is not as long as that."""
    length, radius = (len(shape.centers) - 1) * shape.step, float(shape.radius.mean())
    if (longest := length - _FIRST[1] - CLOSING * radius) < travel:
        raise InputError(
            "the endoscope's way",
            f"{travel:g} mm, in a colon of {length:g} mm",
            f"expected at most {max(longest, 0.0):.0f} mm here, or a longer colon (shape.length)",
        )
    latest = max(_FIRST[1], length - travel - 2.5 * radius)
    first = rng.uniform(_FIRST[0], latest) if start is None else start
    s = first + np.linspace(0, travel, count)
    smooth = max(2.0, count / 5)

    def wander(scale: float) -> np.ndarray:
        noise = gaussian_filter1d(rng.standard_normal(count + 40), smooth)[20:-20]
        return (
            scale * (noise / max(noise.std(), 0.3) + rng.normal(0, 0.7)) if count > 1 else scale * rng.normal(0, 1, 1)
        )

    row = np.clip(s / shape.step, 0, len(shape.centers) - 1)
    floor = np.minimum(row.astype(int), len(shape.centers) - 2)
    part = (row - floor)[:, None]
    radius = shape.radius[floor]
    side, up = shape.frames[floor, 1], shape.frames[floor, 2]
    centers = shape.centers[floor] * (1 - part) + shape.centers[floor + 1] * part
    # Parallel-transported frames turn slowly: interpolate so that the path has no steps.
    side = side * (1 - part) + shape.frames[floor + 1, 1] * part
    up = up * (1 - part) + shape.frames[floor + 1, 2] * part
    furthest = 0.3 * config.sway / 0.13
    sway = np.stack([wander(config.sway), wander(config.sway)], -1).clip(-furthest, furthest) * radius[:, None]
    positions = centers + sway[:, :1] * side + sway[:, 1:] * up
    ahead = np.minimum(floor + round(18 / shape.step), len(shape.centers) - 1)
    forward = shape.centers[ahead] - positions
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    look = np.stack([wander(0.12), wander(0.12)], -1)
    roll = wander(0.15)

    aside = [np.eye(3)] * count
    if max(config.turned) > 0:
        (own,) = rng.spawn(1)  # views straight ahead stay as they were
        angle, towards = own.uniform(*config.turned, count), own.uniform(0, 2 * np.pi, count)
        aside = list(
            Rotation.from_rotvec(
                np.stack([np.cos(towards), np.sin(towards), 0 * angle], -1) * angle[:, None]
            ).as_matrix()
        )

    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        right = np.cross(up[i], forward[i])
        right /= np.linalg.norm(right)
        base = np.stack([right, np.cross(forward[i], right), forward[i]], -1)
        turned = Rotation.from_euler("xyz", [look[i, 0], look[i, 1], roll[i]]).as_matrix()
        poses[i, :3, :3] = base @ aside[i] @ turned
        poses[i, :3, 3] = positions[i]
    return poses


def image_flow(distance: Tensor, camera: CameraModel, length: float, rngs: Sequence[np.random.Generator]) -> Tensor:
    """Flow (B, H, W, 2) [px] during an exposure, of median length `length` times the image height, for random motions.

    The endoscope shifts and turns at once, drawn from one generator a view; distance (B, H, W) in mm, 0 where unknown:
    there the flow is 0.
    """
    motions = [(rng.normal(0, (0.15, 0.15, 0.3)), rng.normal(0, 0.01, 3), rng.uniform(0, 2)) for rng in rngs]
    shift, turn, reach = (
        torch.as_tensor(np.array(column), dtype=distance.dtype, device=distance.device).reshape(len(rngs), 1, 1, -1)
        for column in zip(*motions, strict=True)
    )
    known = distance > 0
    rays = torch.tensor(camera.rays()[0], dtype=distance.dtype, device=distance.device)
    points = torch.where(known[..., None], rays * distance[..., None], rays)
    ahead, ahead_valid = camera.project(points + shift + torch.linalg.cross(turn.expand_as(points), points))
    rows, columns = (torch.arange(n, dtype=points.dtype, device=points.device) + 0.5 for n in distance.shape[1:])
    here = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    moved = torch.where((known & ahead_valid)[..., None], ahead - here, 0)
    size = torch.hypot(*moved.unbind(-1))
    medians = [
        one[inside].median() if inside.any() else one.new_ones(()) for one, inside in zip(size, known, strict=True)
    ]
    reach = reach * length * distance.shape[1]
    scale = reach / torch.stack(medians).clamp(min=1e-6).reshape(-1, 1, 1, 1)
    longest = 4 * reach / (size[..., None] * scale).clamp(min=1e-6)
    return moved * scale * longest.clamp(max=1)
