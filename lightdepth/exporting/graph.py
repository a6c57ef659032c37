"""A network as one graph that runs without this program: ONNX, or torch.export's .pt2.

In, all float32 but the mask: image (B, 3, H, W) RGB in [0, 1] as the camera encoded it; mask (B, 1, H, W) bool; rays
(B, 3, H, W) unit, of the pixel centres in camera axes; light (B, 4), its gamma, mu, gain and reflectance. Out: distance
(B, 1, H, W) along the rays up to scale, albedo (B, 2, H, W) as hue and saturation, and where the network has the head
log_sigma (B, 1, H, W). Batch, height and width are free.

The closed form's blur has a kernel as wide as the image is high says. No graph holds a kernel of changing size, so here
each direction is one matrix, made of indices: M[i, k] is the weight of pixel k at i, pixels beyond the border mirrored.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lightdepth.decline import V_FLOOR
from lightdepth.errors import InputError
from lightdepth.network import DepthNetwork
from lightdepth.photometry import LightTerms, brightness, spread

TOLERANCE = 1e-5
"""Largest difference of a graph from its network: of log distance, albedo and log sigma."""
LIGHT = ("gamma", "mu", "gain", "reflectance")
_LEAST_SIDE = 33


class Exported(nn.Module):
    """A network with plain tensors in and out."""

    def __init__(self, network: DepthNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor, mask: Tensor, rays: Tensor, light: Tensor) -> tuple[Tensor, ...]:
        """As in the module's notation."""
        found = self.network.estimate(image, mask, rays, light_terms(light), matrix_closed_form)
        return tuple(value for value in found if value is not None)


def light_terms(light: Tensor) -> LightTerms:
    """(B, 4) as light terms; where the lamp is and points, no network asks: its distance has no unit."""
    gamma, mu, gain, reflectance = (light[:, i].reshape(-1, 1, 1, 1) for i in range(4))
    nowhere = torch.zeros_like(light[:, :3]).reshape(-1, 3, 1, 1)
    return LightTerms(gamma, mu, gain, reflectance, nowhere, nowhere)


def matrix_closed_form(image: Tensor, mask: Tensor, rays: Tensor, light: LightTerms, blur: float) -> Tensor:
    """lightdepth.decline.log_closed_form, its blur by matrices."""
    light = light.co_located()
    log_v = brightness(image).clamp(min=V_FLOOR).log()
    if blur > 0:
        rows, columns = _blur_matrices(image[0, 0], blur)
        weight = mask.to(image.dtype)
        total = rows @ torch.where(mask, log_v, 0.0) @ columns.T
        log_v = torch.where(mask, total / (rows @ weight @ columns.T).clamp(min=1e-6), log_v)
    return 0.5 * (light.gain.log() + spread(rays, light).log() - light.gamma * log_v)


def _blur_matrices(pixels: Tensor, blur: float) -> tuple[Tensor, Tensor]:
    """(H, H) and (W, W) of an image (H, W); `blur` as a share of H. Kernel and border as lightdepth.decline has them:
    2 int(3 s + 1/2) + 1 taps of a normalised Gaussian, never more than 2 min(H, W) - 1."""
    ones = torch.ones_like(pixels)
    height, width = ones[:, 0].sum(), ones[0].sum()
    sigma = blur * height
    reach = torch.minimum((3 * sigma + 0.5).floor(), torch.minimum(height, width) - 1)

    def tap(offset: Tensor) -> Tensor:
        return torch.where(offset.abs() <= reach, torch.exp(-0.5 * (offset / sigma).square()), 0.0)

    def matrix(line: Tensor, count: Tensor) -> Tensor:
        at = line.cumsum(0) - 1
        i, k = at[:, None], at[None]
        before = torch.where(k >= 1, tap(-k - i), 0.0)  # the first pixel and the last are not mirrored themselves
        behind = torch.where(k <= count - 2, tap(2 * (count - 1) - k - i), 0.0)
        found = tap(k - i) + before + behind
        return found / found.sum(1, keepdim=True)

    return matrix(ones[:, 0], height), matrix(ones[0], width)


