"""What is installed, what is missing and how to get it, and whether the fusion works on this machine."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.fusion.chosen import unlike
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from lightdepth import native
from lightdepth.camera import Pinhole
from lightdepth.compiled import cache_folder
from lightdepth.errors import InputError
from lightdepth.files.lock import locked
from lightdepth.files.replacing import hidden, output_of, recover, remains
from lightdepth.prediction import DepthPrediction
from lightdepth.reporting.record import versions

_MOST_FOLDERS = 200
"""Folders in the current one in which remains of killed runs are looked for."""


@dataclass(frozen=True)
class Check:
    what: str
    ok: bool
    detail: str


def examine() -> list[Check]:
    """All checks, in the order in which they build on each other."""
    found = versions()
    needed = ("torch", "lightning", "kornia", "numpy", "scipy", "pycolmap", "opencv-python-headless")
    findings = [Check("python", True, f"{found['python']} on {platform.machine()}, {os.cpu_count()} cores")]
    findings += [Check(name, name in found, found.get(name, f"missing: pip install {name}")) for name in needed]
    findings += [_open3d(found), _torch_device(), _pycolmap(), _fused_plane(), *_fused_on_gpu(), _machine_code()]
    findings += [_torchvision(), _remains(Path())]
    return findings


def _open3d(found: dict[str, str]) -> Check:
    version = found.get("open3d-cpu") or found.get("open3d") or "missing"
    absent = native.missing_system_libraries()
    try:
        native.open3d()
    except InputError as error:
        cure = f"; missing: apt-get install {' '.join(absent)}" if absent else ""
        return Check("open3d", False, f"{error}{cure}")
    note = f"; not found by the loader, yet not needed so far: {' '.join(absent)}" if absent else ""
    return Check("open3d", True, f"{version}, loads{note}")


def _torch_device() -> Check:
    import torch

    if torch.cuda.is_available():
        without = "; colons are rendered and surfaces fused on the CPU: pip install 'lightdepth[gpu]'"
        note = "" if native.has_warp() else without
        return Check("device", True, f"cuda: {torch.cuda.get_device_name(0)}{note}")
    return Check(
        "device", True, f"cpu, {torch.get_num_threads()} threads (a GPU is used where there is one, never needed)"
    )


def _pycolmap() -> Check:
    try:
        names = ("extract_features", "match_sequential", "incremental_mapping", "Reconstruction")
        missing = [name for name in names if not hasattr(native.pycolmap(), name)]
    except ImportError as error:
        return Check("pycolmap calls", False, f"{error}: pip install 'pycolmap>=4'")
    return Check("pycolmap calls", not missing, f"lacks {', '.join(missing)}" if missing else "all there")


def _remains(folder: Path) -> Check:
    """What runs that were killed left in a folder and those in it; a result that was moved aside comes back."""
    found = [left for place in [folder, *_folders_in(folder)] for left in remains(place)]
    for old in (path for path in found if path.suffix == ".old"):
        output = output_of(old)
        if output is not None:
            with locked(output):
                recover(output)
    left = [str(path) for path in found if path.exists()]
    if not left:
        return Check("remains", True, "none of killed runs here")
    named = ", ".join(left[:5]) + (f" and {len(left) - 5} more" if len(left) > 5 else "")
    return Check("remains", True, f"of killed runs: {named}; the next run to the same place goes on or clears them up")


def _folders_in(folder: Path) -> list[Path]:
    try:
        return sorted(p for p in folder.iterdir() if p.is_dir() and not hidden(p))[:_MOST_FOLDERS]
    except OSError:
        return []


def _machine_code() -> Check:
    """Where compiled loops are kept: what lies there is loaded and run."""
    folder = cache_folder()
    if folder is None:
        return Check("compiled loops", True, "made by each process: there is no home to keep them in")
    if native.open_to_others(folder):
        cure = f"programs run the code in it: remove it, or chmod 700 {folder} once you know what it holds"
        return Check("compiled loops", False, f"{folder} is another user's, or others may write to it; {cure}")
    return Check("compiled loops", True, f"kept in {folder}")


def _torchvision() -> Check:
    from importlib.util import find_spec

    if find_spec("torchvision") is None:
        return Check("torchvision", True, "absent, as it should be")
    try:
        import torchvision  # noqa: F401
    except Exception as error:
        return Check("torchvision", False, f"broken ({error}), and breaks lightning: pip uninstall torchvision")
    return Check("torchvision", True, "installed, and it loads; not needed")


def fused_plane_error(voxel: float = 0.5, distance: float = 30.0) -> tuple[int, float]:
    """Vertices of a fused plane at `distance`, and their largest error along the axis, in voxels."""
    camera = Pinhole(160, 120, 120.0, 120.0, 80.0, 60.0)
    rays, valid = camera.rays()
    prediction = DepthPrediction("plane", (distance / rays[..., 2]).astype(np.float32), valid, camera, "doctor")
    volume = TsdfVolume(voxel, FusionConfig())
    volume.integrate(surface_view(prediction, np.full((120, 160, 3), 0.5, np.float32), RectifyConfig()), np.eye(4))
    vertices = volume.extract_mesh().vertices
    error = float(np.abs(vertices[:, 2] - distance).max() / voxel) if len(vertices) else np.inf
    return len(vertices), error


def _fused_on_gpu() -> list[Check]:
    """Nothing where no surface would be fused on a GPU."""
    import torch

    if not torch.cuda.is_available() or not native.has_warp():
        return []
    wrong = unlike("cuda:0")
    what = f"{wrong}; surfaces are fused on the CPU" if wrong else "bit for bit as on the CPU"
    return [Check("fused on the GPU", not wrong, what)]


def _fused_plane() -> Check:
    try:
        count, error = fused_plane_error()
    except InputError as error_found:
        return Check("fused plane", False, str(error_found))
    return Check("fused plane", count > 1000 and error < 0.5, f"{count} vertices, largest error {error:.2g} voxels")
