"""Checkpoints: weights and a card in one safetensors file. Nothing here ever unpickles.

The metadata of the file holds, as JSON, `network` (NetworkConfig) and `card` (what it was trained on, its working
`rows`, its errors). Weights are stored in float16 unless asked otherwise, and used in float32.

A folder with `model.safetensors` is a checkpoint too, as hubs keep them; `config.json` in it has the same two objects,
and stands in for the metadata of weights that another program wrote anew.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from lightdepth.errors import InputError
from lightdepth.files.schema import read_json
from lightdepth.files.weights import MAX_HEADER, check_header, read_pickled
from lightdepth.files.writing import write_whole
from lightdepth.models import ConstantModel, DeclineModel, DepthModel, NetworkModel
from lightdepth.network import DepthNetwork, NetworkConfig, build_network
from lightdepth.reporting.names import told

DEFAULT_CHECKPOINT = "lightdepth-both"
Device = Literal["auto", "cpu", "cuda", "mps"]
"""Where a network runs; auto: on a CUDA GPU where there is one, else on the processor."""
TRAINING_FREE: dict[str, type[DeclineModel] | type[ConstantModel]] = {
    "decline": DeclineModel,
    "constant": ConstantModel,
}

WEIGHTS_FILE, CONFIG_FILE = "model.safetensors", "config.json"
"""What a folder holds that is a checkpoint."""
HUB = "hf://"
"""Before the id of a checkpoint on the Hugging Face hub, where one is named on the command line."""

_WEIGHTS = Path(__file__).parent / "weights"
_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_DEFAULT_ROWS, _MAX_ROWS = 128, 4096


def bundled() -> list[str]:
    """Names of the checkpoints that come with the program."""
    return sorted(path.stem for path in _WEIGHTS.glob("*.safetensors"))


def bundled_card(name: str) -> str | None:
    """The page on a bundled checkpoint, or None for others."""
    page = _WEIGHTS / f"{name}.md"
    return page.read_text(encoding="utf-8") if name in bundled() and page.is_file() else None


def save_model(network: DepthNetwork, path: Path | str, card: dict[str, Any], half: bool = True) -> None:
    """Writes weights, network configuration and card; `half` stores float16."""

    def stored(tensor: Tensor) -> Tensor:
        tensor = tensor.detach().cpu().contiguous()
        return tensor.half() if half and tensor.is_floating_point() else tensor

    weights = {name: stored(tensor) for name, tensor in network.state_dict().items()}
    metadata = {"network": json.dumps(network.config.to_dict()), "card": json.dumps(card)}
    write_whole(path, save(weights, metadata=metadata))


@dataclass(frozen=True)
class ModelSource:
    """Which depth model predicts, and what it runs on."""

    checkpoint: str = DEFAULT_CHECKPOINT
    """Depth model: path of a checkpoint (.safetensors or .ckpt), name of a bundled one (lightdepth-both,
    lightdepth-large, lightdepth-self or lightdepth-synthetic), decline (a formula for how light fades with distance, no
    network) or constant (everything equally far, for comparison)."""
    device: Device = "auto"
    """What the network runs on: auto, a CUDA GPU where there is one, else the processor; cpu, the processor; cuda; or
    mps, the GPU of an Apple computer. Where the network runs on a CUDA GPU, surfaces are fused there too if NVIDIA Warp
    is installed (extra gpu), else on the processor."""

    def load(self, details: bool = True) -> DepthModel:
        """The model, as `load_called` gives it."""
        return load_called(self.checkpoint, details, device=self.device)


def load_model(
    name_or_path: str | Path = DEFAULT_CHECKPOINT, details: bool = True, device: Device = "auto"
) -> DepthModel:
    """The model of that name: `decline`, `constant`, a bundled checkpoint, a .safetensors file, a folder with
    model.safetensors, a Lightning .ckpt, or `hf://OWNER/NAME`, which `from_pretrained` fetches.

    `details` False leaves out albedo and normals, where only distance is wanted. Raises InputError when there is no
    such checkpoint or device, or it cannot be used.
    """
    name, place = str(name_or_path), _found(device)
    if name == "decline":
        return DeclineModel(details=details)
    if name == "constant":
        return ConstantModel()
    if name in bundled():
        return _load_safetensors(_WEIGHTS / f"{name}.safetensors", name, details).to(place)
    if name.startswith(HUB):
        return from_pretrained(name.removeprefix(HUB), details, device=device)
    path = Path(name_or_path)
    if (path / WEIGHTS_FILE).is_file():
        return _load_safetensors(path / WEIGHTS_FILE, path.resolve().name, details).to(place)
    if not path.is_file():
        known = ", ".join([*bundled(), *TRAINING_FREE])
        what = f"is a folder without {WEIGHTS_FILE}" if path.is_dir() else "no such checkpoint"
        raise InputError(name, what, f"expected a .safetensors or .ckpt file, or one of {known}")
    if path.suffix == ".safetensors":
        return _load_safetensors(path, path.stem, details).to(place)
    if path.suffix == ".ckpt":
        return _load_lightning(path, details).to(place)
    raise InputError(name, "unknown kind of checkpoint", "expected a name that ends in .safetensors or .ckpt")


def load_called(
    name_or_path: str | Path, details: bool = True, option: str = "checkpoint", device: Device = "auto"
) -> DepthModel:
    """`load_model` for a verb: where the model's name is its path's and may tell a patient, its results are to call it
    by the option and its contents, as they call all inputs. Raises InputError as `load_model` does."""
    model = load_model(name_or_path, details, device)
    if isinstance(model, NetworkModel):
        model.name = told(model.name, **{option: name_or_path})
    return model


def from_pretrained(
    path_or_id: str | Path, details: bool = True, revision: str | None = None, device: Device = "auto"
) -> DepthModel:
    """The model of a checkpoint's folder or file, or of the id OWNER/NAME of such a folder on the Hugging Face hub.

    What lies at the path wins; the network is asked for an id alone, whose files are kept by `huggingface_hub` (extra
    `hub`). Raises InputError as `load_model` does, and where nothing can be fetched.
    """
    name = str(path_or_id).removeprefix(HUB)
    if Path(path_or_id).exists() or not _HUB_ID.fullmatch(name):
        return load_model(path_or_id, details, device)
    return load_model(_fetched(name, revision), details, device)


def _fetched(hub_id: str, revision: str | None) -> Path:
    """The folder that a checkpoint of the hub is kept in."""
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise InputError(
            hub_id, "no such path, and huggingface_hub is not installed", "pip install 'lightdepth[hub]'"
        ) from error
    try:
        return Path(
            snapshot_download(hub_id, revision=revision, allow_patterns=[WEIGHTS_FILE, CONFIG_FILE, "README.md"])
        )
    except Exception as error:  # no network, no such id, no right to it: each has errors of its own
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(
            hub_id, f"no such path, nor fetched from the hub ({first})", "give a path, or an id"
        ) from error


def _found(device: Device) -> str:
    """What PyTorch calls the device. Raises InputError where this machine has none of it."""
    there = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if device == "auto":
        return "cuda" if there["cuda"] else "cpu"
    if device not in there:
        raise InputError("--device", f"{device!r} is not known", f"expected one of {', '.join(get_args(Device))}")
    if not there[device]:
        raise InputError("--device", f"{device}, but PyTorch finds no such GPU", "take cpu, or auto")
    return device


def read_card(path: Path | str) -> dict[str, Any]:
    """The card inside a .safetensors checkpoint. Raises InputError when there is none."""
    return _read_safetensors(Path(path))[2]


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], NetworkConfig, dict[str, Any]]:
    check_header(path, "copy it again")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = _described(path, file.metadata() or {})
            network, card = json.loads(metadata["network"]), json.loads(metadata["card"])
            config = _config(network, card, path)
            names = list(file.keys())
            _check_fit(config, {name: tuple(file.get_slice(name).get_shape()) for name in names}, path)
            weights = {name: file.get_tensor(name) for name in names}
    except InputError:
        raise
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise InputError(path, f"damaged or not a safetensors file ({error})", "copy it again") from error
    except KeyError as error:
        raise InputError(
            path, f"metadata {error} missing", "expected a checkpoint exported by `lightdepth train`"
        ) from error
    return weights, config, card


def _config(network: object, card: object, path: Path) -> NetworkConfig:
    if not isinstance(network, dict) or not isinstance(card, dict):
        raise InputError(path, "metadata is not two JSON objects", "expected one exported by `lightdepth train`")
    try:
        return NetworkConfig.from_dict(network)
    except InputError as error:
        raise error.within(path) from error


def _check_fit(config: NetworkConfig, shapes: Mapping[str, tuple[int, ...]], path: Path) -> None:
    """Raises InputError where weights of these shapes are not those of the network. No memory is given to either."""
    with torch.device("meta"):
        wanted = {name: tuple(value.shape) for name, value in build_network(config).state_dict().items()}
    problems = [f"{name} missing" for name in wanted.keys() - shapes.keys()]
    problems += [f"{name} unknown" for name in shapes.keys() - wanted.keys()]
    problems += [
        f"{name} is {shapes[name]}, expected {wanted[name]}"
        for name in wanted.keys() & shapes.keys()
        if shapes[name] != wanted[name]
    ]
    if problems:
        raise InputError(
            path,
            f"weights do not fit a {config.kind} network ({min(problems)[:200]})",
            "expected a checkpoint of this version of the program",
        )


def _described(path: Path, metadata: dict[str, str]) -> dict[str, str]:
    """A file's own metadata, or what config.json beside it has."""
    beside = path.with_name(CONFIG_FILE)
    if {"network", "card"} <= metadata.keys() or path.name != WEIGHTS_FILE or not beside.is_file():
        return metadata
    if beside.stat().st_size > MAX_HEADER:
        raise InputError(beside, f"longer than {MAX_HEADER} bytes", "expected the network and its card, two objects")
    found = read_json(beside)
    if not isinstance(found, dict):
        raise InputError(beside, "no object in it", "expected the network and its card, two objects")
    return {name: json.dumps(found[name]) for name in ("network", "card") if name in found}


