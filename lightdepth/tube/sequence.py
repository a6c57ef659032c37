"""Frames of a synthetic colon with exact distance and pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube.breathing import Breathing, BreathingConfig
from lightdepth.tube.casting import rendering_device
from lightdepth.tube.path import camera_path, lens, octagon
from lightdepth.tube.scene import Tube, TubeConfig

_PIXELS_AT_ONCE = {"cpu": 500_000, "cuda": 4_000_000}  # some 200 MB, and 2 GB


@dataclass(frozen=True)
class TubeSequence:
    """Rendered frames, the colon they were rendered from, and how its wall moves; None where it rests."""

    frames: list[Frame]
    tube: Tube
    breathing: Breathing | None = None


def render_sequence(
    seed: int,
    count: int,
    camera: CameraModel,
    travel: float = 25.0,
    config: TubeConfig | None = None,
    light: PhotometricCalibration | None = None,
    progress: Callable[[int, int], None] | None = None,
    kind: type[Tube] = Tube,
    mask: np.ndarray | None = None,
    device: str = "auto",
    breathing: BreathingConfig | None = None,
    times: Sequence[float] | None = None,
) -> TubeSequence:
    """A colon drawn from `seed`, seen in `count` frames along `travel` mm. Frames carry the light's true calibration
    with gain 1 (exposure is automatic, so the true gain differs per frame), distance and pose in mm. `mask` (H, W) is
    the field of view, an octagon if left out. Rendered on `device` (auto: the GPU where there is one) in batches: a
    seed gives the same frames everywhere, up to rounding. A wall that is `breathing` is another one in
    each frame, which takes longer. `times` (count,) are the frames' own, s; left out, there are 30 a second. Raises
    InputError for a device that is not there."""
    rng = np.random.default_rng(seed)
    config = config or TubeConfig()
    tube = kind(config, rng, light, rendering_device(device))
    mask = octagon(camera) if mask is None else mask
    poses = camera_path(tube.shape, count, travel, rng, config=config.path)
    at_once = max(1, _PIXELS_AT_ONCE[tube.device.type] // mask.size)
    moving = None
    if breathing is not None and breathing.amplitude > 0:
        moving, at_once = Breathing(tube.shape, breathing), 1
    when = [n / 30.0 for n in range(count)] if times is None else list(times)
    assert len(when) == count, (len(when), count)
    frames: list[Frame] = []
    for first in range(0, count, at_once):
        batch = poses[first : first + at_once]
        seen = tube if moving is None else tube.reshaped(moving.shape_at(when[first]))
        for pose, view in zip(batch, seen.views(batch, camera, mask, rng), strict=True):
            frames.append(
                Frame(
                    f"{len(frames):06d}",
                    view.image,
                    camera,
                    replace(tube.light, gain=1.0),
                    mask,
                    time=when[len(frames)],
                    true_distance=view.distance,
                    true_world_from_cam=pose,
                )
            )
            if progress is not None:
                progress(len(frames), count)
    return TubeSequence(frames, tube, moving)


def tube_frames(
    seed: int,
    count: int,
    camera: CameraModel | None = None,
    travel: float = 60.0,
    config: TubeConfig | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    device: str = "auto",
) -> list[Frame]:
    """Frames for training: `count` views spread over `travel` mm of one colon (C3VD's lens at 160x128 by default)."""
    camera = camera or lens("c3vd", 160, 128)
    frames = render_sequence(seed, count, camera, travel, config, light, mask=mask, device=device).frames
    return [replace(frame, name=f"tube{seed}_{frame.name}") for frame in frames]
