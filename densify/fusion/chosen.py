"""The volume that suits a device: compiled loops on the processor, NVIDIA Warp on a GPU that gives the same numbers."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Protocol

import numpy as np

from densify.fusion.marching_cubes import Cut
from densify.fusion.rectify import RectifyConfig, SurfaceView, surface_view
from densify.fusion.volume import FusionConfig, Mesh, TsdfVolume
from lightdepth import native
from lightdepth.camera import Pinhole
from lightdepth.prediction import DepthPrediction


class Volume(Protocol):
    """What TsdfVolume is and DeviceVolume too; their docstrings say what each does."""

    voxel: float
    views: int

    def integrate(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray: ...

    def remove(self, view: SurfaceView, cam_from_map: np.ndarray) -> np.ndarray: ...

    @property
    def places(self) -> np.ndarray: ...

    def slots(self, codes: np.ndarray) -> np.ndarray: ...

    def cut(self, slots: np.ndarray) -> Cut: ...

    def colors_at(self, found: Cut) -> np.ndarray: ...

    def extract_mesh(self) -> Mesh: ...


def volume_on(device: str, voxel: float, config: FusionConfig) -> Volume:
    """An empty volume for networks' device, as PyTorch names it. On a CUDA GPU it lies there, if Warp is installed
    (extra gpu) and adds up the same numbers there as the loops do; else, and with a warning where it does not, it is
    the processor's."""
    if device.startswith("cuda") and native.has_warp():
        wrong = unlike(device)
        if not wrong:
            from densify.fusion.on_device.volume import DeviceVolume

            return DeviceVolume(voxel, config, device)
        warnings.warn(f"surfaces are fused on the processor: on {device}, {wrong}", stacklevel=2)
    return TsdfVolume(voxel, config)


@cache
def unlike(device: str) -> str:
    """How what Warp makes of two small views on a device differs from what the loops make of them, to the bit; empty
    where it does not."""
    from densify.fusion.on_device.volume import DeviceVolume

    made = []
    try:
        for volume in (TsdfVolume(0.2), DeviceVolume(0.2, device=device)):
            for turn in (0.0, 0.3):
                volume.integrate(*_look(turn))
            made.append({"blocks": volume.places, **vars(volume.extract_mesh())})
    except Exception as error:  # of a driver, a compiler, memory: each has errors of its own
        return f"NVIDIA Warp fails ({error})"
    off = [name for name, values in made[0].items() if not np.array_equal(values, made[1][name])]
    return f"NVIDIA Warp makes other {', '.join(off)} of two small views than the processor" if off else ""


def _look(turn: float) -> tuple[SurfaceView, np.ndarray]:
    """A view of a slanted, rippled wall, and its pose, turned by some radians and moved as far."""
    camera = Pinhole(40, 30, 36.0, 38.0, 19.3, 15.8)
    rays, valid = camera.rays()
    distance = (4 + np.sin(9 * rays[..., 0]) / 5) / (rays @ (0.3, -0.2, 0.9))
    prediction = DepthPrediction("1", distance.astype(np.float32), valid, camera, "closed form")
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    pose[:3, 3] = turn
    return surface_view(prediction, np.abs(rays).astype(np.float32), RectifyConfig()), pose