def example_inputs(rows: int, columns: int, count: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Inputs of a made-up endoscope, smooth with noise, to trace a graph with and to compare it by."""
    rng = np.random.default_rng(rows * 10_000 + columns)
    v, u = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    rays = np.stack([u, v, np.full_like(u, 1.2)])
    rays /= np.linalg.norm(rays, axis=0)
    bright = 0.9 / (1 + 2 * (u - 0.2) ** 2 + 3 * v**2)
    image = bright * np.array([1.0, 0.6, 0.5])[:, None, None] + rng.normal(0, 0.02, (count, 3, rows, columns))
    mask = np.broadcast_to(np.hypot(u, v) < 1.25, (count, 1, rows, columns))
    light = np.tile([2.2, 2.0, 1.0, 0.3], (count, 1))
    image, rays = np.clip(image, 0, 1), np.broadcast_to(rays, image.shape)
    floats = [torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (image, rays, light)]
    return floats[0], torch.from_numpy(mask.copy()), floats[1], floats[2]


@torch.inference_mode()
def module_outputs(network: DepthNetwork, inputs: tuple[Tensor, ...]) -> list[np.ndarray]:
    """What the network itself says, by its own operations."""
    image, mask, rays, light = inputs
    return [v.numpy() for v in network.estimate(image, mask, rays, light_terms(light)) if v is not None]


def traced(network: DepthNetwork, rows: int, size: tuple[int, int] | None = None) -> torch.export.ExportedProgram:
    """The graph of a network, free in batch, height and width, or of one size (width, height).

    Raises InputError where its operations allow none."""
    if size is not None:
        inputs, shapes = example_inputs(size[1], size[0]), None
    else:
        free = torch.export.Dim.AUTO  # named ones need bounds, which are not proved for every network
        picture = {0: free, 2: free, 3: free}
        shapes = {"image": picture, "mask": picture, "rays": picture, "light": {0: free}}
        inputs = example_inputs(max(rows, _LEAST_SIDE), round(rows * 1.25) + 43, 2)  # no side is a special case
    try:
        with _quiet(), torch.no_grad():
            return torch.export.export(Exported(network).eval(), inputs, dynamic_shapes=shapes, strict=False)
    except Exception as error:  # whatever the tracer stumbles over
        raise InputError(
            f"the {network.config.kind} network", f"it cannot be traced ({_first(error)})", "export --to safetensors"
        ) from error


def write_torch(program: torch.export.ExportedProgram, path: Path) -> None:
    """torch.export's .pt2."""
    with _quiet():
        torch.export.save(program, path)


def write_onnx(program: torch.export.ExportedProgram, path: Path, outputs: tuple[str, ...]) -> None:
    """One ONNX file with its weights inside. Raises InputError where the extra `onnx` is not installed."""
    onnx_packages()
    names = ["image", "mask", "rays", "light"]
    try:
        with _quiet():
            made = torch.onnx.export(program, input_names=names, output_names=list(outputs), verbose=False)
            assert made is not None
            made.save(path, external_data=False)
    except (OSError, MemoryError):  # the machine's failure
        raise
    except Exception as error:  # whatever the translation stumbles over
        raise InputError(path, f"no ONNX for this network ({_first(error)})", "export --to torch") from error


def onnx_packages() -> None:
    """Raises InputError where what ONNX needs is not installed."""
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise InputError("ONNX", f"{error.name} is not installed", "pip install 'lightdepth[onnx]'") from error


def run_onnx(path: Path, inputs: tuple[Tensor, ...]) -> list[np.ndarray]:
    """What onnxruntime makes of it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    named = {i.name: t.numpy() for i, t in zip(session.get_inputs(), inputs, strict=True)}
    return [np.asarray(v) for v in session.run(None, named)]


def run_torch(path: Path, inputs: tuple[Tensor, ...]) -> list[np.ndarray]:
    """What torch makes of a .pt2."""
    with _quiet(), torch.no_grad():
        return [v.numpy() for v in torch.export.load(path).module()(*inputs)]


def difference(found: list[np.ndarray], wanted: list[np.ndarray]) -> float:
    """The largest difference: of log distance, of the other outputs as they are."""
    logs = [np.abs(np.log(a) - np.log(b)).max() for a, b in zip(found[:1], wanted[:1], strict=True)]
    return float(max(logs + [np.abs(a - b).max() for a, b in zip(found[1:], wanted[1:], strict=True)]))


@contextmanager
def _quiet() -> Iterator[None]:
    """Tracers tell of their own insides."""
    told = logging.getLogger("torch.onnx")
    level = told.level
    told.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        told.setLevel(level)


def _first(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return (lines[0] if lines else type(error).__name__)[:200]
