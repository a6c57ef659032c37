"""Checkpoints: weights and a card in one safetensors file. Nothing here ever unpickles.

The metadata of the file holds, as JSON, `network` (NetworkConfig) and `card` (what it was trained on, its working
`rows`, its errors). Weights are stored in float16 unless asked otherwise, and used in float32.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from lightdepth.errors import InputError
from lightdepth.files.writing import write_whole
from lightdepth.models import ConstantModel, DeclineModel, DepthModel, NetworkModel
from lightdepth.network import DepthNetwork, NetworkConfig, build_network

DEFAULT_CHECKPOINT = "lightdepth-synthetic"
TRAINING_FREE: dict[str, type[DeclineModel] | type[ConstantModel]] = {
    "decline": DeclineModel,
    "constant": ConstantModel,
}

_WEIGHTS = Path(__file__).parent / "weights"
_DEFAULT_ROWS = 128


def bundled() -> list[str]:
    """Names of the checkpoints that come with the program."""
    return sorted(path.stem for path in _WEIGHTS.glob("*.safetensors"))


def save_model(network: DepthNetwork, path: Path | str, card: dict[str, Any], half: bool = True) -> None:
    """Writes weights, network configuration and card; `half` stores float16."""

    def stored(tensor: Tensor) -> Tensor:
        tensor = tensor.detach().cpu().contiguous()
        return tensor.half() if half and tensor.is_floating_point() else tensor

    weights = {name: stored(tensor) for name, tensor in network.state_dict().items()}
    metadata = {"network": json.dumps(network.config.to_dict()), "card": json.dumps(card)}
    write_whole(path, save(weights, metadata=metadata))


def load_model(name_or_path: str | Path = DEFAULT_CHECKPOINT, details: bool = True) -> DepthModel:
    """The model of that name: `decline`, `constant`, a bundled checkpoint, a .safetensors file or a Lightning .ckpt.

    `details` False leaves out albedo and normals, where only distance is wanted. Raises InputError when there is no
    such checkpoint or it cannot be used.
    """
    name = str(name_or_path)
    if name == "decline":
        return DeclineModel(details=details)
    if name == "constant":
        return ConstantModel()
    if name in bundled():
        return _placed(_load_safetensors(_WEIGHTS / f"{name}.safetensors", name, details))
    path = Path(name_or_path)
    if not path.is_file():
        known = ", ".join([*bundled(), *TRAINING_FREE])
        what = "is a folder" if path.is_dir() else "no such checkpoint"
        raise InputError(name, what, f"expected a .safetensors or .ckpt file, or one of {known}")
    if path.suffix == ".safetensors":
        return _placed(_load_safetensors(path, path.stem, details))
    if path.suffix == ".ckpt":
        return _placed(_load_lightning(path, details))
    raise InputError(name, "unknown kind of checkpoint", "expected a name that ends in .safetensors or .ckpt")


def _placed(model: NetworkModel) -> NetworkModel:
    """The model on the GPU where there is one."""
    return model.to("cuda") if torch.cuda.is_available() else model


def read_card(path: Path | str) -> dict[str, Any]:
    """The card inside a .safetensors checkpoint. Raises InputError when there is none."""
    return _read_safetensors(Path(path))[2]


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], NetworkConfig, dict[str, Any]]:
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
        config, card = json.loads(metadata["network"]), json.loads(metadata["card"])
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(path, f"damaged or not a safetensors file ({error})", "copy it again") from error
    except KeyError as error:
        raise InputError(
            path, f"metadata {error} missing", "expected a checkpoint exported by `lightdepth train`"
        ) from error
    if not isinstance(config, dict) or not isinstance(card, dict):
        raise InputError(path, "metadata is not two JSON objects", "expected one exported by `lightdepth train`")
    return weights, NetworkConfig.from_dict(config), card


def _load_safetensors(path: Path, name: str, details: bool) -> NetworkModel:
    weights, config, card = _read_safetensors(path)
    network = _network(config, weights, path)
    return NetworkModel(network, _rows(card, path), name, card, details)


def _load_lightning(path: Path, details: bool) -> NetworkModel:
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged or hostile pickle can raise anything; it is never executed
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(
            path,
            f"damaged, or holds more than weights and plain values ({first})",
            "expected a checkpoint written by `lightdepth train`",
        ) from error
    try:
        hyper, state = checkpoint["hyper_parameters"], checkpoint["state_dict"]
        config = NetworkConfig.from_dict(dict(hyper["network"]))
        prefix = "network."
        weights = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(path, f"{error!r}", "expected a checkpoint written by `lightdepth train`") from error
    return NetworkModel(_network(config, weights, path), _rows(hyper, path), path.stem, {}, details)


def _rows(found: dict[str, Any], path: Path) -> int:
    rows = found.get("rows", _DEFAULT_ROWS)
    if not isinstance(rows, int) or rows < 1:
        raise InputError(path, f"rows {rows!r}", "expected the image height to predict at, in pixels")
    return rows


def _network(config: NetworkConfig, weights: dict[str, Tensor], path: Path) -> DepthNetwork:
    network = build_network(config)
    weights = {name: value.float() if value.is_floating_point() else value for name, value in weights.items()}
    if not all(torch.isfinite(value).all() for value in weights.values()):
        raise InputError(path, "weights are not all finite", "its training failed: take an earlier checkpoint")
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise InputError(
            path,
            f"weights do not fit a {config.kind} network ({reason})",
            "expected a checkpoint of this version of the program",
        ) from error
    return network.requires_grad_(False).eval()