def _load_safetensors(path: Path, name: str, details: bool) -> NetworkModel:
    weights, config, card = _read_safetensors(path)
    network = _network(config, weights, path)
    return NetworkModel(network, _rows(card, path), name, card, details)


def _load_lightning(path: Path, details: bool) -> NetworkModel:
    expected = "expected a checkpoint written by `lightdepth train`"
    checkpoint = read_pickled(path, expected)
    try:
        hyper, state = checkpoint["hyper_parameters"], checkpoint["state_dict"]
        config = _config(dict(hyper["network"]), {}, path)
        prefix = "network."
        weights = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        shapes = {name: tuple(value.shape) for name, value in weights.items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, f"{error!r:.200}", expected) from error
    _check_fit(config, shapes, path)
    return NetworkModel(_network(config, weights, path), _rows(hyper, path), path.stem, {}, details)


def _rows(found: dict[str, Any], path: Path) -> int:
    rows = found.get("rows", _DEFAULT_ROWS)
    if not isinstance(rows, int) or not 1 <= rows <= _MAX_ROWS:
        short = isinstance(rows, float | str) or (isinstance(rows, int) and abs(rows) < 10**30)
        shown = f"{rows!r:.30}" if short else f"of type {type(rows).__name__}"
        raise InputError(path, f"rows {shown}", f"expected the image height to predict at, {_MAX_ROWS} pixels at most")
    return rows


def _network(config: NetworkConfig, weights: dict[str, Tensor], path: Path) -> DepthNetwork:
    with torch.random.fork_rng(devices=[]):  # first weights are drawn, and go at once: a caller's own chance stays
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
