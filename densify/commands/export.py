"""The verb export: dense maps, predictions and checkpoints, as other programs take them."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated, Literal, get_args

from densify.dense_map import map_folders
from densify.exporting.work import MAP_KINDS, MapExport, export_maps
from lightdepth.checkpoint import load_called
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.errors import InputError, MissingOption
from lightdepth.exporting.work import DEPTH_KINDS, MODEL_KINDS, export_depth, export_model
from lightdepth.models import NetworkModel
from lightdepth.ranges import PIXELS, above
from lightdepth.reporting.run import recorded, run_folder

Kind = Literal[
    "colmap", "nerfstudio", "ply", "glb", "obj", "tum", "climb", "png", "exr", "onnx", "torch", "safetensors"
]


_OPENED = {
    "colmap": "colmap model_analyzer --path OUT/map_000/sparse/0",
    "nerfstudio": "ns-train splatfacto --data OUT/map_000",
    "safetensors": "lightdepth predict DATA --checkpoint OUT -o runs/depth",
}
"""What to type next, by what was written."""


def export(
    what: str,
    output: Path,
    to: Kind | None = None,
    maps: Group[MapExport] = MapExport(),
    size: Annotated[tuple[int, int] | None, PIXELS] = None,
    half: bool = True,
    step: Annotated[float | None, above(0)] = None,
    overwrite: bool = False,
) -> None:
    """Dense maps, predictions or a checkpoint as other programs take them: COLMAP, nerfstudio, meshes, ONNX.

    Args:
        what: Densify run or map folder (colmap, nerfstudio, ply, glb, obj, tum, climb), folder of predict (png, exr),
            or checkpoint (onnx, torch, safetensors).
        output: Folder to make, with a folder for each map, a file for each frame, or the model.
        to: What to write (required): colmap, nerfstudio, ply, glb, obj, tum or climb of maps; png (16 bits)
            or exr of depth; onnx, torch (torch.export) or safetensors of a network.
        size: Fixed width and height, pixels, of the images that an onnx or torch graph takes; left out, it takes any. A
            larger one makes the network slower.
        half: Store the weights of safetensors in half precision, as checkpoints are kept; false keeps all digits.
        step: Depth that one step of a 16-bit png's code stands for, in mm or the unit of the predictions; left out, a
            power of ten with which the farthest pixel fits. A larger one holds farther depth, less finely.
        overwrite: Replace a folder made before.
    """
    arguments = recorded(maps, what=what, output=output, to=to, size=size, half=half, step=step)
    path = Path(what)
    if to is None:
        raise MissingOption("--to", "not given", f"expected one of {', '.join(get_args(Kind))}")
    if to not in get_args(MODEL_KINDS) and not path.exists():  # a checkpoint may be a name
        raise InputError(path, "does not exist", "expected a run of densify, a map folder, or a folder of predict")
    if to in get_args(MAP_KINDS) and not map_folders(path):
        raise InputError(path, "no dense map in it", f"expected a run of `lightdepth densify` for --to {to}")
    if to in get_args(DEPTH_KINDS) and not (path.is_dir() and any(path.glob("*.npz"))):
        raise InputError(path, "no predictions in it", f"expected a folder of `lightdepth predict` for --to {to}")
    model = _network(what) if to in get_args(MODEL_KINDS) else None
    if size is not None and to not in ("onnx", "torch"):
        raise InputError("--size", f"given with --to {to}", "leave it out: only onnx and torch have it")
    if size is not None and min(size) < 1:
        raise InputError("--size", f"{list(size)}", "expected a width and a height of some pixels")
    with run_folder(output, "export", arguments, overwrite) as run:
        if model is not None:
            export_model(run, model, to, size, half)
        elif to in get_args(DEPTH_KINDS):
            export_depth(run, path, to, step)
        else:
            export_maps(run, path, to, maps)
    end(output, then=_OPENED.get(to, "ls OUT").replace("OUT", quote(str(output))))


def _network(checkpoint: str) -> NetworkModel:
    """The checkpoint of a trained network."""
    model = load_called(checkpoint, option="what")
    if not isinstance(model, NetworkModel):
        raise InputError(checkpoint, "no network, and so without weights", "expected the checkpoint of a trained one")
    return model
