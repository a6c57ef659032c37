"""Where rays meet a mesh of triangles: Embree (in Open3D) on the CPU, NVIDIA Warp on a GPU.

Both give the same hits up to rounding. Rays are tensors (n, 3) on the caster's device; directions are of unit length.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from lightdepth import native
from lightdepth.errors import InputError


class Hits(NamedTuple):
    """distance (n,) along the ray, infinite where nothing is met; there face (n,) int64 and uv (n, 2), the weights of
    the triangle's second and third corner, mean nothing."""

    distance: Tensor
    face: Tensor
    uv: Tensor


class Caster(Protocol):
    def cast(self, origins: Tensor, directions: Tensor) -> Hits:
        """The first triangle that each ray meets."""

    def blocked(self, start: Tensor, end: Tensor) -> Tensor:
        """Whether a triangle stands between points (n, 3) and (n, 3): (n,) bool."""


def make_caster(vertices: np.ndarray, faces: np.ndarray, device: torch.device) -> Caster:
    """The caster for a device: vertices (n, 3), faces (m, 3)."""
    return EmbreeCaster(vertices, faces) if device.type == "cpu" else WarpCaster(vertices, faces, device)


def rendering_device(wanted: str = "auto") -> torch.device:
    """auto: the GPU where there is one and Warp is installed, else the CPU. Raises InputError for what is not there."""
    if wanted == "auto":
        wanted = "cuda" if torch.cuda.is_available() and native.has_warp() else "cpu"
    if wanted not in ("cpu", "cuda"):
        raise InputError("device to render on", f"{wanted!r} is not known", "expected auto, cpu or cuda")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise InputError("device to render on", "cuda, but PyTorch finds no GPU", "take cpu, or auto")
    return torch.device("cpu") if wanted == "cpu" else torch.device("cuda", torch.cuda.current_device())


class EmbreeCaster:
    """On one thread, so that what is done with the hits decides what else runs."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self._core = native.open3d().core
        self._scene = native.open3d().t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._tensor(vertices), self._core.Tensor(faces.astype(np.uint32)))

    def cast(self, origins: Tensor, directions: Tensor) -> Hits:
        hit = self._scene.cast_rays(self._tensor(torch.cat([origins, directions], -1).numpy()))
        face = hit["primitive_ids"].numpy().astype(np.int64)
        return Hits(*map(torch.from_numpy, (hit["t_hit"].numpy(), face, hit["primitive_uvs"].numpy())))

    def blocked(self, start: Tensor, end: Tensor) -> Tensor:
        rays = torch.cat([start, end - start], -1).numpy()
        return torch.from_numpy(self._scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0).numpy())

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Exact distance (n,) from points (n, 3) to the mesh."""
        result: np.ndarray = self._scene.compute_distance(self._tensor(points)).numpy()
        return result

    def _tensor(self, array: np.ndarray) -> Any:
        """Open3D's, of float32."""
        return self._core.Tensor(np.ascontiguousarray(array, np.float32))


class WarpCaster:
    """On a GPU, or on the CPU, where it is slower than Embree and there to be compared with it."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, device: torch.device):
        self._warp = native.warp()
        from lightdepth.tube import warp_kernels

        self._kernels, self._device = warp_kernels, device
        self._corners = self._warp.array(vertices.astype(np.float32), dtype=self._warp.vec3, device=str(device))
        indices = self._warp.array(faces.astype(np.int32).ravel(), dtype=self._warp.int32, device=str(device))
        self._mesh = self._warp.Mesh(self._corners, indices)

    def cast(self, origins: Tensor, directions: Tensor) -> Hits:
        distance, face = self._empty(len(origins), torch.float32), self._empty(len(origins), torch.int32)
        u, v = (self._empty(len(origins), torch.float32) for _ in range(2))
        self._launch(self._kernels.first_hits, [origins, directions], [distance, face, u, v])
        return Hits(distance, face.long(), torch.stack([u, v], -1))

    def blocked(self, start: Tensor, end: Tensor) -> Tensor:
        found = self._empty(len(start), torch.int32)
        self._launch(self._kernels.any_hits, [start, end], [found])
        return found.bool()

    def _empty(self, count: int, dtype: torch.dtype) -> Tensor:
        return torch.empty(count, dtype=dtype, device=self._device)

    def _launch(self, kernel: Any, points: list[Tensor], results: list[Tensor]) -> None:
        warp = self._warp
        stream = (
            warp.stream_from_torch(torch.cuda.current_stream(self._device)) if self._device.type == "cuda" else None
        )
        inputs = [warp.from_torch(p.float().contiguous(), dtype=warp.vec3) for p in points]
        warp.launch(
            kernel,
            dim=len(points[0]),
            inputs=[self._mesh.id, *inputs],
            outputs=[warp.from_torch(result) for result in results],
            device=str(self._device),
            stream=stream,
        )
