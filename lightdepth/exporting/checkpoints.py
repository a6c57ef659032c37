"""A checkpoint as others take it: a folder with weights for a hub, or a graph with its settings and an example.

    safetensors   model.safetensors  config.json  README.md           what `from_pretrained` reads
    onnx          model.onnx  model.json  example.py  README.md       runs under onnxruntime, without this program
    torch         model.pt2   model.json  example.py  README.md       runs under torch alone

Every graph is compared with its network before anything is said of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from lightdepth import __version__
from lightdepth.checkpoint import CONFIG_FILE, WEIGHTS_FILE, bundled_card, save_model
from lightdepth.errors import InputError
from lightdepth.exporting import graph
from lightdepth.models import NetworkModel
from lightdepth.photometry import PhotometricCalibration

GraphKind = Literal["onnx", "torch"]
GRAPH_FILES = {"onnx": "model.onnx", "torch": "model.pt2"}
_EXAMPLE = Path(__file__).with_name("example.py")


def write_pretrained(model: NetworkModel, folder: Path, half: bool = True) -> None:
    """The folder that `from_pretrained` reads; `folder` is there. `half` stores float16, as checkpoints are kept."""
    network = model.network.cpu()
    card = {**model.card, "rows": model.rows}
    save_model(network, folder / WEIGHTS_FILE, card, half)
    config = {"network": network.config.to_dict(), "card": card, "version": __version__}
    (folder / CONFIG_FILE).write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")
    use = [
        "```python",
        "from lightdepth import from_pretrained",
        "",
        'model = from_pretrained("this folder, or its id on the hub")',
        "```",
    ]
    (folder / "README.md").write_text(_card(model, use), encoding="utf-8")


def write_graph(model: NetworkModel, folder: Path, kind: GraphKind, size: tuple[int, int] | None = None) -> float:
    """The graph with its settings, example and card; `folder` is there. Free in batch, height and width, or for images
    of one size (width, height) alone, one by one. Returns its largest difference from the network, over several sizes.

    Raises InputError where it differs by more than graph.TOLERANCE, or the network cannot be traced.
    """
    if kind == "onnx":
        graph.onnx_packages()
    network = model.network.cpu()
    rows = model.rows if size is None else size[1]
    program = graph.traced(network, rows, size)
    path = folder / GRAPH_FILES[kind]
    outputs = ("distance", "albedo", "log_sigma")[: 2 + (network.uncertainty is not None)]
    run: Callable[[Path, tuple[torch.Tensor, ...]], list[np.ndarray]] = (
        graph.run_onnx if kind == "onnx" else graph.run_torch
    )
    if kind == "onnx":
        graph.write_onnx(program, path, outputs)
    else:
        graph.write_torch(program, path)
    sizes = [(rows, round(rows * 1.25), 1), (rows + 11, rows + 30, 2)] if size is None else [(size[1], size[0], 1)]
    off = 0.0
    for height, width, count in sizes:
        inputs = graph.example_inputs(height, width, count)
        try:
            found = run(path, inputs)
        except Exception as error:  # whatever a runtime says of a graph that took its first size for the only one
            raise InputError(path, f"it takes no image of {width}x{height}", "give --size, the only one") from error
        off = max(off, graph.difference(found, graph.module_outputs(network, inputs)))
    if not off <= graph.TOLERANCE:
        raise InputError(
            path, f"it differs from the network by {off:.2g}", f"expected at most {graph.TOLERANCE:g}; try another kind"
        )
    light = asdict(PhotometricCalibration())
    settings = {
        "rows": rows,
        "size": size,
        "inputs": ["image", "mask", "rays", "light"],
        "outputs": outputs,
        "light": {name: light[name] for name in graph.LIGHT},
        "difference": off,
    }
    (folder / "model.json").write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
    (folder / "example.py").write_text(_EXAMPLE.read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "README.md").write_text(_card(model, _graph_use(path.name, outputs, rows, size, off)), encoding="utf-8")
    return off


def _graph_use(name: str, outputs: tuple[str, ...], rows: int, size: tuple[int, int] | None, off: float) -> list[str]:
    free = "batch, height and width are free" if size is None else f"for images of {size[0]}x{size[1]}, one by one"
    return [
        f"`{name}` ({free}; trained at {rows} rows) takes, float32 but the mask:",
        "",
        "| input | shape | what |",
        "|---|---|---|",
        "| image | (B, 3, H, W) | RGB in [0, 1] as the camera encoded it |",
        "| mask | (B, 1, H, W) bool | where the image shows tissue |",
        "| rays | (B, 3, H, W) | unit rays through the pixel centres: x right, y down, z into the scene |",
        f"| light | (B, 4) | {', '.join(graph.LIGHT)} of the endoscope's light |",
        "",
        f"and gives {', '.join(outputs)}: distance along the ray up to scale, hue and saturation of the albedo"
        + (", log of the standard deviation of log distance." if len(outputs) > 2 else "."),
        "Largest difference from the network that it was made of, of log distance and of the others: " + f"{off:.2g}.",
        "",
        f"    python example.py {name} image.png camera.json distance.npy",
    ]


def _card(model: NetworkModel, use: list[str]) -> str:
    """The card as a page: how it is used, and what is known of it."""
    known = bundled_card(model.name)
    if known is None:
        facts = {key: value for key, value in model.card.items() if isinstance(value, (str, int, float))}
        lines = [f"- {key}: {value}" for key, value in facts.items()]
        errors = model.card.get("errors")
        shown = errors.items() if isinstance(errors, dict) else ()
        lines += [f"- {key}: {value:.4g}" for key, value in shown if isinstance(value, int | float)]
        network = json.dumps(model.network.config.to_dict())
        known = "\n".join([f"# {model.name}", "", *lines, f"- network: `{network}`"]) + "\n"
    head = ["---", "library_name: lightdepth", "pipeline_tag: depth-estimation", "---", ""]
    return "\n".join([*head, known.rstrip(), "", "## How it is used", "", *use]) + "\n"
